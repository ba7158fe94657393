"""Film generated rooms, run the pipeline's depth on them, and keep what it measured beside the truth.

    python -m priors.dataset OUT --rooms 200 [--split train] [--seed 0] [--frames 20] [--photographs DIR]
                             [--keep costs winner depth gaussians surface] [--cameras noisy|true] [--processes 2]

Every room is a folder `OUT/<split>/<number>` of arrays (see `priors.samples.ARRAYS`), written whole or not at all: kill
and start again at any time. `manifest.json` lists every room with its families and the SHA-256 of its arrays.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import shutil
import sys
import time
import traceback
from dataclasses import replace
from pathlib import Path

import numpy as np

from priors.rooms import SPLITS, Film, Sources, draw_film
from reconstruction.core.types import DepthMaps, PosedFrames
from reconstruction.depth import DepthConfig
from registry.errors import InputError, UsageError
from synthetic.capture import posed_capture
from synthetic.film import film_room, render_truth

WIDTH, HEIGHT = 480, 360
KEEP = ("costs", "winner", "depth", "gaussians", "surface")


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = _parser()
    options = parser.parse_args(arguments)
    Sources.check_options(parser, options, [options.split])
    rooms = [(options, number) for number in range(options.seed, options.seed + options.rooms)]
    folder = options.out / options.split
    missing = [job for job in rooms if not (folder / f"{job[1]:05d}" / "room.json").is_file()]
    print(f"{folder}: {len(rooms) - len(missing)} of {len(rooms)} rooms are there", flush=True)
    started, failed = time.perf_counter(), 0
    context = multiprocessing.get_context("spawn")
    with context.Pool(options.processes, _prepare_process, maxtasksperchild=20) as pool:
        for done, line in enumerate(pool.imap_unordered(_make_room, missing), start=1):
            failed += "FAILED" in line
            each = (time.perf_counter() - started) / done
            print(
                f"{done}/{len(missing)} {line} ({(len(missing) - done) * each / 60:.0f} min left)", flush=True
            )
    write_manifest(options.out)
    return 1 if failed else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m priors.dataset", description=__doc__.split("\n\n")[0])
    parser.add_argument("out", type=Path, help="folder of the dataset")
    parser.add_argument(
        "--split", choices=SPLITS, default="train", help="which families (default: %(default)s)"
    )
    parser.add_argument("--rooms", type=int, default=100, help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="number of the first room (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=20, help="keyframes a room (default: %(default)s)")
    Sources.add_options(parser)
    parser.add_argument(
        "--keep",
        nargs="+",
        choices=KEEP,
        default=["costs", "depth"],
        help="which arrays (default: costs depth)",
    )
    parser.add_argument(
        "--cameras", choices=("noisy", "true"), default="noisy",
        help="noisy: moved by what estimated cameras are typically off by (default)",
    )  # fmt: skip
    parser.add_argument(
        "--no-predictions",
        action="store_true",
        help="no predicted depth, a sixth faster; what is fitted to it does not know prior=both",
    )
    parser.add_argument("--processes", type=int, default=2, help="rooms at once (default: %(default)s)")
    return parser


def _prepare_process() -> None:
    """One thread a process, and patience with everything else on the machine."""
    import cv2
    import numba

    os.nice(10)
    os.environ["OMP_NUM_THREADS"] = "1"
    numba.set_num_threads(1)
    cv2.setNumThreads(1)


def _make_room(job: tuple[argparse.Namespace, int]) -> str:
    options, number = job
    try:
        return _write_room(options, number)
    except (InputError, UsageError) as error:  # a draw that no layout fits: the next number is another room
        return f"{options.split}/{number:05d}: left out, {error}"
    except Exception:  # one room's fault must not end a night's work
        return f"{options.split}/{number:05d}: FAILED\n{traceback.format_exc()}"


def _write_room(options: argparse.Namespace, number: int) -> str:
    final = options.out / options.split / f"{number:05d}"
    part = final.with_name(final.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    started = time.process_time()
    film = draw_film(options.split, number, Sources.of(options))
    arrays = measure_film(
        film, options.frames, options.cameras, set(options.keep), not options.no_predictions
    )
    digests = {}
    for name, array in arrays.items():
        np.save(part / f"{name}.npy", array)
        digests[name] = hashlib.sha256((part / f"{name}.npy").read_bytes()).hexdigest()
    about = {
        "split": options.split, "number": number, "frames": options.frames, "cameras": options.cameras,
        "keep": sorted(options.keep), "film": film.describe(), "sha256": digests,
    }  # fmt: skip
    (part / "room.json").write_text(json.dumps(about, indent=1) + "\n")
    shutil.rmtree(final, ignore_errors=True)
    part.rename(final)
    return f"{options.split}/{number:05d}: {time.process_time() - started:.0f} s of one core"


def film_frames(film: Film, frames: int, cameras: str) -> tuple[PosedFrames, np.ndarray]:
    """Film a stretch of a walk; return the frames with "noisy" or "true" cameras, and the true ones (n, 4, 4)."""
    camera, path = film.camera(WIDTH, HEIGHT), film.keyframes(frames)
    images = film_room(film.film_set, camera, path, film.keyframe_sensor(), seed=film.number, quick=True)
    depth = np.stack([render_truth(film.film_set, camera, pose)[0] for pose in path])
    posed = posed_capture(camera, path, images, depth, f"room-{film.number}.mp4")
    return (replace(posed, world_from_camera=film.shaken(path)) if cameras == "noisy" else posed), path


def measure_film(
    film: Film, frames: int, cameras: str, keep: set[str], predicted: bool = True
) -> dict[str, np.ndarray]:
    """Film a stretch of a walk and measure it; arrays by name, see `priors.samples.ARRAYS`.

    With `predicted`, what the sweep leaves unknown is predicted by the aggregation network.
    """
    from priors.surfaces import measure_surface

    posed, path = film_frames(film, frames, cameras)
    config = DepthConfig(threads=1, prior="both" if predicted else "mending")
    out = {"world_from_camera": path}
    if keep & {"costs", "winner"}:
        out |= _measure_costs(film, posed, path, config, "winner" in keep)
    if keep & {"depth", "gaussians", "surface"}:
        found, maps = _measure_depth(film, posed, path, config)
        out |= found
        if keep & {"gaussians", "surface"}:
            out |= measure_surface(film.film_set, posed, maps, "surface" in keep)
    return out


def _measure_costs(
    film: Film, posed: PosedFrames, path: np.ndarray, config: DepthConfig, winner: bool
) -> dict:
    """Return the arrays at sweep resolution: costs, and the truth."""
    import cv2

    from reconstruction.depth.aggregation import bin_costs, smoothed_scores
    from reconstruction.depth.images import gray_images, sized_camera
    from reconstruction.depth.measure import sweep_frame, winner_of
    from reconstruction.depth.views import plan_views

    small = sized_camera(posed.camera, config.sweep_side_px)
    plan = plan_views(posed, config)
    gray = gray_images(posed.images, small)
    size = (small.width, small.height)
    costs, smoothed, winners = [], [], []
    for row in range(len(path)):
        rhos = np.linspace(1.0 / plan.far[row], 1.0 / plan.near[row], config.planes)
        cost = sweep_frame(row, gray, posed, small, plan, rhos, config.noise_gray)
        costs.append(bin_costs(cost))
        smoothed.append(smoothed_scores(costs[-1], gray[row], config.smooth_small, config.smooth_large))
        if winner:
            winners.append(1.0 / winner_of(cost, gray[row], rhos, config))
    exact = [render_truth(film.film_set, small, pose) for pose in path]
    out = {
        "color": np.stack([cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in posed.images]),
        "cost": np.stack(costs),
        "smoothed": np.stack(smoothed),
        "true_depth": np.stack([d for d, _ in exact]).astype(np.float32),
        "true_ids": np.stack([i for _, i in exact]),
        "range": np.stack([plan.far, plan.near], 1),
        "intrinsics": np.array([small.fx, small.fy, small.cx, small.cy]),
    }
    return out | ({"winner": np.stack(winners).astype(np.float32)} if winner else {})


def _measure_depth(
    film: Film, posed: PosedFrames, path: np.ndarray, config: DepthConfig
) -> tuple[dict, DepthMaps]:
    """Return the arrays at depth resolution, what the mending network sees and the truth; and the finished maps."""
    import cv2

    from reconstruction.core.workers import Workers
    from reconstruction.depth.estimate import gather_evidence
    from reconstruction.depth.evidence import count_views

    found = gather_evidence(posed, config, keep_agreed=True)
    camera, each = found.camera, Workers(1).each
    agree, through = count_views(found.depth, posed, camera, found.neighbors, each)
    agreed_agree, agreed_through = count_views(found.agreed, posed, camera, found.neighbors, each)
    exact = [render_truth(film.film_set, camera, pose) for pose in path]
    size = (camera.width, camera.height)
    out = {
        "picture": np.stack([cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in posed.images]),
        "depth": found.depth.astype(np.float16),
        "origin": found.origin,
        "agree": agree,
        "through": through,
        "agreed": found.agreed.astype(np.float16),
        "agreed_agree": agreed_agree,
        "agreed_through": agreed_through,
        "correlation": np.round(100 * np.clip(found.correlation, 0, 1)).astype(np.uint8),
        "surety": np.round(100 * found.surety).astype(np.uint8),
        "exact_depth": np.stack([z for z, _ in exact]).astype(np.float16),
        "exact_ids": np.stack([i for _, i in exact]).astype(np.uint16),
        "focal": np.array([camera.fx, camera.fy]),
    }
    return out, found.maps()


def write_manifest(out: Path) -> None:
    """Write `manifest.json`: every finished room with its families and the hashes of its arrays."""
    rooms = [json.loads(file.read_text()) for file in sorted(out.glob("*/*/room.json"))]
    whole = hashlib.sha256(json.dumps(rooms, sort_keys=True).encode()).hexdigest()
    (out / "manifest.json").write_text(json.dumps({"sha256": whole, "rooms": rooms}, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
