"""How much of things the views of each strategy see, by the truth; where their cameras stand; what they cost.

    python -m benchmarks.avo --captures ROOMS                       # all objects of rooms, all strategies
    python -m benchmarks.avo --captures ROOMS --only room30 --pictures 4

Captures are reconstructed up to the instances (`oracle-instances`, unless another variant is named: the views are to be
measured, not the cut), in the work folder that `python -m benchmarks.run` uses, too. Every strategy is asked for the
same number of views. Results are kept as <out>/<capture>/avo.json; the page is written from all of them.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.avo_page import write_avo_page
from benchmarks.captures import Capture, find_captures
from benchmarks.command import guarded
from benchmarks.instances import stage_run, work_of
from benchmarks.machine import ROOT, describe_code, describe_machine
from benchmarks.table import DEFAULT_OUT
from benchmarks.variants import Variant, choose_variants
from registry.errors import UsageError

DEFAULT_PAGE = ROOT / "docs" / "avo_benchmark.md"
STRATEGY_ORDER = ("avo", "max-visibility", "canonical", "avo-no-depth")
_HIDDEN_POSES, _FILM_POSES = 20, 40
_PICTURE_PX = 160
_SEEABLE_PX = 480
_STEPS = (1e-8, 3e-8, 1e-7, 3e-7, 1e-6)  # meters and radians: over longer ones the objective has jumps
_WIDE_STEPS = (3e-4, 6e-4, 1e-3)  # over these, splats change their order


def measure_capture(
    capture: Capture, variant: Variant, out: Path, pictures: int, least_hidden: float = 0.0
) -> dict[str, Any]:
    """Measure the evaluated objects of a capture that have Gaussians.

    Args:
        capture: with full truth.
        variant: up to the instances.
        out: where stages are kept.
        pictures: how many objects are drawn.
        least_hidden: only objects of which other things hide at least this share of the outline.

    Returns:
        `objects`: a record each; `pictures`: RGB rows for the page.
    """
    from benchmarks.true_views import TrueViews
    from reconstruction.measure.alignment import align
    from reconstruction.measure.ground_truth import GroundTruth
    from reconstruction.views import AvoConfig, find_views, make_target, prepare_scene

    run = stage_run(capture.source, work_of(out, capture), variant.arguments_for(capture))
    run.execute("instances")
    truth = GroundTruth.load(capture.ground_truth)
    posed, _ = run.in_world()
    alignment = align(
        dict(zip(map(int, posed.indices), posed.world_from_camera)), truth.world_from_camera, truth.up
    )
    surface, found = run.results["surface"], run.results["instances"]
    gaussians = run.results["gaussians"].in_world(run.results["world"])
    started = time.perf_counter()
    scene = prepare_scene(gaussians, surface, found, posed.camera)
    prepared_s = time.perf_counter() - started
    config = AvoConfig(remaining_share=0.0, min_gain=0.0)  # the same number of views for all
    numbers = instance_of(truth, alignment, surface, found)
    true_views, film = TrueViews(truth), [pose for _, pose in sorted(truth.world_from_camera.items())]
    hidden = true_views.hidden_shares(spread(film, _HIDDEN_POSES))
    warm = replace(config, views=1, steps=2, picture_side_px=32)
    find_views(scene, [o.id for o in found.objects[:1]], warm)  # compiles
    chosen = [e for e in truth.evaluated if e.id in numbers and hidden.get(e.id, -1.0) >= least_hidden]
    points_of = {entity.id: true_views.points_of(entity) for entity in chosen}
    filmed_of = true_views.seen_by_any(points_of, truth.camera, spread(film, _FILM_POSES))
    objects, drawn = [], []
    for entity in chosen:
        target = make_target(scene, numbers[entity.id], config)
        if target is None:
            continue
        points, filmed = points_of[entity.id], filmed_of[entity.id]
        record = {
            "capture": capture.name, "name": entity.name, "hidden": hidden[entity.id], "filmed": float(filmed.mean()),
            "radius_m": target.radius_m, "gradient_error": gradient_error(scene, target, config, _STEPS),
            "gradient_error_wide": gradient_error(scene, target, config, _WIDE_STEPS),
            "seeable": _seeable(scene, target, points, true_views, alignment, config), "strategies": {},
        }  # fmt: skip
        row = []
        for name in STRATEGY_ORDER:
            wall, cpu = time.perf_counter(), time.process_time()
            (views,) = find_views(scene, [numbers[entity.id]], replace(config, strategy=name))
            cost = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
            places = [scene.clearance.at(view.world_from_camera[:3, 3]) for view in views.views]
            free = np.array(places) >= config.min_clearance_m
            record["strategies"][name] = cost | _figures(
                views.views, points, filmed, free, true_views, alignment
            )
            row.append(views.views)
        objects.append(record)
        drawn.append((record["hidden"], entity.name, row))
        shares = " ".join(f"{n} {100 * r['union']:.0f}" for n, r in record["strategies"].items())
        print(f"{capture.name} / {entity.name}: hidden {record['hidden']:.2f}, sees {shares} %", flush=True)
    drawn.sort(key=lambda entry: (-entry[0], entry[1]))
    return {
        "capture": capture.name, "objects": objects, "prepared_s": prepared_s, "machine": describe_machine(),
        **describe_code(), "pictures": [(name, _row_picture(row)) for _, name, row in drawn[:pictures]],
    }  # fmt: skip


def spread(poses: Sequence[np.ndarray], count: int) -> list[np.ndarray]:
    """Return up to `count` poses, evenly spaced."""
    return [poses[i] for i in np.unique(np.linspace(0, len(poses) - 1, count).round().astype(int))]


def instance_of(truth: Any, alignment: Any, surface: Any, found: Any) -> dict[int, int]:
    """Return which instance shows most of each true thing, by true id."""
    from scipy.spatial import cKDTree

    from reconstruction.measure.surfaces import sample

    samples = [sample(e.mesh.vertices, e.mesh.faces, 8000).points for e in truth.entities]
    owner = np.repeat([e.id for e in truth.entities], [len(points) for points in samples])
    _, nearest = cKDTree(np.concatenate(samples)).query(alignment.to_true(surface.vertices))
    out: dict[int, tuple[int, int]] = {}
    for item in found.objects:
        ids, counts = np.unique(owner[nearest[found.vertex_instance == item.id]], return_counts=True)
        if len(ids):
            true_id, count = int(ids[np.argmax(counts)]), int(counts.max())
            out[true_id] = max(out.get(true_id, (0, 0)), (count, item.id))
    return {true_id: number for true_id, (_, number) in out.items()}


def _figures(
    views: Sequence[Any],
    points: np.ndarray,
    filmed: np.ndarray,
    free: np.ndarray,
    true_views: Any,
    alignment: Any,
) -> dict:
    """Return what views see of the true surface, also those of `free` cameras alone, and which stand where none can."""
    poses = [alignment.pose_to_true(view.world_from_camera) for view in views]
    seen = np.array([true_views.seen(points, view.camera, pose) for view, pose in zip(views, poses)])
    seen = seen.reshape(-1, len(points))
    return {
        "views": len(views),
        "first": float(seen[0].mean()) if len(seen) else 0.0,
        "mean": float(seen.mean()) if len(seen) else 0.0,
        "union": float(seen.any(axis=0).mean()),
        "union_free": float(seen[free.astype(bool)].any(axis=0).mean()),
        "free": int(free.sum()),
        "union_filmed": float((seen.any(axis=0) & filmed).sum() / max(filmed.sum(), 1)),
        "in_wall": [inside for inside in (true_views.inside(pose[:3, 3]) for pose in poses) if inside],
    }


def _seeable(
    scene: Any, target: Any, points: np.ndarray, true_views: Any, alignment: Any, config: Any
) -> float:
    """Return the share of the true surface that cameras in free space all around the target see together."""
    from reconstruction.measure.visibility import seen_points
    from reconstruction.views.cameras import square_camera
    from reconstruction.views.initial_views import input_starts, starts_around

    poses = np.concatenate([starts_around(scene, target, config), input_starts(scene, target, config)[::4]])
    camera = square_camera(config.picture_side_px, config.fov_deg)
    there = [alignment.pose_to_true(pose) for pose in poses]
    seen = seen_points(points, true_views.vertices, true_views.faces, camera, there, side_px=_SEEABLE_PX)
    return float(seen.mean())


def gradient_error(scene: Any, target: Any, config: Any, steps: Sequence[float]) -> float:
    """Return the relative error of the pose gradient beside central differences, at the nearest input camera."""
    from reconstruction.gaussians.fit import exponential
    from reconstruction.views.cameras import look_at, square_camera
    from reconstruction.views.objective import Objective
    from reconstruction.views.scene import reach_of

    packed = scene.packed.astype(np.float64)
    camera = square_camera(config.side_px, config.fov_deg)
    objective = Objective(packed, reach_of(packed, config.sigma_cutoff), target.rows, camera, config)
    eyes = scene.inputs[:, :3, 3]
    eye = eyes[np.argmin(np.linalg.norm(eyes - target.center, axis=1))]
    pose, worth = look_at(eye, target.center, config.max_pitch_deg), np.ones((2, len(target.rows)))

    def value(xi: np.ndarray, gradient: bool = False) -> Any:
        at = pose @ exponential(xi)
        return objective.evaluate(at, worth, target.distance_m, config.depth_weight, gradient)

    first = value(np.zeros(6))
    objective.reference_px = max(first.information, 1.0)
    found = value(np.zeros(6), True).gradient
    differences = np.array(
        [
            np.median([(value(h * axis).loss - value(-h * axis).loss) / (2 * h) for h in steps])
            for axis in np.eye(6)
        ]
    )
    return float(np.linalg.norm(found - differences) / max(np.linalg.norm(differences), 1e-12))


def _row_picture(row: Sequence[Sequence[Any]]) -> np.ndarray:
    """Return the views of an object, one strategy beside the other, uint8 RGB."""
    import cv2

    cells = []
    for views in row[:3]:
        for view in views[:4]:
            picture = view.color.copy()
            outlines, _ = cv2.findContours(
                view.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
            )
            cv2.drawContours(picture, outlines, -1, (255, 40, 40), 3)
            scale = _PICTURE_PX / max(picture.shape[:2])
            size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
            cell = np.full((_PICTURE_PX, _PICTURE_PX, 3), 255, np.uint8)
            cell[: size[1], : size[0]] = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            cells.append(cell)
        cells.append(np.full((_PICTURE_PX, 8, 3), 255, np.uint8))
    return np.concatenate(cells[:-1], axis=1)


def add_object_arguments(parser: argparse.ArgumentParser, page: Path) -> None:
    """Add what benchmarks of single objects in captures with truth are told."""
    parser.add_argument(
        "--captures", type=Path, nargs="+", required=True, metavar="DIR", help="with ground truth"
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these captures")
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT, metavar="DIR", help="where results are kept")
    parser.add_argument("--page", type=Path, default=page, metavar="FILE", help="the page to write")
    parser.add_argument(
        "--pictures", type=int, default=0, metavar="N",
        help="draw the N most hidden objects of each capture for the page: of generated rooms only",
    )  # fmt: skip
    parser.add_argument(
        "--least-hidden", type=float, default=0.0, metavar="SHARE",
        help="only objects of which other things hide this share of the outline over the film",
    )  # fmt: skip
    parser.add_argument("--page-only", action="store_true", help="measure nothing")


def captures_with_truth(arguments: argparse.Namespace) -> list[Capture]:
    """Return the captures that the arguments name; UsageError where none has a truth."""
    captures = [c for c in find_captures(arguments.captures, arguments.only) if c.truth == "scene"]
    if not captures:
        raise UsageError("--captures: none of them has a ground truth with scene.json")
    return captures


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.avo",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_object_arguments(parser, DEFAULT_PAGE)
    parser.add_argument("--variant", default="oracle-instances", metavar="NAME", help="of benchmarks.run")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, or the exit code of what is wrong."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks.avo", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    captures = captures_with_truth(arguments)
    (variant,) = choose_variants([arguments.variant], [])
    kept = []
    for capture in captures:
        path = arguments.out.resolve() / capture.name / "avo.json"
        if not arguments.page_only:
            measured = measure_capture(
                capture, variant, arguments.out.resolve(), arguments.pictures, arguments.least_hidden
            )
            save_pictures(measured.pop("pictures"), arguments.page, capture.name)
            path.write_text(json.dumps(measured, indent=1) + "\n")
        if path.is_file():
            kept.append(json.loads(path.read_text()))
    write_avo_page(kept, arguments.page)
    print(f"{arguments.page} is written", flush=True)
    return 0


def save_pictures(pictures: Sequence[tuple[str, np.ndarray]], page: Path, capture: str) -> None:
    """Write pictures below each other as one JPEG beside a page."""
    import cv2

    if not pictures:
        return
    (page.parent / "images").mkdir(parents=True, exist_ok=True)
    sheet = np.concatenate([picture for _, picture in pictures])
    path = page.parent / "images" / f"avo_{capture}.jpg"
    cv2.imwrite(str(path), sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 72])


if __name__ == "__main__":
    sys.exit(main())
