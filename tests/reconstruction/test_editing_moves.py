"""Poses by the user: moves, and the height at which a thing rests on what is below it."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box, room, thing, tilt, tray
from boxes import box_part as part
from notes import Notes

from reconstruction.assembly import AssemblyConfig, assemble
from reconstruction.core.types import AssetSet, Instance, InstanceSet
from reconstruction.editing.anchors import Pointer
from reconstruction.editing.overrides import Overrides
from reconstruction.scene_graph import SceneGraphConfig, infer_scene_graph
from registry.geometry import quat_from_matrix, rigid

TABLE = {"size": (1.0, 0.7, 0.4), "position": (0, 0, 0)}


def edited(assets: AssetSet, *entries: dict, notes: Notes | None = None) -> dict:
    items = [
        Instance(o.id, o.label, 0.9, np.zeros(3), 0.0, np.full(3, 0.2), 1, False) for o in assets.objects
    ]
    nothing = np.zeros((0, 0, 0), np.uint16)
    found = InstanceSet(np.zeros(0, np.int32), (), tuple(items), nothing)
    pointer = Pointer(found, None)  # pyright: ignore[reportArgumentType]
    out = Overrides(list(entries)).apply_to_assets(assets, pointer, notes or Notes())
    return {o.id: o for o in out.objects}


def scene(*more, hint: int = 10) -> AssetSet:
    return room(box(10, **TABLE), box(11, (0.1, 0.06, 0.12), (0.2, 0.1, 0.4), hint=hint), *more)


def test_a_shift_and_a_turn_about_the_center():
    before = scene()
    after = edited(before, {"id": 11, "move": {"by": [0.1, -0.2, 0.05], "turn_deg": 90}})
    pose = after[11].world_from_object
    np.testing.assert_allclose(pose[:3, 3], [0.3, -0.1, 0.45], atol=1e-9)
    np.testing.assert_allclose(pose[:3, 0], [0, 1, 0], atol=1e-9)  # counter-clockwise from above
    np.testing.assert_array_equal(after[10].world_from_object, before.objects[0].world_from_object)
    assert after[11].support_hint == 0


def test_a_turn_is_about_the_center_of_the_box_wherever_the_origin_is():
    off = thing(12, [part((0.1, 0.1, 0.1), (0.3, 0, 0.05))], (0, 0, 0.4), hint=10)
    after = edited(scene(off), {"id": 12, "move": {"turn_deg": 180}})[12]
    np.testing.assert_allclose((after.world_from_object @ [0.3, 0, 0.05, 1])[:3], [0.3, 0, 0.45], atol=1e-9)
    np.testing.assert_allclose(after.world_from_object[:3, 3], [0.6, 0, 0.4], atol=1e-9)
    assert after.support_hint == 10  # it stays in place


def test_an_absolute_pose_is_the_same_applied_once_or_twice():
    quaternion = quat_from_matrix(tilt(25.0)).tolist()
    entry = {"id": 11, "move": {"to": [-0.3, 0.2, 0.7], "wxyz": quaternion}}
    once, twice = edited(scene(), entry), edited(scene(), entry, entry)
    np.testing.assert_allclose(
        once[11].world_from_object, rigid(tilt(25.0), np.array([-0.3, 0.2, 0.7])), atol=1e-9
    )
    np.testing.assert_allclose(once[11].world_from_object, twice[11].world_from_object, atol=1e-9)


def test_shifts_in_several_entries_add_up():
    step = {"id": 11, "move": {"by": [0.1, 0, 0]}}
    assert edited(scene(), step, step)[11].world_from_object[0, 3] == pytest.approx(0.4)


@pytest.mark.parametrize("along", [False, True])
def test_what_is_carried_moves_along_only_if_asked(along):
    before = scene(
        box(12, (0.05, 0.05, 0.05), (0.2, 0.1, 0.52), hint=11), box(13, (0.1,) * 3, (1.5, 0, 0), hint=1)
    )
    entry = {"id": 10, "move": {"by": [0, 0.5, 0], "turn_deg": 90, "with_carried": along}}
    after = edited(before, entry)
    relative = {i: np.linalg.inv(after[10].world_from_object) @ after[i].world_from_object for i in (11, 12)}
    for i, old in ((11, before.objects[1]), (12, before.objects[2])):
        assert np.allclose(relative[i], old.world_from_object) is along  # the table was at the origin
        assert np.allclose(after[i].world_from_object, old.world_from_object) is not along
    assert after[11].support_hint == 10
    np.testing.assert_array_equal(after[13].world_from_object, before.objects[3].world_from_object)


@pytest.mark.parametrize("height", [0.9, 0.41, 0.38, 0.36])
def test_a_thing_above_a_table_or_sunk_in_it_comes_to_rest_on_it(height):
    notes = Notes()
    cup = box(11, (0.08, 0.08, 0.1), (0.2, 0.1, height), hint=1)
    after = edited(room(box(10, **TABLE), cup), {"id": 11, "drop_to_surface": True}, notes=notes)
    assert after[11].world_from_object[2, 3] == pytest.approx(0.4, abs=1e-3)
    np.testing.assert_allclose(after[11].world_from_object[:2, 3], [0.2, 0.1])
    assert after[11].support_hint == 10
    way = "lowered" if height > 0.4 else "lifted"
    assert way in notes.notes[0]
    assert "onto box 10" in notes.notes[0]


def test_a_move_beside_the_table_and_a_drop_end_on_the_floor():
    entry = {"id": 11, "move": {"by": [1.0, 0, 0]}, "drop_to_surface": True}
    after = edited(scene(), entry)[11]
    assert after.world_from_object[2, 3] == pytest.approx(0.0, abs=1e-3)
    assert after.support_hint == 1


def test_a_bin_under_a_table_is_not_lifted_onto_it_and_content_falls_into_a_tray():
    top = thing(10, [part((1.0, 0.7, 0.04), (0, 0, 0.68))], (0, 0, 0))
    bin_, inside = box(11, (0.2, 0.2, 0.3), (0, 0, 0.1)), box(13, (0.05, 0.05, 0.05), (0.1, 0, 0.85))
    assets = room(top, bin_, tray(12, (0.1, 0, 0.7)), inside)
    after = edited(assets, {"id": 11, "drop_to_surface": True}, {"id": 13, "drop_to_surface": True})
    assert after[11].world_from_object[2, 3] == pytest.approx(0.0, abs=1e-3)
    assert after[13].world_from_object[2, 3] == pytest.approx(0.712, abs=2e-3)
    assert after[13].support_hint == 12


def test_a_drop_does_not_rest_on_what_it_carries():
    above = box(12, (0.3, 0.3, 0.02), (0.2, 0.1, 0.52), hint=11)
    low = box(11, (0.1, 0.06, 0.12), (0.2, 0.1, 0.5), hint=10)
    after = edited(room(box(10, **TABLE), low, above), {"id": 11, "drop_to_surface": True})
    assert after[11].world_from_object[2, 3] == pytest.approx(0.4, abs=1e-3)


def test_a_table_on_legs_lands_on_its_legs():
    legs = [part((0.05, 0.05, 0.7), (x, y, 0.35)) for x in (-0.4, 0.4) for y in (-0.3, 0.3)]
    table = thing(10, [part((1.0, 0.7, 0.04), (0, 0, 0.72)), *legs], (0, 0, 0.2))
    after = edited(room(table), {"id": 10, "drop_to_surface": True})
    assert after[10].world_from_object[2, 3] == pytest.approx(0.0, abs=1e-3)


def test_graph_and_assembly_see_the_moved_thing():
    other = box(12, (0.5, 0.5, 0.3), (1.2, 0, 0), label="table")
    assets = scene(other)
    entry = {"id": 11, "move": {"to": [1.2, 0, 0.6]}, "drop_to_surface": True}
    moved = edited(assets, entry)
    after = AssetSet(assets.base, tuple(moved.values()))
    graph = infer_scene_graph(after, SceneGraphConfig())
    assert {e.child: e.parent for e in graph.edges}[11] == 12
    placed = {p.id: p for p in assemble(after, graph, AssemblyConfig()).placed}
    np.testing.assert_allclose(placed[11].world_from_object[:3, 3], [1.2, 0, 0.3], atol=5e-3)
    assert placed[11].stable


def test_a_size_stretches_the_thing_about_its_bottom_center():
    before = scene()
    after = edited(before, {"id": 11, "size_m": [0.3, 0.06, 0.24]})[11]
    old = before.objects[1]
    points = after.visual.vertices
    np.testing.assert_allclose(np.ptp(points, axis=0), [0.3, 0.06, 0.24], atol=1e-6)
    np.testing.assert_allclose(points.min(axis=0)[2], old.visual.vertices.min(axis=0)[2], atol=1e-6)
    np.testing.assert_array_equal(after.world_from_object, old.world_from_object)
    corners = np.concatenate([part.vertices for part in after.collision])
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.3, 0.06, 0.24], atol=1e-6)
    assert after.physics.mass_kg == pytest.approx(6 * old.physics.mass_kg)
    assert after.physics.ranges.mass_kg == pytest.approx([6 * m for m in old.physics.ranges.mass_kg])
    assert "size by the user" in after.provenance.geometry
    again = edited(before, {"id": 11, "size_m": [0.3, 0.06, 0.24]}, {"id": 11, "size_m": [0.1, 0.06, 0.12]})[
        11
    ]
    np.testing.assert_allclose(again.visual.vertices, old.visual.vertices, atol=1e-6)
    np.testing.assert_allclose(again.physics.inertia, old.physics.inertia, rtol=1e-5)


@pytest.mark.parametrize("size", [(0.1, 0.2, 0.3), (0.5, 0.02, 0.1)])
def test_the_inertia_of_a_resized_box_is_that_of_a_box_of_this_size(size):
    """A solid box: m / 12 (b^2 + c^2), and its center of mass is in its middle."""
    start = box(11, (0.1, 0.06, 0.12), (0.2, 0.1, 0.4), hint=10)
    sides = np.ptp(start.visual.vertices, axis=0).astype(float)
    start = replace(
        start,
        physics=replace(
            start.physics,
            center_of_mass=np.array([0, 0, sides[2] / 2]),
            inertia=start.physics.mass_kg / 12 * np.diag((sides**2).sum() - sides**2),
        ),
    )
    after = edited(room(box(10, **TABLE), start), {"id": 11, "size_m": list(size), "mass_kg": 2.0})[11]
    wanted = 2.0 / 12 * np.diag((np.array(size) ** 2).sum() - np.array(size) ** 2)
    np.testing.assert_allclose(after.physics.inertia, wanted, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(after.physics.center_of_mass, [0, 0, size[2] / 2], atol=1e-6)
    assert after.physics.mass_kg == 2.0  # given beside the size, it is the mass of the resized thing
