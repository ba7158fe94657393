"""Helpers of HTTP clients: pauses that servers request, excerpts for messages, atomic file writes."""

import os
from pathlib import Path

import requests

from registry.errors import EnvironmentMissing

_EXCERPT = 200  # characters


def asked_pause(response: requests.Response) -> float:
    """Return the pause in seconds that a response requests (`Retry-After`); 0 if none."""
    try:
        return max(0.0, float(response.headers.get("Retry-After", 0)))
    except ValueError:  # a date
        return 0.0


def excerpt(text: str) -> str:
    """Return the beginning of a text, on one line."""
    words = " ".join(text.split())
    return words if len(words) <= _EXCERPT else words[:_EXCERPT] + "..."


def write_whole(file: Path, data: bytes) -> None:
    """Write a file atomically; its folder is created.

    Raises:
        EnvironmentMissing: it cannot be written.
    """
    partial = file.with_name(f"{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(data)
        partial.replace(file)
    except OSError as error:
        raise EnvironmentMissing(f"{file.parent}: cannot write there: {error.strerror or error}") from error
