"""Coarse labels: what shapes are called, and that confidences promise no more than they keep."""

import numpy as np
import pytest
from surfaces import Patchwork, merged, sheet, solid_box, surface_from

from benchmarks.labels import compared, table
from reconstruction.evaluation.labels import MEANS, Guess, label_of, overconfidence, reliability
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.boxes import upright_box
from reconstruction.instances.labels import CLASSES, LABEL_FEATURES, coarse_label, label_features, load_labels
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface import SurfaceConfig, fuse_surface
from reconstruction.surface.mesh_graph import MeshGraph
from registry.errors import EnvironmentMissing

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


def features(
    shape: Patchwork, on_floor: bool = False, attached: bool = False, carries: int = 0
) -> np.ndarray:
    graph = MeshGraph.from_surface(surface_from(shape))
    everything = np.arange(len(graph.points))
    return label_features(
        graph, everything, upright_box(graph.points, graph.areas), on_floor, attached, carries
    )


def facts(shape: Patchwork, **where) -> dict[str, float]:
    return dict(zip(LABEL_FEATURES, features(shape, **where).tolist(), strict=True))


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


def test_features_say_what_shapes_are():
    box = facts(solid_box((0, 0, 0.5), (0.12, 0.1, 0.66), GRAY))
    can = facts(cylinder(0.035, 0.5, 0.72, lid=True))
    cup = facts(cylinder(0.05, 0.5, 0.58, lid=False, inside=0.51))
    table = facts(table_of(1.2, 0.7, 0.72), on_floor=True, carries=2)
    shelf = facts(shelf_of(0.8, 0.3, 1.5, 4), on_floor=True)
    picture = facts(sheet((0, 0.02, 1.2), (0.6, 0, 0), (0, 0, 0.4), GRAY), attached=True)
    assert box["squareness"] > 0.6 > 0.3 > can["squareness"]
    assert box["outward"] > 0.5
    assert can["outward"] > 0.9
    assert cup["middle_below_top"] > 0.6 > 0.1 > abs(can["middle_below_top"])
    assert table["flat_top"] > 0.55
    assert table["carries"] == 2
    assert table["on_floor"] == 1
    assert (table["levels"], shelf["levels"]) == (1, 4)
    assert picture["outline_fill"] > 0.95
    assert picture["attached"] == 1
    assert box["hull_fill"] == pytest.approx(1, abs=0.05)
    assert table["hull_fill"] > 0.9  # the hull of a table is a block
    assert table["area_of_hull"] < shelf["area_of_hull"]
    assert box["height"] == pytest.approx(0.16, abs=0.01)
    assert box["bottom"] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("shape", "where", "label"),
    [
        (table_of(1.2, 0.7, 0.72), {"on_floor": True, "carries": 2}, "table"),
        (solid_box((0, 0, 0), (0.9, 0.45, 0.8), GRAY), {"on_floor": True}, "cabinet"),
    ],
)
def test_clear_shapes_have_their_names(shape, where, label):
    found, confidence = coarse_label(features(shape, **where))
    assert found == label
    assert 0.25 <= confidence < 1


def test_a_sheet_that_is_not_a_picture_is_not_called_one():
    rail = sheet((0, 0.02, 1.2), (1.1, 0, 0), (0, 0, 0.12), GRAY)
    assert coarse_label(features(rail, attached=True))[0] != "picture"


def test_probabilities_are_of_all_classes_and_do_not_depend_on_neighbors():
    rows = np.stack(
        [features(table_of(1.2, 0.7, 0.72), on_floor=True), features(cylinder(0.035, 0.5, 0.72, True))]
    )
    both = load_labels().probabilities(rows)
    assert both.shape == (2, len(CLASSES))
    np.testing.assert_allclose(both.sum(axis=1), 1)
    np.testing.assert_array_equal(both[1], load_labels().probabilities(rows[1:])[0])


def test_broken_weights_are_told(tmp_path):
    with pytest.raises(EnvironmentMissing, match="Install the package again"):
        load_labels(tmp_path / "none.safetensors")


def test_words_belong_to_one_label_each():
    assert [label_of(w) for w in ("coffee table", "Open_Box", "tin", "book", "jar", "gear")] == [
        "table", "tray", "can", "book", "can", "unknown",
    ]  # fmt: skip
    assert all(label_of(word) != "unknown" for words in MEANS.values() for word in words)
    assert set(MEANS) | {"unknown"} == set(CLASSES)


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
