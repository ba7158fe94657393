"""Advice on what to film again: from `simrecon check`, from frames without a pose, and from how much was seen."""

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil

from reconstruction.core.types import AssetSet, PosedFrames
from registry.geometry import split_similarity

LITTLE_SEEN = 0.4  # of an object's surface; a thing filmed from one side only shows less (docs/assets.md)
_NICE = 15
_COMPASS = ("+x", "+x +y", "+y", "-x +y", "-x", "-x -y", "-y", "+x -y")


class FilmCheck:
    """`simrecon check` in a process of low priority, so that it takes little time from the reconstruction."""

    def __init__(self, video: Path, on_advice: Callable[[list[str]], None]) -> None:
        """Start; `on_advice` receives one line for each property that warns or fails, and is called in a thread."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "reconstruction.cli", "check", str(video), "--json"],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        if sys.platform != "win32":
            psutil.Process(self._process.pid).nice(_NICE)
        self._on_advice = on_advice
        threading.Thread(target=self._wait, name="studio-check", daemon=True).start()

    def stop(self) -> None:
        """End the process."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()

    def _wait(self) -> None:
        text, _ = self._process.communicate()
        try:
            lines = json.loads(text)["lines"]
        except (ValueError, KeyError):  # it was ended, or the film cannot be read
            return
        self._on_advice(
            [f"{x['name']}: {x['text']}. {x['advice']}".strip() for x in lines if x["status"] != "pass"]
        )


def advice_on_poses(posed: PosedFrames) -> list[str]:
    """Return a line where keyframes got no pose: between which times to film more slowly."""
    lost = posed.chosen_frames - len(posed.images)
    if lost <= 0:
        return []
    text = f"{lost} of {posed.chosen_frames} keyframes have no pose"
    if posed.ordered and len(posed.times_s) > 1:
        gap = int(np.argmax(np.diff(posed.times_s)))
        text += f"; the longest gap is from {posed.times_s[gap]:.1f} s to {posed.times_s[gap + 1]:.1f} s"
    return [f"{text}. Film that part again, more slowly and with more overlap"]


def advice_on_things(assets: AssetSet, posed: PosedFrames, world_from_sfm: np.ndarray) -> list[str]:
    """Return a line for each object of which little was seen, with the side that the cameras did not visit.

    Args:
        assets: Objects with the share of their surface that was seen.
        posed: Cameras, in the space `sfm`.
        world_from_sfm: Similarity (4, 4).
    """
    _, rotation, _ = split_similarity(world_from_sfm)
    centers = posed.world_from_camera[:, :3, 3] @ world_from_sfm[:3, :3].T + world_from_sfm[:3, 3]
    forward = posed.world_from_camera[:, :3, 2] @ rotation.T
    half = np.arctan2(0.5 * posed.camera.width, posed.camera.fx)
    out = []
    for item in sorted(assets.objects, key=lambda o: o.provenance.observed_fraction):
        seen = item.provenance.observed_fraction
        if seen < LITTLE_SEEN:
            side = unvisited_side(item.world_from_object[:3, 3], centers, forward, float(half))
            out.append(
                f"{item.label} {item.id}: {seen:.0%} of its surface was seen. Film it from its {side} side, too"
            )
    return out


def unvisited_side(at: np.ndarray, centers: np.ndarray, forward: np.ndarray, half_view_rad: float) -> str:
    """Return the side of a point, as world axes, in the middle of the widest gap between the cameras that look at it.

    Args:
        at: The point (3,), world.
        centers: Cameras (n, 3), world.
        forward: Their unit viewing directions (n, 3), world.
        half_view_rad: Half of their field of view; cameras that do not have the point in it are ignored.
    """
    towards = at - centers
    distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
    looks = np.einsum("ij,ij->i", towards, forward) > np.cos(half_view_rad) * distance
    from_point = -towards[looks] if looks.any() else -towards
    yaws = np.sort(np.arctan2(from_point[:, 1], from_point[:, 0]))
    gaps = np.diff(np.append(yaws, yaws[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    middle = yaws[widest] + gaps[widest] / 2
    return _COMPASS[round(middle / (np.pi / 4)) % 8]
