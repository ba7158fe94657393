"""`simrecon studio`: a scene in the browser, to look at, to correct, to play and to show."""

import argparse
from pathlib import Path

from reconstruction.commands.environments import run_by_name
from reconstruction.commands.options import add_common, add_verb, path_or_address, whole_number

_DESCRIPTION = """Serve scenes as web pages: look at SCENE from all sides, compare it with the photographs, see what was
seen and what was guessed, correct it and play it. Without SCENE: all scenes, as a gallery. With --export: write one
self-contained page that opens from disk, to send to somebody. Needs viser: pip install "simrecon[studio]"."""

_EPILOG = """in the page:
  mouse        drag to look around, right-drag to move, scroll to come nearer; click an object, shift-click another
  Scene        how surfaces look (textures, Gaussians, seen or guessed, collision parts), names, cameras, relations,
               free space, scale; a panel about the selected object; photographs over the scene, with a slider

who can see it:
  by default   only programs on this machine; from another one: ssh -L 8090:127.0.0.1:8090 THIS_MACHINE
  --host ADDR  the network, too. The address that is printed has a token; without it nothing is answered. The
               connection is not encrypted: put it behind a proxy with TLS where others listen

examples:
  simrecon studio                                  gallery of all scenes, at http://127.0.0.1:8090/
  simrecon studio scene0001                        one scene
  simrecon studio scene0001 --export room.html     one file, at most 25 MB for a usual scene
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs, "studio", "look at a scene in the browser, correct it, play it", _DESCRIPTION, _EPILOG
    )
    add = parser.add_argument
    add("scene", metavar="SCENE", nargs="?", help="a scene id, for example scene0001; left out: all of them")
    add("--export", type=Path, metavar="FILE.html", help="write one self-contained page, and serve nothing")
    add(
        "--host",
        default="127.0.0.1",
        metavar="ADDR",
        help="address to listen on (default: 127.0.0.1, this machine only); beyond that, visitors need the token",
    )
    add(
        "--port",
        type=whole_number(0, 65_535),
        metavar="N",
        help="port (default: 8090 or the next free one; 0: any free one)",
    )
    add(
        "--video",
        type=path_or_address,
        metavar="FILE",
        help="the film of the scene, if it is no longer where it was",
    )
    add(
        "--work-dir",
        type=path_or_address,
        metavar="DIR",
        help="folder of the stage cache, as given to reconstruct; results at an address are downloaded",
    )
    add("--overrides", type=Path, metavar="FILE", help="file of corrections (default: that of the last run)")
    add_common(parser, json=False)
    parser.set_defaults(run=run_by_name("studio.command:run"))
