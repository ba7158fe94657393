"""`simrecon check`: tells in seconds whether a film will reconstruct, and what to film differently."""

import argparse
import json
from pathlib import Path

from reconstruction.commands.options import add_verb, write_output

_DESCRIPTION = """Check VIDEO before anything else: sharpness, texture, overlap, parallax, exposure,
directions in view, floor, marker, length. One line of verdict for each, and one of advice where something is wrong."""

_EPILOG = """verdicts:
  pass   as in films that reconstruct
  warn   the film reconstructs, but less well or less completely
  fail   films like this one were not reconstructed

exit codes: 0 fine or warnings only; 1 unlikely to be reconstructed; 2 no such file; 3 it cannot be decoded

examples:
  simrecon check room.mp4
  simrecon check room.mp4 --page room.html    the frames that show the trouble, a map of the directions in view
  simrecon check photos/ --json
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs, "check", "tell in seconds whether a film will reconstruct", _DESCRIPTION, _EPILOG
    )
    parser.add_argument("video", metavar="VIDEO", type=Path, help="a video file or a folder of images")
    parser.add_argument(
        "--page", type=Path, metavar="FILE.html", help="write a page with the frames that show the trouble"
    )
    parser.add_argument("--json", action="store_true", help="print JSON for programs instead of text")
    parser.add_argument("--verbose", action="store_true", help="log the decisions")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the verdicts; return 1 if one is "fail"."""
    from reconstruction.precheck import judge_film
    from registry.errors import UsageError

    page = arguments.page
    if page is not None and (page.is_dir() or not page.absolute().parent.is_dir()):
        raise UsageError(f"--page {page}: give a file name in an existing folder")
    report = judge_film(arguments.video)
    if arguments.json:
        print(json.dumps(report.to_json(), indent=2))
    else:
        print("\n".join(report.text()))
        print("unlikely to be reconstructed" if report.fails else "fine to reconstruct")
    if page is not None:
        from reconstruction.precheck.page import check_page

        write_output(page, check_page(report), "--page")
    return 1 if report.fails else 0
