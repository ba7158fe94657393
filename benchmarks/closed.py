"""Count the meshes of scenes that are not closed for readers who know vertices by their positions.

    python -m benchmarks.closed FOLDER...

Every `scene.json` below the folders is a scene. Of its objects, visual.glb and each collision part is loaded, vertices
in the same place become one, whatever their texture coordinates and normals, and each edge must belong to exactly two
triangles, run one way by the one and the other way by the other. Floor, walls and ceiling are sheets, and not counted.
Exit code 1 where a mesh is not closed.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.command import guarded
from registry.errors import UsageError


def open_edges(path: Path) -> int:
    """Return how many edges of a mesh file are not shared by exactly two triangles of opposite ways."""
    mesh = trimesh.load(path, force="mesh", process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    upward = edges[:, 0] < edges[:, 1]
    lines, index = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    ways = [np.bincount(index.ravel()[rows], minlength=len(lines)) for rows in (upward, ~upward)]
    return int(((ways[0] != 1) | (ways[1] != 1)).sum())


def object_meshes(scene: Path) -> Iterator[Path]:
    """Yield the mesh files of the objects of a scene.json: what is drawn, then what collides."""
    for item in json.loads(scene.read_text())["objects"]:
        yield scene.parent / item["visual"]
        yield from (scene.parent / part for part in item["collision"])


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.closed",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="scenes, or what holds some")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, 1 where a mesh is open, or the exit code of what is wrong."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks.closed", lambda: _run(arguments.folders))


def _run(folders: Sequence[Path]) -> int:
    scenes = sorted({path.resolve() for folder in folders for path in folder.rglob("scene.json")})
    if not scenes:
        raise UsageError(
            f"no scene.json below {', '.join(map(str, folders))}: name bundles or a registry's scenes"
        )
    looks = parts = bad = 0
    for scene in scenes:
        for path in object_meshes(scene):
            looks, parts = looks + (path.suffix == ".glb"), parts + (path.suffix == ".obj")
            count = open_edges(path)
            if count:
                bad += 1
                print(f"{path}: {count} edges are not shared by exactly two triangles")
    print(f"{len(scenes)} scenes: {looks} visual meshes and {parts} collision parts, {bad} not closed")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
