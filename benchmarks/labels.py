"""Are coarse labels right as often as they say? Generated rooms, cut by the default settings, against their true names.

Usage: python -m benchmarks.labels [--rooms 8] [--seed 200]

Rooms are filmed in few small frames; cameras are true, depth has 0.4 % of noise: what is measured is the cut and its
labels. One room takes about 20 s of one core. The table goes into docs/instances.md.
"""

import argparse
from collections import Counter

import numpy as np

from benchmarks.label_calibration import UNKNOWN, Guess, overconfidence, reliability
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import DepthMaps, InstanceSet, PosedFrames, VideoSource
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.surface import SurfaceConfig, fuse_surface
from synthetic.benchmark_capture import CaptureSpec, stage
from synthetic.film import film_room, render_truth
from synthetic.procedural import RoomSpec

SIZES = (16, 24, 30, 12, 22, 24, 30, 16)  # things a room, in turn
_DEPTH_NOISE, _SAME = 0.004, 0.3


def guesses_in_room(seed: int, objects: int) -> list[Guess]:
    """Film a generated room, cut it, and return what its things were called beside what they are."""
    room = RoomSpec(seed=seed, objects=objects, stacks=0.25, textureless_share=0.2)
    spec = CaptureSpec(room, frames=16, width=320, height=240, path="two_heights", seed=seed)
    scene = stage(spec)
    camera, poses = scene.camera, scene.world_from_camera
    images = film_room(scene.film_set, camera, poses, spec.sensor(), seed=seed)
    truth = [render_truth(scene.film_set, camera, pose) for pose in poses]
    true_ids = np.stack([ids for _, ids in truth])
    noise = 1 + _DEPTH_NOISE * np.random.default_rng(seed).standard_normal(true_ids.shape)
    depth = (np.stack([z for z, _ in truth]) * noise).astype(np.float32)
    posed = _posed(spec, camera, images, poses)
    maps = DepthMaps(camera, depth, np.where(depth > 0, 2, 0).astype(np.uint8))
    surface = fuse_surface(posed, maps, SurfaceConfig(voxel_size_m=0.011), progress=NO_PROGRESS)
    found = find_instances(posed, maps, surface, InstancesConfig(), progress=NO_PROGRESS)
    names = {e.id: "" if e.base else e.label for e in scene.room.entities}
    return compared(found, true_ids, names)


def compared(found: InstanceSet, true_ids: np.ndarray, names: dict[int, str]) -> list[Guess]:
    """Put the true name beside each label; a thing whose pixels are mostly others' (IoU under 0.3) has none."""
    out = []
    for item in found.objects:
        mine = found.id_maps == item.id
        shown = np.bincount(true_ids[mine])
        best = int(np.argmax(shown))
        iou = shown[best] / (mine.sum() + (true_ids == best).sum() - shown[best])
        out.append(Guess(item.label, item.label_confidence, names.get(best, "") if iou >= _SAME else ""))
    return out


def _posed(spec: CaptureSpec, camera, images: np.ndarray, poses: np.ndarray) -> PosedFrames:
    count = len(images)
    rows = np.arange(count, dtype=np.int32)
    source = VideoSource("room", "0" * 64, camera.width, camera.height, spec.fps, count, count / spec.fps)
    return PosedFrames(
        source, camera, images, rows, rows / spec.fps, poses, np.ones(count, np.float32), images[:0], rows[:0],
        np.zeros(0), poses[:0], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32),
        np.zeros((0, 2), np.int32), count, True, 0.3,
    )  # fmt: skip


def table(guesses: list[Guess]) -> str:
    """Return the reliability table and the table by label as Markdown."""
    said = sum(g.label != UNKNOWN for g in guesses)
    lines = ["| confidence | things | mean confidence | right |", "| --- | --- | --- | --- |"]
    lines += [
        f"| {row.low:.2f} to {row.high:.2f} | {row.count} | {row.confidence:.2f} | {row.right:.2f} |"
        for row in reliability(guesses)
    ]
    over = overconfidence(guesses)
    lines.append(
        f"\n{said} of {len(guesses)} things have a label; confidence less share right: {over:+.2f}\n"
    )
    lines += ["| label | things | right | else they are |", "| --- | --- | --- | --- |"]
    for label, count in Counter(g.label for g in guesses).most_common():
        mine = [g for g in guesses if g.label == label]
        wrong = Counter(g.truth or "no true thing" for g in mine if not g.right).most_common(5)
        share = "–" if label == UNKNOWN else f"{sum(g.right for g in mine) / count:.2f}"
        lines.append(f"| {label} | {count} | {share} | {', '.join(f'{n} {t}' for t, n in wrong)} |")
    return "\n".join(lines)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=8)
    parser.add_argument("--seed", type=int, default=200, help="of the first room")
    options = parser.parse_args()
    guesses = []
    for k in range(options.rooms):
        guesses += guesses_in_room(options.seed + k, SIZES[k % len(SIZES)])
    print(table(guesses))


if __name__ == "__main__":
    main()
