"""`simrecon export`: a scene for MuJoCo, Isaac Sim, PyBullet, Blender."""

import argparse
import json
from pathlib import Path

from registry import SceneRegistry

_FORMATS = (
    "mjcf",
    "urdf",
    "usd",
    "glb",
)  # as reconstruction.exports.FORMATS, which is not imported for --help

_EPILOG = """formats:
  mjcf   scene.xml for MuJoCo: things rest as they do in the scene; exact masses and inertias
  urdf   scene.urdf with everything at its place, and one file an object: PyBullet, ROS, yourdfpy
  usd    scene.usd with UsdPhysics: Isaac Sim, usdview (needs: pip install "simrecon[exports]")
  glb    scene.glb, every thing a named node: Blender, three.js, any viewer

examples:
  simrecon export my_room --to mjcf --out my_room_mjcf
  python -m mujoco.viewer --mjcf=my_room_mjcf/scene.xml
  simrecon export my_room --to urdf,usd,glb --out my_room_export

Collision shapes are the convex pieces of the scene; objects can move unless the scene has them fixed; what hangs
on something is fixed to it. Units are metres and kilograms, +z is up (in scene.glb +y, as glTF has it).
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Register the verb."""
    from reconstruction.commands.options import add_common

    parser = verbs.add_parser(
        "export",
        help="write a scene for MuJoCo (mjcf), Isaac Sim (usd), PyBullet and ROS (urdf), Blender (glb)",
        description="Write a scene in the formats of other simulators and tools, with meshes, textures, masses, "
        "inertias, friction and collision shapes.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", metavar="SCENE", help="a scene id, for example scene0001")
    parser.add_argument(
        "--to",
        type=_formats,
        action="extend",
        required=True,
        metavar="FORMAT[,FORMAT]",
        help=f"one or several of {', '.join(_FORMATS)}, with commas between them",
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="a new or empty folder, or one with an export of the same scene",
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
    """Write the formats and say which file to open."""
    from reconstruction.exports import export_scene

    bundle = SceneRegistry(arguments.registry).load(arguments.scene)
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
