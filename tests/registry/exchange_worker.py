"""A process of the sharing tests: `python exchange_worker.py PLACE BUNDLE...` pushes until all are pushed."""

import sys
from pathlib import Path

from registry import SceneBundle
from registry.exchange import open_place, push_scene
from registry.exchange.readme import write_readme

if __name__ == "__main__":
    place = open_place(sys.argv[1])
    for folder in sys.argv[2:]:
        push_scene(SceneBundle.open(Path(folder)), place)
    write_readme(place)
