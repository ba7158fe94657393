"""Runs the physics of a page for a while with a viewer, and prints its memory and its messages.

python tests/studio/playing/soak.py REGISTRY SCENE [SECONDS]
"""

import sys
import time
from pathlib import Path

import numpy as np
import psutil
from viewer import Viewer

from registry import SceneRegistry
from studio.playing.part import PlayingPart
from studio.scene_view import StudioPage

_WARM_S = 20.0  # caches and threads of the first acts


def soak(registry: Path, scene: str, seconds: float, warm_s: float = _WARM_S) -> dict[str, float]:
    """Drop things, drag one in circles and reset, for a while; return memory, in MB, and rates."""
    page = StudioPage(SceneRegistry(registry), scene, parts=(PlayingPart,))
    viewer, physics = Viewer(page.port), page.parts[0].physics
    memory = psutil.Process()
    try:
        _play(physics, warm_s)
        viewer.clear()
        first, began = memory.memory_info().rss / 2**20, time.monotonic()
        received = poses = 0
        rounds, report = 0, began + 60
        while time.monotonic() - began < seconds:
            _play(physics, min(10.0, seconds))
            rounds += 1
            received, poses = received + viewer.received_bytes, poses + len(viewer.moved())
            viewer.clear()
            if time.monotonic() > report:
                report += 60
                now = memory.memory_info().rss / 2**20
                sys.stderr.write(f"{time.monotonic() - began:.0f} s: {now:.1f} MB, {now - first:+.1f}\n")
        passed = time.monotonic() - began
        last = memory.memory_info().rss / 2**20
        return {
            "seconds": passed, "first_mb": first, "grown_mb": last - first, "kb_per_s": received / passed / 1000,
            "poses_per_s": poses / passed, "resets": rounds,
        }  # fmt: skip
    finally:
        viewer.close()
        page.close()


def _play(physics, seconds: float) -> None:
    """Drop everything, then drag one thing in circles; end with a reset."""
    physics.play()
    player = physics._player
    keys = player.session.movable
    for key in keys:
        player.do(lambda session, key=key: session.lift(key, 0.3))
    key, began = keys[0], time.monotonic()
    at = player.session.pose(key)[:3]
    player.do(lambda session: session.grab("soak", key, at))
    while (passed := time.monotonic() - began) < seconds:
        to = at + 0.1 * np.array([np.cos(3 * passed), np.sin(3 * passed), 2.0])
        player.do(lambda session, to=to: session.drag("soak", to))
        time.sleep(0.05)
    player.do(lambda session: session.release("soak"))
    physics.reset()


if __name__ == "__main__":
    sys.stdout.write(
        f"{soak(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]) if len(sys.argv) > 3 else 1800.0)}\n"
    )
