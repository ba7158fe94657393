"""The assembly benchmark: rooms that are a little off, figures, the page."""

import json

import numpy as np
import pytest

from benchmarks.assembly import RESULTS, main, measure, measure_room, objects_of
from benchmarks.assembly_page import write_assembly_page
from benchmarks.assembly_rooms import SHIFT_M, room_task
from benchmarks.results import load_results
from registry.simulation import pose_change

pytestmark = pytest.mark.stage


def test_rooms_are_off_by_as_much_as_is_said_and_the_same_twice():
    task, again = room_task(3, 14), room_task(3, 14)
    changes = [pose_change(task.true_poses[item.id], item.world_from_object) for item in task.assets.objects]
    moved, turned = np.median(changes, axis=0)
    assert moved == pytest.approx(1.54 * SHIFT_M, rel=0.5)  # median length of a normal vector in space
    assert 1.0 < turned < 4.0
    for a, b in zip(task.assets.objects, again.assets.objects):
        assert np.array_equal(a.world_from_object, b.world_from_object)
    assert {e.child for e in task.graph.edges} == {item.id for item in task.assets.objects}


def test_base_surfaces_face_the_room():
    task = room_task(0, 5)
    middle = np.mean([pose[:3, 3] for pose in task.true_poses.values()], axis=0)
    middle[2] += 0.5
    for base in task.assets.base:
        assert base.plane[:3] @ middle + base.plane[3] > 0.2
        points = np.asarray(base.visual.vertices, float) @ base.plane[:3] + base.plane[3]
        assert points.max() == pytest.approx(0, abs=1e-6)


def test_sizes_are_spread():
    sizes = [objects_of(seed) for seed in range(36)]
    assert sorted(sizes) == list(range(5, 41))
    assert max(sizes[:5]) > 30


@pytest.fixture(scope="module")
def record():
    return measure_room(0, 8)


def test_assembly_brings_rest_and_the_others_are_measured_alike(record):
    methods = record["methods"]
    assert list(methods) == ["hierarchical", "in-situ", "mcmc"]
    good = methods["hierarchical"]
    assert good["failures"] == []
    assert good["edges_without_contact"] == good["supports_without_edge"] == 0
    assert np.median(good["off_m"]) < 0.01
    assert methods["in-situ"]["failures"]
    assert max(methods["in-situ"]["moved_m"]) == 0
    assert methods["mcmc"]["spawn_penetration_mm"] < methods["in-situ"]["spawn_penetration_mm"]


def test_how_far_things_are_off_is_said_in_true_metres():
    task = room_task(0, 5)
    centers = {item.id: item.world_from_object[:3, 3] for item in task.assets.objects}

    def off(scale: float) -> np.ndarray:
        made = measure("a", "captures with truth", task.assets, task.graph, centers, ["in-situ"], scale)
        return np.array(made["methods"]["in-situ"]["off_m"])

    assert off(1.0).min() > 0
    assert off(0.8) == pytest.approx(0.8 * off(1.0))


def test_the_page_is_written_from_what_is_kept(record, tmp_path):
    (tmp_path / RESULTS).mkdir(parents=True)
    (tmp_path / RESULTS / "a.json").write_text(json.dumps(record))
    assert load_results(tmp_path) == []  # the other benchmark may keep its results in the same folder
    page = tmp_path / "page.md"
    assert main(["--page-only", "--out", str(tmp_path), "--page", str(page)]) == 0
    text = page.read_text()
    assert "## Generated rooms (1, 8 objects)" in text
    assert "| `hierarchical` | 1 | 100.0 | 100 |" in text
    capture = record | {"group": "captures with truth", "scene": "a room"}
    write_assembly_page([capture], page)
    assert "| a room | 8 |" in page.read_text()
