"""What the clients of HTTP services share: pauses that servers ask for, excerpts for messages, files written whole."""

import os
from pathlib import Path

import requests

from registry.errors import EnvironmentMissing

_EXCERPT = 200


def asked_pause(response: requests.Response) -> float:
    """Return how many seconds a server asks to wait (`Retry-After`), 0 where it does not say."""
    try:
        return max(0.0, float(response.headers.get("Retry-After", 0)))
    except ValueError:  # a date
        return 0.0


def excerpt(text: str) -> str:
    """Return the beginning of a reply, on one line."""
    words = " ".join(text.split())
    return words if len(words) <= _EXCERPT else words[:_EXCERPT] + "..."


def write_whole(file: Path, data: bytes) -> None:
    """Write a file so that it is there whole or not at all; its folder is made.

    Raises:
        EnvironmentMissing: it cannot be written.
    """
    partial = file.with_name(f"{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(data)
        partial.replace(file)
    except OSError as error:
        raise EnvironmentMissing(
            f"{file.parent}: cannot keep answers there: {error.strerror or error}"
        ) from error
