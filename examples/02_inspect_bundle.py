"""Open a scene bundle without a simulator, and print its scene graph and files.

    python examples/02_inspect_bundle.py demo_room

Opening checks the schema and all file hashes, so a bundle from someone else is safe to open.
"""

import argparse
from pathlib import Path

from registry import SceneRegistry


def main() -> None:
    """Print the scene graph and the mesh files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene")
    parser.add_argument("--registry", type=Path, default=None)
    arguments = parser.parse_args()

    bundle = SceneRegistry(arguments.registry).load(arguments.scene, check_hashes=True)
    names = {b.id: b.label for b in bundle.base} | {o.id: f"{o.label} {o.id}" for o in bundle.objects}
    children: dict[int, list[int]] = {}
    for edge in bundle.edges:
        children.setdefault(edge.parent, []).append(edge.child)

    def show(number: int, depth: int) -> None:
        print("  " * depth + names[number])
        for child in children.get(number, ()):
            show(child, depth + 1)

    for base in bundle.base:
        show(base.id, 0)
    for item in bundle.objects:
        print(f"{names[item.id]}: {bundle.resolve(item.visual)}")


if __name__ == "__main__":
    main()
