"""A process of the sharing tests: pushes, packs or adds what it is told.

python exchange_worker.py push PLACE BUNDLE...      until all are pushed
python exchange_worker.py pack|add|push FOLDER      forever, in one folder, until it is killed
"""

import itertools
import os
import sys
from pathlib import Path

from registry import SceneBundle, SceneRegistry
from registry.exchange import add_scene, open_place, pack_scene, push_scene
from registry.exchange.readme import write_readme


def push_all(address: str, bundles: list[str]) -> None:
    place = open_place(address)
    for folder in bundles:
        push_scene(SceneBundle.open(Path(folder)), place)
    write_readme(place)


def forever(verb: str, folder: Path) -> None:
    """Repeat a verb with two revisions of a scene in turn. The folder has `one`, `two` (bundles) and their packs."""
    for number in itertools.count():
        name = ("one", "two")[number % 2]
        if verb == "pack":
            pack_scene(SceneBundle.open(folder / name), folder / "packed" / "room.simrecon")
        elif verb == "add":
            add_scene(folder / f"{name}.simrecon", SceneRegistry(folder / "registry"), replace=True)
        else:
            place = folder / "places" / f"{os.getpid()}_{number // 2}"  # a new one for every two revisions
            push_scene(SceneBundle.open(folder / name), open_place(place))
        sys.stdout.write(f"{number}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    if len(sys.argv) == 3:
        forever(sys.argv[1], Path(sys.argv[2]))
    else:
        push_all(sys.argv[2], sys.argv[3:])
