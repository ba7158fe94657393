"""What a view is worth to whoever completes an object from it: strategies beside each other, as in Figure 4.

    python -m benchmarks.generation --captures ROOMS --least-hidden 0.25

For every object and strategy, the first view is sent through the real client of Hunyuan3D's server to a stand-in on
this machine (`benchmarks.one_view`), which completes what that view shows and knows nothing else. The meshes are
recorded; what is measured is replayed from the records, with the stand-in gone. Beside them stands the embedded
completion, which is built from all frames. Objects are the true ones (`oracle-instances`). Results are kept as
<out>/<capture>/generation.json; the page is written from all of them.
"""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.avo import (
    STRATEGY_ORDER,
    add_object_arguments,
    captures_with_truth,
    instance_of,
    save_pictures,
    spread,
)
from benchmarks.captures import Capture
from benchmarks.command import guarded
from benchmarks.generation_page import write_generation_page
from benchmarks.instances import stage_run, work_of
from benchmarks.machine import ROOT, describe_code, describe_machine
from benchmarks.one_view import OneViewServer, Shown
from benchmarks.variants import choose_variants
from registry.errors import SimReconError

DEFAULT_PAGE = ROOT / "docs" / "generation_benchmark.md"
_HIDDEN_POSES, _PICTURE_PX, _POINTS, _BOUND_M = 20, 170, 30_000, 0.01


def measure_capture(capture: Capture, out: Path, least_hidden: float, pictures: int) -> dict[str, Any]:
    """Measure the evaluated objects of a capture that stand on something.

    Args:
        capture: with full truth.
        out: where stages and records are kept.
        least_hidden: only objects of which other things hide at least this share of the outline.
        pictures: how many objects are drawn.
    """
    from benchmarks.true_views import TrueViews
    from reconstruction.assets.build import gather_evidence, object_shape
    from reconstruction.assets.config import ASSETS_PRESETS
    from reconstruction.assets.generation.load import RECORDS_VARIABLE
    from reconstruction.core.progress import NO_PROGRESS
    from reconstruction.measure.alignment import align
    from reconstruction.measure.ground_truth import GroundTruth
    from reconstruction.views import AvoConfig, make_views

    (variant,) = choose_variants(["oracle-instances"], [])
    run = stage_run(capture.source, work_of(out, capture), variant.arguments_for(capture))
    run.execute("instances")
    truth = GroundTruth.load(capture.ground_truth)
    posed, depth = run.in_world()
    alignment = align(
        dict(zip(map(int, posed.indices), posed.world_from_camera)), truth.world_from_camera, truth.up
    )
    surface, found = run.results["surface"], run.results["instances"]
    numbers = instance_of(truth, alignment, surface, found)
    film = [pose for _, pose in sorted(truth.world_from_camera.items())]
    hidden = TrueViews(truth).hidden_shares(spread(film, _HIDDEN_POSES))
    items = {item.id: item for item in found.objects}
    entities = [
        e for e in truth.evaluated
        if e.id in numbers and hidden.get(e.id, -1.0) >= least_hidden and not items[numbers[e.id]].attached_hint
    ]  # fmt: skip
    wanted = replace(found, objects=tuple(items[numbers[e.id]] for e in entities))
    config = ASSETS_PRESETS["fast"]
    evidence = gather_evidence(posed, depth, surface, found, config, NO_PROGRESS)
    scene = run.view_scene()
    os.environ[RECORDS_VARIABLE] = str(out / capture.name / "generated")
    shapes: dict[str, dict[int, Any]] = {
        "embedded": {item.id: object_shape(item, evidence) for item in wanted.objects}
    }
    sent: dict[str, dict[int, np.ndarray]] = {}
    for strategy in STRATEGY_ORDER:
        views = make_views(scene, wanted, AvoConfig(strategy=strategy, views=1, picture_side_px=384))
        asked = replace(config, generator="hunyuan3d", generator_model=f"one-view {strategy}")
        sent[strategy], fetched = _recorded(scene, wanted, posed, evidence, views, asked)
        trusting = replace(asked, generator_missed=1.0, generator_intruding=1.0, generator_filling=1.0)
        for name, bounds in ((strategy, trusting), (f"{strategy}, checked", asked)):
            own = replace(evidence, fetched=fetched, config=bounds)
            shapes[name] = {item.id: object_shape(item, own) for item in wanted.objects}
    records, rows = [], []
    for entity in entities:
        number = numbers[entity.id]
        record = {"capture": capture.name, "name": entity.name, "hidden": hidden[entity.id], "made": {}}
        for name, made in shapes.items():
            record["made"][name] = _score(entity, made[number], alignment)
        records.append(record)
        row = [
            None,
            {s: sent[s].get(number) for s in STRATEGY_ORDER},
            {n: s[number] for n, s in shapes.items()},
        ]
        rows.append((hidden[entity.id], entity.name, entity, row[1], row[2]))
        print(f"{capture.name} / {entity.name}: " + ", ".join(
            f"{n} {r['cd_cm']:.1f}" for n, r in record["made"].items()), flush=True)  # fmt: skip
    rows.sort(key=lambda one: (-one[0], one[1]))
    drawn = [_row_picture(*one[2:], alignment) for one in rows[:pictures]]
    return {
        "capture": capture.name, "objects": records, "machine": describe_machine(), **describe_code(),
        "pictures": drawn,
    }  # fmt: skip


def _recorded(
    scene: Any, wanted: Any, posed: Any, evidence: Any, views: Any, config: Any
) -> tuple[dict[int, np.ndarray], Any]:
    """Have the first view of every object completed and recorded; return what was sent, and the replayed meshes."""
    from reconstruction.assets.generation.fetch import fetch_meshes
    from reconstruction.assets.generation.pictures import encode_png, object_pictures
    from reconstruction.core.progress import NO_PROGRESS

    sent = {}
    with OneViewServer() as server:
        for number, one in object_pictures(wanted, posed, list(wanted.objects), 1, views).items():
            picture = one.pictures[0].cut_out()
            sent[number] = picture
            if views.of(number):
                server.tell(encode_png(picture), _shown(scene, views.of(number)[0]))
        there = replace(config, generator_url=server.url)
        made = fetch_meshes(wanted, posed, evidence.stands.seen, there, NO_PROGRESS, views)
    nobody = replace(config, generator_url="http://127.0.0.1:9")
    replayed = fetch_meshes(
        replace(wanted, objects=tuple(item for item in wanted.objects if item.id in made.meshes)),
        posed, evidence.stands.seen, nobody, NO_PROGRESS, views,
    )  # fmt: skip
    if replayed.meshes != made.meshes:
        raise SimReconError("the records do not give back what was made")
    return sent, replace(replayed, refused=made.refused)


def _shown(scene: Any, view: Any) -> Shown:
    """Return what a view shows of its target once nothing hides it."""
    from reconstruction.gaussians.rasterizer import RasterSettings, rasterize

    own = scene.packed[np.isin(scene.instance, view.target)]
    alone = rasterize(own, view.camera, view.world_from_camera, RasterSettings(near=0.02)).features
    opacity = alone[..., 7]
    depth = np.where(opacity > 0.5, alone[..., 3] / np.maximum(opacity, 1e-6), 0.0)
    return Shown(view.clean, view.outline, depth.astype(np.float32), view.camera, view.world_from_camera)


def _placed(shape: Any, alignment: Any) -> np.ndarray:
    """Return the vertices of a shape in the space of the truth."""
    from registry.geometry import transform_points

    return alignment.to_true(transform_points(shape.frame.world_from_grid, shape.body.vertices))


def _score(entity: Any, shape: Any, alignment: Any) -> dict[str, Any]:
    from reconstruction.measure.surfaces import compare, sample

    true = sample(entity.mesh.vertices, entity.mesh.faces, _POINTS)
    score = compare(sample(_placed(shape, alignment), shape.body.faces, _POINTS), true, _BOUND_M)
    used = shape.attempt is not None and shape.attempt.body is not None
    return {"cd_cm": score.cd_cm, "f_1cm": score.f, "generated": used, "how": shape.provenance}


def _row_picture(entity: Any, sent: dict[str, Any], shapes: dict[str, Any], alignment: Any) -> np.ndarray:
    """Return truth and embedded completion, then for each strategy what was sent and what was made of it."""
    import cv2

    from reconstruction.measure.report import drawing

    camera, pose = drawing.framing_camera(entity.mesh.vertices, 35.0, 25.0, _PICTURE_PX, _PICTURE_PX, 0.15)

    def drawn(vertices: np.ndarray, faces: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
        return drawing.render_colored(vertices, faces, np.tile(color, (len(vertices), 1)), camera, pose)

    cells = [drawn(np.asarray(entity.mesh.vertices), np.asarray(entity.mesh.faces), (150, 170, 150))]
    cells.append(
        drawn(_placed(shapes["embedded"], alignment), shapes["embedded"].body.faces, (170, 170, 185))
    )
    for strategy in STRATEGY_ORDER:
        cell = np.full((_PICTURE_PX, _PICTURE_PX, 3), 255, np.uint8)
        if sent.get(strategy) is not None:
            cell = cv2.resize(sent[strategy], (_PICTURE_PX, _PICTURE_PX), interpolation=cv2.INTER_AREA)[
                ..., :3
            ]
        shape = shapes[strategy]
        cells += [cell, drawn(_placed(shape, alignment), shape.body.faces, (190, 160, 140))]
    return np.concatenate(cells, axis=1)


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.generation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_object_arguments(parser, DEFAULT_PAGE)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, or the exit code of what is wrong."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks.generation", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    captures = captures_with_truth(arguments)
    out, kept = arguments.out.resolve(), []
    for capture in captures:
        path = out / capture.name / "generation.json"
        if not arguments.page_only:
            measured = measure_capture(capture, out, arguments.least_hidden, arguments.pictures)
            drawn = [("", picture) for picture in measured.pop("pictures")]
            save_pictures(drawn, arguments.page, f"generation_{capture.name}")
            path.write_text(json.dumps(measured, indent=1) + "\n")
        if path.is_file():
            kept.append(json.loads(path.read_text()))
    write_generation_page(kept, arguments.page)
    print(f"{arguments.page} is written", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
