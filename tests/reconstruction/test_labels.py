"""Coarse labels: what shapes are called, and that confidences promise no more than they keep."""

import numpy as np
import pytest
from surfaces import Patchwork, merged, sheet, solid_box, surface_from

from benchmarks.label_calibration import Guess, overconfidence, reliability
from benchmarks.labels import compared, table
from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.boxes import upright_box
from reconstruction.instances.labels import ShapeFacts, coarse_label, shape_facts
from reconstruction.surface import SurfaceConfig, fuse_surface

pytestmark = pytest.mark.stage

GRAY = (128, 128, 128)


def cylinder(radius: float, low: float, high: float, lid: bool, inside: float | None = None) -> Patchwork:
    """Return an upright round thing; `inside` is the height of its floor where it is open."""

    def ring(r: float, z: float, n: int) -> np.ndarray:
        angle = np.arange(n) / n * 2 * np.pi
        return np.stack([r * np.cos(angle), r * np.sin(angle), np.full(n, z)], axis=1)

    n = max(24, round(2 * np.pi * radius / 0.01))
    heights = np.linspace(low, high, max(3, round((high - low) / 0.01)))
    circles = [(ring(radius, z, n), 1.0, 0.0) for z in heights]
    if inside is not None:
        circles += [(ring(radius - 0.004, z, n), -1.0, 0.0) for z in heights[::-1] if z >= inside]
    if lid or inside is not None:
        z = high if inside is None else inside
        circles += [
            (ring(r, z, n), 0.0, 1.0)
            for r in np.linspace(radius - 0.006, 0.003, max(3, round(radius / 0.01)))
        ]
    points, normals, faces = [], [], []
    for k, (circle, out, up) in enumerate(circles):
        points.append(circle)
        flat = circle * [1, 1, 0] / max(np.linalg.norm(circle[0, :2]), 1e-9)
        normals.append(out * flat + [0, 0, up])
        if k:
            a, b = (k - 1) * n + np.arange(n), k * n + np.arange(n)
            faces += [np.stack([a, np.roll(a, -1), b], 1), np.stack([np.roll(a, -1), np.roll(b, -1), b], 1)]
    count = n * len(circles)
    return Patchwork(
        np.concatenate(points), np.concatenate(faces), np.concatenate(normals), np.tile(GRAY, (count, 1))
    )


def facts(shape: Patchwork, on_floor: bool = False, attached: bool = False, carries: int = 0) -> ShapeFacts:
    graph = MeshGraph.from_surface(surface_from(shape))
    everything = np.arange(len(graph.points))
    return shape_facts(graph, everything, upright_box(graph.points, graph.areas), on_floor, attached, carries)


def table_of(width: float, depth: float, height: float) -> Patchwork:
    legs = [
        solid_box((x, y, 0), (x + 0.04, y + 0.04, height - 0.03), GRAY)
        for x in (0, width - 0.04)
        for y in (0, depth - 0.04)
    ]
    return merged(solid_box((0, 0, height - 0.03), (width, depth, height), GRAY), *legs)


def shelf_of(width: float, depth: float, height: float, boards: int) -> Patchwork:
    sides = [solid_box((x, 0, 0), (x + 0.02, depth, height), GRAY) for x in (0, width)]
    levels = np.linspace(0.1, height - 0.02, boards)
    return merged(*sides, *(solid_box((0, 0, z), (width, depth, z + 0.02), GRAY) for z in levels))


@pytest.mark.parametrize(
    ("shape", "where", "label"),
    [
        (solid_box((0, 0, 0.5), (0.12, 0.1, 0.66), GRAY), {}, "box"),
        (solid_box((0, 0, 0.5), (0.24, 0.17, 0.54), GRAY), {}, "book"),
        (cylinder(0.035, 0.5, 0.72, lid=True), {}, "bottle"),
        (cylinder(0.05, 0.5, 0.58, lid=False, inside=0.51), {}, "cup"),
        (cylinder(0.12, 0.5, 0.58, lid=False, inside=0.52), {}, "bowl"),
        (cylinder(0.13, 0.5, 0.53, lid=True), {}, "plate"),
        (table_of(1.2, 0.7, 0.72), {"on_floor": True, "carries": 2}, "table"),
        (table_of(1.1, 0.35, 0.45), {"on_floor": True}, "seat"),
        (shelf_of(0.8, 0.3, 1.5, 4), {"on_floor": True}, "shelf"),
        (solid_box((0, 0, 0), (0.9, 0.45, 0.8), GRAY), {"on_floor": True}, "cabinet"),
        (sheet((0, 0.02, 1.2), (0.6, 0, 0), (0, 0, 0.4), GRAY), {"attached": True}, "picture"),
    ],
)
def test_clear_shapes_have_their_names(shape, where, label):
    found, confidence = coarse_label(facts(shape, **where))
    assert found == label
    assert 0.25 <= confidence <= 0.7  # believed, but never sure


def test_a_sheet_that_is_not_a_picture_is_not_called_one():
    rail = sheet((0, 0.02, 1.2), (1.1, 0, 0), (0, 0, 0.12), GRAY)
    assert coarse_label(facts(rail, attached=True)) == ("unknown", 0.0)


def test_bins_count_what_was_said_and_what_is_right():
    guesses = [
        Guess("box", 0.5, "carton"),
        Guess("box", 0.5, ""),
        Guess("table", 0.7, "table"),
        Guess("unknown", 0.0, "lemon"),
    ]
    low, high = reliability(guesses)
    assert (low.count, low.confidence, low.right) == (2, 0.5, 0.5)
    assert (high.count, high.right) == (1, 1.0)
    assert overconfidence(guesses) == pytest.approx(-0.3 / 3)
    assert "3 of 4 things have a label" in table(guesses)


def test_labels_in_a_generated_room_promise_no_more_than_they_keep(small_capture):
    posed, depth = small_capture.posed, small_capture.depth
    surface = fuse_surface(posed, depth, SurfaceConfig(voxel_size_m=0.012), progress=NO_PROGRESS)
    found = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    names = {e.id: "" if e.base else e.label for e in small_capture.entities}
    guesses = compared(found, small_capture.id_maps, names)
    assert sum(g.label != "unknown" for g in guesses) >= 5
    assert overconfidence(guesses) < 0.05
