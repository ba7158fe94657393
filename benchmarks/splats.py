"""Measure `renderer="splats"`: kept-out frames, holes and ghosts while things are moved, time of a step.

Usage:
    python -m benchmarks.splats SCENE VIDEO [--registry DIR] [--steps 200]

Kept-out frames are compared over all pixels at 320x240, once as they are and once after fitting a gain and a bias per
color channel, as the fit's own figures are. A hole is a pixel inside the room's outline (some mesh or Gaussian is
there) of which less than 90 % is covered. A ghost is a Gaussian that is where its thing stood, after that was moved by
more than its size.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy import ndimage

from benchmarks.command import guarded
from benchmarks.machine import describe_machine, machine_line

_SIZE = (320, 240)
_SIZES = ((128, 128), (320, 240))


def main() -> int:
    """Parse the arguments, measure, print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.splats",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", help="id of a scene")
    parser.add_argument("video", type=Path, help="the video that it was made of")
    parser.add_argument("--registry", type=Path, default=None, help="the registry's folder")
    parser.add_argument("--steps", type=int, default=200, help="random steps with things moved")
    arguments = parser.parse_args()
    return guarded("benchmarks.splats", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    print(machine_line(describe_machine()))
    _frames(arguments)
    _moved(arguments)
    _times(arguments)
    return 0


def _make(arguments: argparse.Namespace, size: tuple[int, int], **options: Any) -> Any:
    import simrecon_envs

    sensors = {"width": size[0], "height": size[1]}
    return simrecon_envs.make(arguments.scene, registry=arguments.registry, sensor_configs=sensors, **options)


def _frames(arguments: argparse.Namespace) -> None:
    import av

    with av.open(str(arguments.video)) as video:
        frames = [
            cv2.resize(frame.to_ndarray(format="rgb24"), _SIZE, interpolation=cv2.INTER_AREA).astype(float)
            for frame in video.decode(video=0)
        ]
    for renderer in ("mesh", "splats"):
        env = _make(
            arguments,
            _SIZE,
            renderer=renderer,
            task="none",
            robot_uids="none",
            obs_mode="rgb",
            cameras="capture:999",
        )
        obs, _ = env.reset(seed=0)
        found = env.unwrapped.bundle.scene["cameras"]["frames"]
        kept = [entry["index"] for entry in found if entry.get("held_out")]
        plain, fitted = [], []
        for index in kept:
            shown = obs["sensor_data"][f"capture_{index}"]["rgb"][0].numpy().astype(float)
            plain.append(_psnr(shown, frames[index]))
            fitted.append(_psnr(_exposed(shown, frames[index]), frames[index]))
        env.close()
        print(
            f"{renderer}: {len(kept)} kept-out frames: PSNR {np.mean(plain):.1f} dB (worst {np.min(plain):.1f}), with "
            f"fitted exposure {np.mean(fitted):.1f} dB (worst {np.min(fitted):.1f})"
        )


def _psnr(shown: np.ndarray, frame: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((shown - frame) ** 2)))


def _exposed(shown: np.ndarray, frame: np.ndarray) -> np.ndarray:
    lines = [np.polyfit(shown[..., c].ravel(), frame[..., c].ravel(), 1) for c in range(3)]
    return np.stack([np.polyval(line, shown[..., c]) for c, line in enumerate(lines)], axis=-1).clip(0, 255)


def _moved(arguments: argparse.Namespace) -> None:
    """Step with random actions; every tenth step, teleport a thing, up to 30 cm aside and 10 cm up, turned."""
    import sapien

    env = _make(
        arguments,
        _SIZE,
        renderer="splats",
        obs_mode="rgb+depth+segmentation",
        cameras="workspace,overview",
    )
    env.reset(seed=0)
    base, rng = env.unwrapped, np.random.default_rng(0)
    layer, placed = base._randomizer.layer, base.builder.movable_actors
    watch = _Watch(layer)
    start = {item.id: item.actor._objs[0].pose for item in placed}
    for step in range(arguments.steps):
        if step % 10 == 0 and placed:
            item = placed[rng.integers(len(placed))]
            shift, half = rng.uniform([-0.3, -0.3, 0], [0.3, 0.3, 0.1]), rng.uniform(-1.5, 1.5)
            turn = sapien.Pose(q=[np.cos(half), 0, 0, np.sin(half)])
            pose = start[item.id]
            item.actor._objs[0].set_pose(sapien.Pose(pose.p + shift, (turn * sapien.Pose(q=pose.q)).q))
        env.step(env.action_space.sample())
        watch.look_for_ghosts()
    env.close()
    print(
        f"{arguments.steps} steps, {watch.pictures} pictures: {watch.holes} holes in {watch.pixels} pixels; "
        f"{watch.ghosts} ghosts of {watch.moved} Gaussians of moved things"
    )


class _Watch:
    """Counts holes in every picture of a `SplatLayer`, and ghosts."""

    def __init__(self, layer: Any) -> None:
        self._layer, self._show = layer, layer.show
        self.pictures = self.holes = self.pixels = self.ghosts = self.moved = 0
        layer.show = self._count

    def _count(self, picture: Any, extrinsic: np.ndarray, intrinsics: np.ndarray) -> Any:
        shown = self._show(picture, extrinsic, intrinsics)
        planes, _ = self._layer._rasterizer._images[picture.depth_mm.shape]
        mesh, light = picture.segmentation != 0, planes[4]
        room = np.asarray(ndimage.binary_fill_holes(mesh | (light < 0.5)))
        self.pictures += 1
        self.pixels += int(room.sum())
        self.holes += int((room & ~mesh & (light > 0.1)).sum())
        return shown

    def look_for_ghosts(self) -> None:
        """Count Gaussians of things that were moved by more than their size, and those still at the old place."""
        scene = self._layer._scene
        for row, move in enumerate(self._layer.moves()):
            centers = scene.rows[scene.bodies == row, :3].astype(float)
            if row == 0 or not len(centers):
                continue
            now = centers @ move[:3, :3].T + move[:3, 3]
            low, high = np.percentile(centers, [2, 98], axis=0)
            if np.linalg.norm(now.mean(axis=0) - centers.mean(axis=0)) < np.linalg.norm(high - low):
                continue
            self.moved += len(now)
            self.ghosts += int(((now > low) & (now < high)).all(axis=1).sum())


def _times(arguments: argparse.Namespace) -> None:
    print("milliseconds a step, median of 30: wall (CPU)")
    for size in _SIZES:
        for renderer in ("mesh", "splats"):
            env = _make(arguments, size, renderer=renderer, obs_mode="rgb+depth+segmentation")
            env.reset(seed=0)
            took = []
            for _ in range(33):
                action, wall, cpu = env.action_space.sample(), time.perf_counter(), time.process_time()
                env.step(action)
                took.append((time.perf_counter() - wall, time.process_time() - cpu))
            wall, cpu = 1e3 * np.median(took[3:], axis=0)
            print(f"{size[0]}x{size[1]} {renderer}: {wall:.0f} ({cpu:.0f})")
            env.close()


if __name__ == "__main__":
    raise SystemExit(main())
