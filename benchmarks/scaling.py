"""How cost grows: frames to surface with the number of keyframes, and the rasterizer with the number of Gaussians.

Usage:
    python -m benchmarks.scaling --video VIDEO [--keyframes 24,48,72,96] [--out docs/images/scaling.png] [--json FILE]

Run it on a quiet machine. CPU time is of all cores together. The first pass compiles what is not compiled yet and is
thrown away. VIDEO: any; `python -m benchmarks.generate --name easy05 --out DIR` makes one.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from reconstruction.cache import StageStore
from reconstruction.config import PipelineConfig
from reconstruction.pipeline import STAGE_NAMES
from reconstruction.runner import Run
from registry.errors import SimReconError, UsageError

UNTIL = "surface"
GAUSSIANS = (5_000, 10_000, 25_000, 50_000, 75_000, 100_000)
_SIZE = (320, 240)
_REPEATS = 15


def stage_costs(video: Path, keyframes: int, work_dir: Path) -> dict[str, dict[str, float]]:
    """Reconstruct with a number of keyframes up to the surface; return wall and CPU seconds by stage."""
    config = PipelineConfig()
    config = replace(config, frames=replace(config.frames, min_keyframes=keyframes, max_keyframes=keyframes))
    run = Run(video, config, StageStore(work_dir))
    run.execute(UNTIL)
    costs = {name: {"wall_s": u.wall_s, "cpu_s": u.cpu_s} for name, u in run.usage.items()}
    costs["keyframes"] = len(run.results["poses"].images)
    return costs


def rasterizer_costs(counts: tuple[int, ...]) -> list[dict[str, float]]:
    """Time forward and backward (derivatives of everything) at 320x240 on scenes of different size."""
    from reconstruction.gaussians.config import GaussiansConfig
    from reconstruction.gaussians.fit import median_depth_of, settings_of
    from reconstruction.gaussians.rasterizer import rasterize, rasterize_backward
    from reconstruction.gaussians.scratch import Scratch
    from reconstruction.gaussians.seeding import seed_from_depth
    from synthetic.capture import make_test_capture

    capture = make_test_capture()
    settings = settings_of(GaussiansConfig(), median_depth_of(capture.depth))
    camera = capture.posed.camera.resized(*_SIZE)
    rng = np.random.default_rng(0)
    gradients = rng.normal(size=(_SIZE[1], _SIZE[0], 9)).astype(np.float32)
    scratch, out = Scratch(), []
    for count in counts:
        seeds = seed_from_depth(capture.posed, capture.depth, count, 0.7)
        times = []
        for repeat in range(_REPEATS + 2):
            pose = capture.posed.world_from_camera[repeat % len(capture.posed.images)]
            began = time.perf_counter()
            image = rasterize(seeds, camera, pose, settings, scratch=scratch)
            rasterize_backward(image, gradients, scratch=scratch)
            times.append(time.perf_counter() - began)
        out.append({"gaussians": len(seeds), "ms": 1e3 * float(np.median(times[2:]))})
    return out


def line_fit(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Return slope, intercept and R^2 of the least-squares line."""
    slope, intercept = np.polyfit(x, y, 1)
    rest = y - (slope * x + intercept)
    return float(slope), float(intercept), float(1 - rest.var() / max(y.var(), 1e-30))


def draw(by_frames: list[dict], by_gaussians: list[dict], path: Path) -> None:
    """Plot both, each with its line."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 4.2), layout="constrained")
    x = np.array([row["keyframes"] for row in by_frames], float)
    names = [name for name in STAGE_NAMES if name in by_frames[0]]
    stack = np.array([[row[name]["cpu_s"] for row in by_frames] for name in names])
    left.stackplot(x, stack, labels=names, alpha=0.85)
    total = stack.sum(axis=0)
    slope, intercept, fit = line_fit(x, total)
    left.plot(x, slope * x + intercept, "k--", lw=1)
    left.plot(
        x, [sum(row[name]["wall_s"] for name in names) for row in by_frames], "k.-", label="wall time, all"
    )
    left.set(xlabel="keyframes", ylabel="seconds of CPU", ylim=(0, None), xlim=(x.min(), x.max()))
    left.set_title(
        f"frames to surface: {slope:.2f} s a keyframe + {intercept:.0f} s, R² {fit:.3f}", fontsize=10
    )
    left.legend(fontsize=8, loc="upper left")
    x = np.array([row["gaussians"] for row in by_gaussians], float) / 1000
    y = np.array([row["ms"] for row in by_gaussians])
    slope, intercept, fit = line_fit(x, y)
    right.plot(x, y, "o", color="tab:purple")
    right.plot(x, slope * x + intercept, "k--", lw=1)
    right.set(xlabel="thousand Gaussians", ylabel="ms, forward and backward", ylim=(0, None), xlim=(0, None))
    right.set_title(
        f"rasterizer at 320×240: {slope:.2f} ms a thousand + {intercept:.0f} ms, R² {fit:.3f}", fontsize=10
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.scaling",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--video", type=Path, required=True, help="what to reconstruct")
    parser.add_argument(
        "--keyframes", default="24,48,72,96", help="numbers of keyframes (default 24,48,72,96)"
    )
    parser.add_argument("--out", type=Path, default=Path("docs/images/scaling.png"), help="the plot")
    parser.add_argument("--json", type=Path, help="the figures")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Measure, plot and print."""
    options = build_parser().parse_args(arguments)
    try:
        if not options.video.exists():
            raise UsageError(f"{options.video}: no such file")
        try:
            sizes = sorted({int(x) for x in options.keyframes.split(",")})
        except ValueError:
            raise UsageError(f"--keyframes {options.keyframes}: expected numbers such as 24,48") from None
        if len(sizes) < 2:
            raise UsageError("--keyframes: at least two different numbers make a line")
        by_gaussians = rasterizer_costs(GAUSSIANS)
        by_frames = []
        with tempfile.TemporaryDirectory() as folder:
            for number, size in enumerate([sizes[0], *sizes]):  # the first pass compiles
                costs = stage_costs(options.video, size, Path(folder) / str(number))
                if number:
                    by_frames.append(costs)
        draw(by_frames, by_gaussians, options.out)
    except SimReconError as error:
        print(f"benchmarks.scaling: {error}", file=sys.stderr)
        return error.exit_code
    if options.json:
        options.json.write_text(json.dumps({"frames": by_frames, "gaussians": by_gaussians}, indent=1) + "\n")
    for row in by_frames:
        wall = sum(v["wall_s"] for k, v in row.items() if k != "keyframes")
        cpu = sum(v["cpu_s"] for k, v in row.items() if k != "keyframes")
        print(f"{row['keyframes']:4d} keyframes: {wall:6.1f} s wall, {cpu:6.1f} s CPU, frames to surface")
    for row in by_gaussians:
        print(f"{row['gaussians']:7d} Gaussians: {row['ms']:6.1f} ms forward and backward at 320x240")
    print(f"plot: {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
