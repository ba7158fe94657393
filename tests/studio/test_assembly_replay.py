"""The assembly as steps: order, poses over time."""

import numpy as np
import pytest
from made_scenes import BOOK, KNOB, PICTURE, TABLE

from studio.assembly import APPROACH_M, assembly_steps, pose_at


@pytest.fixture(scope="module")
def bundle(made_registry):
    return made_registry.load("room")


def test_every_object_comes_after_what_carries_it(bundle):
    steps = assembly_steps(bundle)
    order = [step.object_id for step in steps]
    assert sorted(order) == sorted(item.id for item in bundle.objects)
    for edge in bundle.edges:
        if edge.parent in order:
            assert order.index(edge.parent) < order.index(edge.child)
    assert order.index(TABLE) < order.index(BOOK) < order.index(KNOB)


def test_an_object_is_absent_then_approaches_then_stands_exactly(bundle):
    steps = assembly_steps(bundle)
    for number, step in enumerate(steps):
        assert pose_at(step, number, number) is None
        early, late = pose_at(step, number, number + 0.05), pose_at(step, number, number + 0.6)
        far, near = (np.linalg.norm(pose[:3, 3] - step.pose[:3, 3]) for pose in (early, late))
        assert APPROACH_M > far > near > 0
        assert np.array_equal(pose_at(step, number, number + 1), step.pose)
        assert np.array_equal(pose_at(step, number, len(steps)), step.pose)


def test_what_hangs_comes_out_of_the_room_and_what_stands_from_above(bundle):
    approach = {step.object_id: step.approach for step in assembly_steps(bundle)}
    assert approach[PICTURE] == pytest.approx([0, -1, 0])
    assert approach[BOOK] == pytest.approx([0, 0, 1])


def test_moved_objects_end_where_they_were_moved(bundle):
    pose = np.eye(4)
    pose[:3, 3] = [0.3, 0.2, 0.1]
    steps = {step.object_id: step for step in assembly_steps(bundle, {BOOK: pose})}
    assert np.array_equal(steps[BOOK].pose, pose)
    assert steps[KNOB].pose == pytest.approx(
        next(o for o in bundle.objects if o.id == KNOB).world_from_object
    )
