"""`--ground-truth` of several verbs: a folder with the ground truth, a file of outlines drawn by hand, or both."""

import argparse
from collections.abc import Sequence
from pathlib import Path

_TRUTH_FILES = ("scene.json", "cameras.json", "ground_truth")


def add_ground_truth(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the flag; its help begins with `what`."""
    parser.add_argument(
        "--ground-truth",
        type=Path,
        action="append",
        default=[],
        metavar="DIR|LABELS.json",
        help=f"{what}; may be given twice, for both",
    )


def split_truth(paths: Sequence[Path]) -> tuple[Path | None, Path | None]:
    """Return the folder with the ground truth and the path of the labels; None if not given.

    Labels are a file, or a folder with JSON files (of labelme) and without ground truth.

    Raises:
        UsageError: two of a kind are given.
    """
    from registry.errors import UsageError

    labels = [path for path in paths if _are_labels(path)]
    folders = [path for path in paths if path not in labels]
    for kind, found in (("folders with ground truth", folders), ("files of labels", labels)):
        if len(found) > 1:
            raise UsageError(f"--ground-truth: {found[0]} and {found[1]} are both {kind}; give one of them")
    return (folders[0] if folders else None), (labels[0] if labels else None)


def _are_labels(path: Path) -> bool:
    if path.is_dir():
        return not any((path / name).exists() for name in _TRUTH_FILES) and any(path.glob("*.json"))
    return path.is_file() or path.suffix.lower() == ".json"
