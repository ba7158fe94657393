"""`simrecon marker`: writes a fiducial marker to print; filmed in the room, it gives the metric scale."""

import argparse
from pathlib import Path

from reconstruction.commands.options import add_verb, number, whole_number


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs,
        "marker",
        "write a marker to print; filmed, it gives the scene its true size",
        "Write an A4 sheet with an AprilTag in its true size. Print it at 100 %, measure the black square, "
        "lay it flat in the room, and pass its side to `simrecon reconstruct --marker-size`.",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="marker.pdf or marker.png")
    parser.add_argument(
        "--size",
        type=number(0.001, 5),
        default=0.15,
        metavar="METRES",
        help="side of the black square (default 0.15)",
    )
    parser.add_argument(
        "--id", type=whole_number(0), default=0, metavar="N", help="number of the marker (default 0)"
    )
    parser.add_argument("--verbose", action="store_true", help="log what is decided")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the sheet, and print how to use it."""
    from reconstruction.world.config import WorldConfig
    from reconstruction.world.marker_print import MarkerSheet, write_marker

    sheet = MarkerSheet(WorldConfig().marker_dictionaries[0], arguments.id, arguments.size)
    write_marker(sheet, arguments.out)
    print(f"{arguments.out}: {sheet.caption[0]}\nThen film it flat in the room, and: {sheet.caption[1]}")
    return 0
