"""Facts of true objects with boxes at known places; proportions and intervals against computed values."""

import json

import numpy as np
import pytest
import trimesh

from benchmarks.breakdown import SIZE_EDGES_CM, breakdown, wilson
from reconstruction.measure.ground_truth import GroundTruth
from reconstruction.measure.object_boxes import instance_boxes, match_boxes, object_records
from reconstruction.measure.object_facts import longest_side, object_facts

# name -> (relation, parent, size, center)
THINGS = {
    "table": ("supported_by", "floor", (1.0, 0.6, 0.7), (0.0, 0.0, 0.35)),
    "plate": ("supported_by", "table", (0.2, 0.2, 0.02), (-0.3, 0.0, 0.71)),
    "cup": ("supported_by", "plate", (0.08, 0.08, 0.1), (-0.3, 0.0, 0.77)),
    "jar": ("supported_by", "table", (0.06, 0.06, 0.09), (-0.14, 0.0, 0.745)),
    "stool": ("supported_by", "floor", (0.3, 0.3, 0.4), (0.95, 0.7, 0.2)),
    "shelf": ("attached_to", "wall", (0.4, 0.2, 0.03), (0.0, 1.9, 1.5)),
    "book": ("supported_by", "shelf", (0.15, 0.1, 0.04), (0.0, 1.9, 1.535)),
}


def write_truth(folder, things=THINGS):
    """Write a ground-truth folder of boxes on a floor and a wall, and read it."""
    entities = []
    boxes = {
        "floor": trimesh.creation.box(
            (6, 6, 0.01), trimesh.transformations.translation_matrix((0, 0, -0.005))
        ),
        "wall": trimesh.creation.box(
            (6, 0.01, 2.5), trimesh.transformations.translation_matrix((0, 2.005, 1.25))
        ),
    }
    for name, (_, _, size, center) in things.items():
        boxes[name] = trimesh.creation.box(size, trimesh.transformations.translation_matrix(center))
    for number, (name, mesh) in enumerate(boxes.items(), start=1):
        mesh.export(folder / f"{name}.ply")
        relation, parent = things[name][:2] if name in things else (None, None)
        entities.append(
            {
                "id": number,
                "name": name,
                "label": name,
                "base": name not in things,
                "relation": relation,
                "parent": parent,
                "visible_pixels": 9000,
                "mesh": f"{name}.ply",
            }
        )
    scene = {
        "width": 640,
        "height": 480,
        "intrinsics": {"fx": 500, "fy": 500, "cx": 320, "cy": 240},
        "frames": [{"index": 0, "world_from_camera": np.eye(4).tolist()}],
        "entities": entities,
    }
    (folder / "scene.json").write_text(json.dumps(scene))
    return GroundTruth.load(folder)


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> GroundTruth:
    """The seven objects above."""
    return write_truth(tmp_path_factory.mktemp("truth"))


@pytest.fixture(scope="module")
def facts(truth):
    """Their facts by name."""
    by_id = object_facts(truth)
    return {e.name: by_id[e.id] for e in truth.entities if not e.base}


def test_support_is_counted_from_the_base_up(facts):
    assert {name: fact.support for name, fact in facts.items()} == {
        "table": "floor",
        "stool": "floor",
        "plate": "furniture",
        "jar": "furniture",
        "cup": "thing",
        "shelf": "wall",
        "book": "furniture",
    }


def test_the_longest_side_does_not_depend_on_how_a_thing_is_turned(facts):
    assert facts["plate"].longest_side_m == pytest.approx(0.2)
    assert facts["jar"].longest_side_m == pytest.approx(0.09)
    long_thing = trimesh.creation.box((0.3, 0.05, 0.1))
    long_thing.apply_transform(trimesh.transformations.rotation_matrix(np.radians(37), (0, 0, 1)))
    assert longest_side(long_thing.vertices) == pytest.approx(0.3, abs=1e-4)


def test_the_gap_is_to_the_nearest_thing_that_neither_carries_nor_is_carried(truth, facts):
    ids = {e.name: e.id for e in truth.entities}
    # The plate's edge is at x = -0.2, the jar's side at -0.17; cup and table are the plate's own.
    assert facts["plate"].gap_m == pytest.approx(0.03, abs=1e-5)
    assert facts["plate"].neighbor == ids["jar"]
    assert facts["jar"].gap_m == pytest.approx(0.03, abs=1e-5)
    # The cup's side is at -0.26, nearer to the jar than anything; the plate and the table below it do not count.
    assert facts["cup"].gap_m == pytest.approx(0.09, abs=1e-5)
    assert facts["cup"].neighbor == ids["jar"]
    # Corner (0.8, 0.55) of the stool, 0.4 high, to corner (0.5, 0.3) of the table: an edge to an edge.
    assert facts["stool"].gap_m == pytest.approx(np.hypot(0.3, 0.25), abs=1e-4)
    assert facts["table"].neighbor == ids["stool"]


def test_a_thing_alone_has_no_gap(tmp_path):
    truth = write_truth(tmp_path, {name: THINGS[name] for name in ("table", "plate")})
    records = object_records(
        truth.evaluated, object_facts(truth), match_boxes(truth.evaluated, np.zeros((0, 2, 3))), []
    )
    assert [r["gap_cm"] for r in records] == [None, None]  # each is the other's support or load
    assert breakdown(records)["gap"][0].name == "≥ 30 cm"


def test_records_say_what_was_found_at_which_overlap(truth):
    by_name = {e.name: e.mesh.bounds for e in truth.entities}
    half = by_name["jar"].copy()
    half[0, 0] = half[:, 0].mean() - 0.01  # 4 of 6 cm: IoU 2/3
    third = by_name["stool"].copy()
    third[0, 2] = third[1, 2] - 0.4 * 0.3  # the upper three tenths: IoU 0.3
    boxes = np.array([half, third, by_name["floor"]])
    matched = match_boxes(truth.evaluated, boxes)
    records = {
        r["name"]: r for r in object_records(truth.evaluated, object_facts(truth), matched, [11, 12, 13])
    }
    assert [records["jar"][k] for k in ("match", "found_25", "found_50")] == [11, True, True]
    assert records["jar"]["box_iou"] == pytest.approx(2 / 3)
    assert [records["stool"][k] for k in ("match", "found_25", "found_50")] == [12, True, False]
    assert records["cup"]["match"] is None
    assert not records["cup"]["found_25"]
    figures = matched.figures()
    assert figures["object_recall_25"] == pytest.approx(2 / 7)
    assert figures["object_precision_25"] == pytest.approx(2 / 3)
    assert figures["object_precision_50"] == pytest.approx(1 / 3)


def record(side_cm, support, gap_cm, found_25=True, found_50=True, pixels=50_000):
    """Return the keys of a record that the breakdown reads."""
    return {
        "longest_side_cm": side_cm,
        "support": support,
        "gap_cm": gap_cm,
        "visible_pixels": pixels,
        "found_25": found_25,
        "found_50": found_50,
    }


def test_bins_hold_their_lower_edge_and_every_object_is_in_one():
    records = [
        record(4.9, "thing", 0.0, False, False, 9_999),
        record(5.0, "thing", 1.99),
        record(9.99, "furniture", 2.0, True, False),
        record(10.0, "furniture", 7.0, False, False),
        record(50.0, "floor", None),
        record(120.0, "wall", 10.0, pixels=100_000),
    ]
    tables = {
        name: {b.name: (b.recall_25.found, b.recall_50.found, b.recall_25.count) for b in bins}
        for name, bins in breakdown(records).items()
    }
    assert tables["size"] == {
        "< 5 cm": (0, 0, 1),
        "5–10 cm": (2, 1, 2),
        "10–20 cm": (0, 0, 1),
        "≥ 50 cm": (2, 2, 2),
        "all": (4, 3, 6),
    }
    assert tables["support"] == {
        "on the floor": (1, 1, 1),
        "on furniture": (1, 0, 2),
        "on a thing": (1, 1, 2),
        "on a wall": (1, 1, 1),
        "all": (4, 3, 6),
    }
    assert tables["gap"] == {
        "< 2 cm": (1, 1, 2),
        "2–5 cm": (1, 0, 1),
        "5–10 cm": (0, 0, 1),
        "10–30 cm": (1, 1, 1),
        "≥ 30 cm": (1, 1, 1),
        "all": (4, 3, 6),
    }
    assert tables["seen"] == {
        "< 10,000 pixels": (0, 0, 1),
        "30,000–100,000 pixels": (3, 2, 4),
        "≥ 100,000 pixels": (1, 1, 1),
        "all": (4, 3, 6),
    }
    assert len(SIZE_EDGES_CM) == 4


def test_wilson_agrees_with_published_numbers():
    # Newcombe (1998), table I: 81 of 263 and 15 of 148 and 0 of 20 and 1 of 29, score method without correction.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)


def test_boxes_of_the_stage_are_in_the_true_world_and_reach_their_support(truth):
    from reconstruction.core.types import Instance, InstanceSet
    from reconstruction.measure.alignment import align

    rng = np.random.default_rng(0)
    poses = {}
    for number in range(6):
        pose = np.eye(4)
        pose[:3, 3] = rng.normal(size=3)
        poses[number] = pose
    # The estimated world is the true one at half the size, turned by a quarter about +z.
    true_from_estimated = np.array([[0, -2.0, 0, 0.3], [2.0, 0, 0, -0.2], [0, 0, 2.0, 0.1], [0, 0, 0, 1]])
    inverse = np.linalg.inv(true_from_estimated)
    rotation = np.eye(4)
    rotation[:3, :3] = true_from_estimated[:3, :3] / 2
    estimated = {}
    for number, pose in poses.items():
        estimated[number] = np.linalg.inv(rotation) @ pose
        estimated[number][:3, 3] = (inverse @ np.append(pose[:3, 3], 1))[:3]
    alignment = align(estimated, poses)
    # A cup of 8 x 6 x 10 cm whose lowest 4 cm nobody saw.
    cup = rng.uniform((0.46, 0.37, 0.74), (0.54, 0.43, 0.8), size=(20_000, 3))
    points = (inverse @ np.c_[cup, np.ones(len(cup))].T).T[:, :3]
    center = (inverse @ (0.5, 0.4, 0.75, 1))[:3]
    item = Instance(7, "cup", 0.5, center, 0.0, np.array([0.03, 0.04, 0.05]), 0, False)
    instances = InstanceSet(np.full(len(points), 7, np.int32), (), (item,), np.zeros((1, 2, 2), np.uint16))
    (box,) = instance_boxes(points, instances, alignment)
    assert box[1] == pytest.approx((0.54, 0.43, 0.8), abs=2e-3)
    assert box[0] == pytest.approx((0.46, 0.37, 0.7), abs=2e-3)


def test_a_picture_is_as_thick_as_the_stage_says_and_its_back_is_on_the_wall():
    """Its surface points are 1 to 5 cm from the wall at x = 0; the stage's estimate is 2 cm."""
    from reconstruction.core.types import Instance, InstanceSet
    from reconstruction.measure.alignment import Alignment

    rng = np.random.default_rng(0)
    points = np.column_stack(
        [rng.uniform(0.01, 0.05, 5000), rng.uniform(-0.2, 0.2, 5000), rng.uniform(1, 1.6, 5000)]
    )
    item = Instance(4, "picture", 0.5, np.array([0.01, 0, 1.3]), 0.0, np.array([0.02, 0.4, 0.6]), 1, True)
    instances = InstanceSet(np.full(len(points), 4, np.int32), (), (item,), np.zeros((1, 2, 2), np.uint16))
    same = Alignment(np.eye(4), np.zeros(0, np.int32), np.zeros(0), np.zeros(0), 0.0)
    (box,) = instance_boxes(points, instances, same)
    assert box == pytest.approx(np.array([[0.0, -0.196, 1.0], [0.02, 0.196, 1.594]]), abs=2e-3)
