"""`simrecon studio`: a scene in the browser, to look at, to correct, to play and to show."""

import argparse
from pathlib import Path

from reconstruction.commands.environments import run_by_name
from reconstruction.commands.options import add_common, add_verb


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs,
        "studio",
        "look at a scene, correct it and play it, in the browser",
        "Serve scenes as web pages.",
    )
    add = parser.add_argument
    add("scene", metavar="SCENE", nargs="?", help="a scene id; left out: all scenes, as a gallery")
    add("--host", default="127.0.0.1", help="address to serve on (default: 127.0.0.1, this machine only)")
    add("--port", type=int, default=8090, help="port (default: 8090; 0: any free one)")
    add("--export", type=Path, metavar="FILE.html", help="write one self-contained page instead")
    add_common(parser, json=False)
    parser.set_defaults(run=run_by_name("studio.command:run"))
