"""`simrecon registry rebuild`: repair the index of the registry."""

import argparse
import json

from reconstruction.commands.options import add_common
from registry import open_registry
from registry.plain_text import plain


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb and its actions."""
    text = "repair the registry"
    parser = verbs.add_parser("registry", help=text, description=text[0].upper() + text[1:] + ".")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    text = "rebuild a lost, emptied or damaged index from the scenes' folders; checks every file"
    rebuild = actions.add_parser("rebuild", help=text, description=text[0].upper() + text[1:] + ".")
    add_common(rebuild)
    rebuild.set_defaults(run=run_rebuild)


def run_rebuild(arguments: argparse.Namespace) -> int:
    """Rebuild the index; print the scenes found and the folders left out. Return 1 if a folder was left out."""
    registry = open_registry(arguments.registry)
    records, problems = registry.rebuild()
    if arguments.json:
        found = {"scenes": {record.scene_id: record.revision for record in records}, "left_out": problems}
        print(json.dumps(found, indent=2))
    else:
        for problem in problems:
            print(f"left out: {plain(problem)}")
        print(f"{len(records)} scenes in the index of {registry.where}")
    return 1 if problems else 0
