"""`simrecon export`: writes a scene for MuJoCo, Isaac Sim, PyBullet, Blender."""

import argparse
import json
from pathlib import Path

from reconstruction.commands.options import add_common, add_scene, add_verb
from registry import open_registry

_FORMATS = ("mjcf", "urdf", "usd", "glb")  # reconstruction.exports.FORMATS, not imported for --help

_EPILOG = """formats:
  mjcf   scene.xml for MuJoCo: objects rest as in the scene; exact masses and inertias
  urdf   scene.urdf with everything in place, and one file for each object: PyBullet, ROS, yourdfpy
  usd    scene.usd with UsdPhysics: Isaac Sim, usdview (needs: pip install "simrecon[exports]")
  glb    scene.glb with a named node for each object: Blender, three.js, any viewer

examples:
  simrecon export my_room --to mjcf --out my_room_mjcf
  python -m mujoco.viewer --mjcf=my_room_mjcf/scene.xml
  simrecon export my_room --to urdf,usd,glb --out my_room_export

Collision shapes are the convex pieces of the scene. Objects can move unless they are fixed in the scene; attached
objects are fixed to their parent. Units are metres and kilograms; +z is up (+y in scene.glb, as in every glTF).
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs,
        "export",
        "write a scene for MuJoCo (mjcf), Isaac Sim (usd), PyBullet and ROS (urdf), Blender (glb)",
        "Write a scene in formats of other simulators and tools, with meshes, textures, masses, "
        "inertias, friction and collision shapes.",
        _EPILOG,
    )
    add_scene(parser)
    parser.add_argument(
        "--to",
        type=_formats,
        action="extend",
        required=True,
        metavar="FORMAT[,FORMAT]",
        help=f"one or several of {', '.join(_FORMATS)}, separated by commas",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="new folder, or one with an earlier export"
    )
    add_common(parser)
    parser.set_defaults(run=run)


def _formats(text: str) -> list[str]:
    names = text.split(",")
    unknown = [name for name in names if name not in _FORMATS]
    if unknown:
        raise argparse.ArgumentTypeError(f"there is no format {unknown[0]!r}, only {', '.join(_FORMATS)}")
    return names


def run(arguments: argparse.Namespace) -> int:
    """Export a scene, and print the main file of each format."""
    from reconstruction.exports import export_scene

    bundle = open_registry(arguments.registry).load(arguments.scene)
    result = export_scene(bundle, list(dict.fromkeys(arguments.to)), arguments.out)
    if arguments.json:
        files = {name: str(path) for name, path in result.main.items()}
        print(json.dumps({"files": files, "bytes": result.bytes, "notes": list(result.notes)}, indent=2))
        return 0
    for note in result.notes:
        print(f"note: {note}")
    for name, path in result.main.items():
        print(f"{name:<5} {path}")
    print(f"{result.files} files, {result.bytes / 1e6:.1f} MB, in {result.folder}")
    return 0
