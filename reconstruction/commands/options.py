"""Flags that several verbs share."""

import argparse
from pathlib import Path


def add_common(parser: argparse.ArgumentParser, *, json: bool = True) -> None:
    """Add the flags that several verbs share."""
    parser.add_argument(
        "--registry",
        type=Path,
        metavar="DIR",
        help="where scenes live (default: $SIMRECON_HOME/registry, or ~/.simrecon/registry)",
    )
    parser.add_argument("--verbose", action="store_true", help="log what each stage decides")
    if json:
        parser.add_argument("--json", action="store_true", help="print JSON for programs instead of text")
