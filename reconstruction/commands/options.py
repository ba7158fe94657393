"""Arguments that several verbs share, and the error of an output folder that cannot be written."""

import argparse
import math
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from registry.errors import EnvironmentMissing, SimReconError
from registry.files import write_whole
from registry.roots import is_address, registry_folder


def add_verb(
    verbs: argparse._SubParsersAction, name: str, summary: str, description: str, epilog: str | None = None
) -> argparse.ArgumentParser:
    """Add a verb. Its epilog is shown as it is; its description too, if it has several lines."""
    if "\n" not in description:
        description = textwrap.fill(description, 100)
    raw = argparse.RawDescriptionHelpFormatter
    return verbs.add_parser(name, help=summary, description=description, epilog=epilog, formatter_class=raw)


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the argument SCENE."""
    parser.add_argument("scene", metavar="SCENE", help="a scene id, for example scene0001")


def add_common(parser: argparse.ArgumentParser, *, json: bool = True) -> None:
    """Add --registry, --verbose and, if asked for, --json."""
    parser.add_argument(
        "--registry",
        type=_registry,
        metavar="DIR|URL",
        help="folder or address (s3://bucket/scenes) of the registry (default: $SIMRECON_REGISTRY, else "
        "$SIMRECON_HOME/registry, else ~/.simrecon/registry)",
    )
    parser.add_argument("--verbose", action="store_true", help="log the decisions of each stage")
    if json:
        parser.add_argument("--json", action="store_true", help="print JSON for programs instead of text")


def path_or_address(text: str) -> Path | str:
    """Return an address of fsspec (`s3://bucket/key`) as it is, anything else as a path; a type for argparse."""
    return text if is_address(text) else Path(text)


def _registry(text: str) -> Path:
    try:
        return registry_folder(text)
    except SimReconError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


SEEDS = (0, 2**32 - 1)


def whole_number(low: int, high: int = 10**9) -> Callable[[str], int]:
    """Return the `type` of an argument that is a whole number from `low` to `high`."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = None
        if value is None or not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text[:80]!r} is not a whole number from {low} to {high}")
        return value

    return parse


def number(low: float, high: float) -> Callable[[str], float]:
    """Return the `type` of an argument that is a finite number from `low` to `high`."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text[:80]!r} is not a number from {low:g} to {high:g}")
        return value

    return parse


@contextmanager
def output_errors(out: Path | None = None) -> Iterator[None]:
    """Turn an `OSError` from writing pictures into an `EnvironmentMissing` that names --out."""
    try:
        yield
    except OSError as error:
        raise EnvironmentMissing(
            f"cannot write {error.filename or out or 'the output'}: {error.strerror}; choose another --out"
        ) from error


def write_output(path: Path, text: str, flag: str) -> None:
    """Write a text file that the user named with `flag`: whole or not at all, unless it is a device or a pipe.

    Raises:
        EnvironmentMissing: it cannot be written.
    """
    try:
        if path.exists() and not path.is_file():
            with path.open("w", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write(text)
        else:
            write_whole(path, text.encode("utf-8", "backslashreplace"))
    except OSError as error:
        raise EnvironmentMissing(
            f"{flag} {path}: cannot be written: {error.strerror}; nothing was written. Choose another place with {flag}"
        ) from error
