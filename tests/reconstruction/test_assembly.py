"""Assembly of analytic scenes: upright, inside, at rest, and nothing inside anything."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import ball_part, box, box_part, floor, room, thing, tilt, tray, wall

from reconstruction.assembly import AssemblyConfig, assemble, base_slabs, scene_specs
from reconstruction.assembly.base import convex_part
from reconstruction.assembly.baselines import in_situ
from reconstruction.assembly.collision import cut, flatten_foot
from reconstruction.assembly.placement import base_specs
from reconstruction.core.types import AssembledScene, AssetSet, Edge, Instance, InstanceSet, SceneGraph
from reconstruction.editing.anchors import Pointer
from reconstruction.editing.overrides import Overrides
from reconstruction.scene_graph import SceneGraphConfig, infer_scene_graph
from registry.errors import SimReconError, UsageError
from registry.geometry import rigid, transform_points
from registry.simulation import build_physics, pose_change

pytestmark = pytest.mark.stage


def build(assets: AssetSet, **options) -> tuple[AssembledScene, dict]:
    graph = infer_scene_graph(assets, SceneGraphConfig())
    scene = assemble(assets, graph, AssemblyConfig(**options))
    return scene, {p.id: p for p in scene.placed}


def assert_at_rest(scene: AssembledScene) -> None:
    report = scene.physics_report
    assert report["stable_rate"] == 1.0, report
    assert report["floating_rate"] == 0.0
    assert report["spawn_penetration_mm"] <= 1.0


def test_stack_of_three_that_overlaps_and_floats():
    assets = room(
        box(10, (0.2, 0.2, 0.1), (0, 0, -0.008)),
        box(11, (0.15, 0.15, 0.1), (0.01, 0, 0.085)),
        box(12, (0.1, 0.1, 0.1), (0, 0.01, 0.205)),
    )
    scene, placed = build(assets)
    assert_at_rest(scene)
    for height, i in zip((-0.008, 0.085, 0.205), (10, 11, 12)):
        assert placed[i].world_from_object[2, 3] == pytest.approx(height, abs=9e-3)
        assert placed[i].moved_m < 0.0125
        assert placed[i].dynamic
        assert placed[i].stable


def test_box_in_an_open_tray_ends_inside():
    assets = room(
        box(10, (1.0, 0.7, 0.4), (0, 0, 0), label="table"),
        tray(11, (0, 0, 0.395)),
        box(12, (0.07, 0.07, 0.12), (0.15, 0.1, 0.402)),  # overlaps a wall of the tray by 3 mm
    )
    scene, placed = build(assets)
    assert_at_rest(scene)
    assert not placed[10].dynamic
    inside = np.linalg.inv(placed[11].world_from_object) @ placed[12].world_from_object
    # It was seen 7 mm above the tray's bottom's underside: it ends between there and the bottom's top.
    assert 0.0055 < inside[2, 3] < 0.013
    assert abs(inside[0, 3]) < 0.2 - 0.012 - 0.03
    assert {e.child: e.parent for e in scene.graph.edges}[12] == 11


@pytest.mark.parametrize("offset", [-0.02, 0.03])
def test_picture_touches_the_wall_without_being_inside(offset):
    picture = box(10, (0.5, 0.02, 0.4), (0, 0.99 - offset, 1.2), label="picture")
    scene, placed = build(room(picture))
    assert placed[10].world_from_object[1, 3] == pytest.approx(0.99, abs=1e-3)
    assert placed[10].world_from_object[2, 3] == pytest.approx(1.2, abs=1e-6)
    assert not placed[10].dynamic
    assert_at_rest(scene)


def test_ball_on_a_table_stays_where_it_was_seen():
    assets = room(
        box(10, (1.0, 0.7, 0.4), (0, 0, 0), label="table"), thing(11, [ball_part(0.04)], (0.1, 0, 0.404))
    )
    scene, placed = build(assets)
    assert_at_rest(scene)
    assert placed[11].moved_m < 0.01


def test_tilted_and_sunk_box_is_set_upright_on_the_floor():
    scene, placed = build(room(box(10, (0.3, 0.2, 0.25), (0.3, 0, -0.012), turn=tilt(3.0))))
    assert_at_rest(scene)
    assert placed[10].world_from_object[2, 2] > np.cos(np.radians(0.2))
    assert -0.006 < placed[10].world_from_object[2, 3] < 1e-3


def test_bumpy_underside_is_flattened_and_recorded():
    corners = box_part((0.12, 0.12, 0.2), (0, 0, 0.104)).vertices
    pyramid = np.concatenate([corners, [[0.01, 0.0, 0.0]]])
    scene, placed = build(room(thing(10, [convex_part(pyramid)], (0, 0, 0))))
    assert_at_rest(scene)
    assert placed[10].turned_deg < 1.0
    assert "flattened" in placed[10].repair
    assert len(placed[10].collision) == 1


def test_neighbors_that_overlap_by_more_than_shapes_are_off_are_moved_apart():
    assets = room(box(10, (0.1, 0.1, 0.15), (0, 0, 0)), box(11, (0.1, 0.1, 0.15), (0.072, 0, 0)))
    scene, placed = build(assets)
    assert_at_rest(scene)
    assert placed[11].world_from_object[0, 3] - placed[10].world_from_object[0, 3] >= 0.0995
    assert max(p.moved_m for p in scene.placed) < 0.03


def test_neighbors_that_overlap_a_little_stay_and_both_shapes_give_way():
    assets = room(box(10, (0.1, 0.1, 0.15), (0, 0, 0)), box(11, (0.1, 0.1, 0.15), (0.09, 0, 0)))
    scene, placed = build(assets)
    assert_at_rest(scene)
    assert max(p.moved_m for p in scene.placed) < 1e-3
    for i in (10, 11):
        assert "gave way" in placed[i].repair
        (part,) = placed[i].collision
        assert np.ptp(part.vertices[:, 0]) == pytest.approx(0.095, abs=5e-4)


def test_what_hangs_on_a_thing_that_moves_is_fixed_to_it():
    crate, handle = box(10, (0.3, 0.3, 0.2), (0, 0, 0)), box(11, (0.1, 0.03, 0.03), (0, -0.165, 0.1))
    graph = SceneGraph((Edge(10, "supported_by", 1, 1.0, ""), Edge(11, "attached_to", 10, 1.0, "")))
    scene = assemble(room(crate, handle), graph, AssemblyConfig())
    assert_at_rest(scene)  # on its own the handle would fall
    placed = {p.id: p for p in scene.placed}
    assert placed[10].dynamic
    assert placed[11].dynamic
    assert scene.physics_report["contacts"]["attached_edges_real"] == 1
    specs = scene_specs(
        in_situ(assets_at(room(crate, handle), placed), graph.edges, {}, AssemblyConfig()).values(),
        base_specs(room(crate, handle)),
    )
    physics = build_physics(specs)
    before = np.linalg.inv(physics.pose(10)) @ physics.pose(11)
    physics._bodies[10].set_linear_velocity(np.array([1.0, 0.5, 1.0]))
    physics._bodies[10].set_angular_velocity(np.array([0.0, 0.0, 2.0]))
    physics.step(120)
    assert pose_change(rigid(), physics.pose(10))[0] > 0.05
    moved, turned = pose_change(before, np.linalg.inv(physics.pose(10)) @ physics.pose(11))
    assert moved < 2e-3
    assert turned < 1.0


def assets_at(assets: AssetSet, placed: dict) -> AssetSet:
    """Return the assets at the poses where they were placed."""
    objects = [replace(o, world_from_object=placed[o.id].world_from_object) for o in assets.objects]
    return replace(assets, objects=tuple(objects))


def test_the_user_says_what_can_move():
    assets = room(box(10, (1.0, 0.7, 0.4), (0, 0, 0), label="table"), box(11, (0.1, 0.1, 0.1), (0.1, 0, 0.4)))
    graph = infer_scene_graph(assets, SceneGraphConfig())
    by_rule = {p.id: p.dynamic for p in assemble(assets, graph, AssemblyConfig()).placed}
    assert by_rule == {10: False, 11: True}
    for method in ("hierarchical", "in-situ"):
        scene = assemble(assets, graph, AssemblyConfig(method=method), movable={10: True, 11: False})
        assert {p.id: p.dynamic for p in scene.placed} == {10: True, 11: False}


def test_too_heavy_things_do_not_move():
    _, placed = build(
        room(box(10, (0.3, 0.3, 0.3), (0, 0, 0), mass=20.0), box(11, (0.3, 0.3, 0.3), (1, 0, 0)))
    )
    assert (placed[10].dynamic, placed[11].dynamic) == (False, True)


@pytest.mark.parametrize("method", ["in-situ", "mcmc"])
def test_baselines_leave_shapes_as_they_are_and_are_measured_alike(method):
    assets = room(
        box(10, (0.2, 0.2, 0.1), (0, 0, -0.008)),
        box(11, (0.15, 0.15, 0.1), (0.17, 0, 0.001)),
        box(12, (0.1, 0.1, 0.1), (0.5, 0.01, 0.018)),
    )
    edges = tuple(Edge(i, "supported_by", 1, 1.0, "") for i in (10, 11, 12))
    config = AssemblyConfig(method=method, mcmc_sweeps=60)
    scene = assemble(assets, SceneGraph(edges), config)
    report, placed = scene.physics_report, {p.id: p for p in scene.placed}
    assert all(p.collision is None and p.repair == "" for p in scene.placed)
    floating = {o["id"]: o["floating"] for o in report["objects"]}
    if method == "in-situ":
        assert max(p.moved_m for p in scene.placed) == 0
        assert report["spawn_penetration_mm"] == pytest.approx(8, abs=0.2)
        assert floating == {10: False, 11: False, 12: True}
    else:
        assert 0.005 < placed[10].moved_m < 0.05
        assert report["spawn_penetration_mm"] < 2.0
        again = assemble(assets, SceneGraph(edges), config)
        assert again.physics_report == report
        other = assemble(assets, SceneGraph(edges), replace(config, seed=1))
        assert not np.array_equal(other.placed[0].world_from_object, scene.placed[0].world_from_object)


def test_uneven_table_top_carries_at_its_visible_height():
    # The convex hull of a table with a raised edge lies 2 cm above the visible top.
    top, edge = box_part((1.0, 0.7, 0.4), (0, 0, 0.2)), box_part((1.0, 0.02, 0.42), (0, 0.34, 0.21))
    low_edge = box_part((1.0, 0.02, 0.42), (0, -0.34, 0.21))
    table = thing(10, [top, edge, low_edge], (0, 0, 0), label="table")
    table = replace(table, collision=(box_part((1.0, 0.7, 0.42), (0, 0, 0.21)),))
    scene, placed = build(room(table, box(11, (0.1, 0.1, 0.1), (0.1, 0, 0.4))))
    assert_at_rest(scene)
    assert placed[11].world_from_object[2, 3] == pytest.approx(0.4, abs=2e-3)
    assert "cut" in placed[10].repair
    assert placed[10].collision


def test_furniture_that_reaches_into_the_floor_keeps_its_height():
    scene, placed = build(room(box(10, (1.0, 0.7, 0.4), (0, 0, -0.03), label="table")))
    assert placed[10].moved_m < 1e-6
    parts, pose = placed[10].collision, placed[10].world_from_object
    bottom = min(transform_points(pose, p.vertices)[:, 2].min() for p in parts)
    assert bottom >= 0.0
    assert_at_rest(scene)


def test_what_falls_over_lies_at_rest_and_says_so():
    scene, placed = build(room(box(10, (0.01, 0.01, 0.1), (0, 0, 0), turn=tilt(30.0))))
    assert_at_rest(scene)
    assert placed[10].turned_deg > 30
    assert "does not stand" in placed[10].repair


def test_what_cannot_stand_is_said_not_to():
    # Its center of mass hangs over the edge of a post, 0.8 m above the floor.
    assets = room(box(10, (0.1, 0.1, 0.8), (0, 0, 0)), box(11, (0.3, 0.06, 0.06), (0.12, 0, 0.8)))
    _, placed = build(assets)
    assert not placed[11].stable
    assert "does not stand" in placed[11].repair
    frozen, placed = build(assets, freeze_unstable=True)
    assert not placed[11].dynamic
    assert "immovable" in placed[11].repair
    assert frozen.physics_report["dynamic_objects"] == 0


def test_assembly_is_deterministic():
    assets = room(
        box(10, (1.0, 0.7, 0.4), (0, 0, 0), label="table"),
        tray(11, (0, 0, 0.395)),
        thing(12, [ball_part(0.03)], (0, 0, 0.42)),
    )
    (first, _), (second, _) = build(assets), build(assets)
    assert first.physics_report == second.physics_report
    for a, b in zip(first.placed, second.placed):
        assert np.array_equal(a.world_from_object, b.world_from_object)


def test_unconnected_objects_are_refused():
    assets = room(box(10, (0.1, 0.1, 0.1), (0, 0, 0)), box(11, (0.1, 0.1, 0.1), (1, 0, 0)))
    edges = (Edge(10, "supported_by", 11, 1.0, ""), Edge(11, "supported_by", 10, 1.0, ""))
    with pytest.raises(SimReconError, match=r"\[10, 11\]"):
        assemble(assets, SceneGraph(edges), AssemblyConfig())


def test_base_slabs_have_their_face_on_the_plane_and_lie_behind_it():
    for base in (floor(), wall()):
        (slab,) = base_slabs(base)
        distance = slab.vertices @ base.plane[:3] + base.plane[3]
        assert distance.max() == pytest.approx(0, abs=1e-6)
        assert distance.min() <= -0.1
    (slab,) = base_slabs(floor())
    assert slab.vertices[:, 0].max() > 5


def test_cut_keeps_the_volume_on_one_side():
    (half,) = cut((box_part((0.2, 0.2, 0.2)),), np.array([0, 0, 1.0]), 0.05)
    assert half.vertices[:, 2].min() == pytest.approx(-0.05, abs=1e-6)
    assert half.vertices[:, 2].max() == pytest.approx(0.1, abs=1e-6)
    assert cut((box_part((0.2, 0.2, 0.2)),), np.array([0, 0, 1.0]), -0.2) == ()


def test_flat_patch_of_a_sphere_has_the_expected_radius():
    radius, band = 0.05, 0.002
    (foot,) = flatten_foot((ball_part(radius),), np.array([0, 0, 1.0]), band)
    low = foot.vertices[foot.vertices[:, 2] < foot.vertices[:, 2].min() + 1e-6]
    assert len(low) >= 3
    assert np.linalg.norm(low[:, :2], axis=1).max() == pytest.approx(np.sqrt(2 * radius * band), rel=0.6)
    turned = rigid(tilt(40))[:3, :3]
    assert np.ptp(foot.vertices @ turned.T, axis=0).max() < 2 * radius + 1e-3


def test_furniture_deep_inside_other_furniture_is_cut_not_left_overlapping():
    """10 cm are more than a thing may be shifted by: the collision shape gives way, the looks stay."""
    first = box(3, (0.8, 0.5, 0.9), (0.0, 0.0, 0.0), label="cabinet", mass=40.0)
    second = box(4, (0.8, 0.5, 0.7), (0.7, 0.0, 0.0), label="cabinet", mass=30.0)
    assets = room(first, second)
    graph = SceneGraph(tuple(Edge(i, "supported_by", 1, 1.0, "") for i in (3, 4)))
    scene = assemble(assets, graph, AssemblyConfig())
    assert scene.physics_report["spawn_penetration_mm"] < 1.0
    assert all(not item.dynamic for item in scene.placed)
    cut_off = [item for item in scene.placed if "inside a neighbor" in item.repair]
    assert len(cut_off) == 1
    assert cut_off[0].moved_m < 0.05


def test_a_small_thing_frozen_inside_furniture_is_cut_clear_of_it():
    """A box sticks 9 cm out of a cabinet's side in mid-air: it can neither be shifted out nor stay by itself."""
    cabinet = box(3, (0.8, 0.5, 0.9), (0.0, 0.0, 0.0), label="cabinet", mass=40.0)
    stuck = box(4, (0.2, 0.1, 0.1), (0.39, 0.0, 0.45))
    graph = SceneGraph((Edge(3, "supported_by", 1, 1.0, ""), Edge(4, "supported_by", 3, 1.0, "")))
    scene = assemble(room(cabinet, stuck), graph, AssemblyConfig())
    held = next(item for item in scene.placed if item.id == 4)
    assert not held.dynamic
    assert not held.stable
    assert held.moved_m < 0.1
    assert "inside a neighbor" in held.repair
    assert scene.physics_report["spawn_penetration_mm"] < 1.0


def test_what_tips_as_it_was_seen_gets_the_legs_that_were_not():
    # A rack of which depth found the board and one of its four wire legs.
    board, leg = box_part((0.3, 0.4, 0.04), (0, 0, 0.16)), box_part((0.03, 0.03, 0.15), (-0.13, -0.18, 0.075))
    scene, placed = build(room(thing(10, [board, leg], (0, 0, 0)), box(11, (0.1, 0.1, 0.1), (0.6, 0, 0))))
    assert_at_rest(scene)
    assert placed[10].moved_m < 2e-3
    assert placed[10].turned_deg < 1
    assert placed[10].dynamic
    assert "legs" in placed[10].repair
    assert len(placed[10].collision) == 5
    assert "legs" not in placed[11].repair


def test_a_bowl_stands_in_the_plate_whose_collision_shape_has_no_hollow():
    bottom = box_part((0.26, 0.26, 0.01), (0, 0, 0.005))
    rims = [box_part((0.26, 0.03, 0.03), (0, y, 0.015)) for y in (-0.115, 0.115)]
    rims += [box_part((0.03, 0.26, 0.03), (x, 0, 0.015)) for x in (-0.115, 0.115)]
    plate = thing(10, [bottom, *rims], (0, 0, 0), label="plate")
    plate = replace(plate, collision=(box_part((0.26, 0.26, 0.03), (0, 0, 0.015)),))
    scene, placed = build(room(plate, box(11, (0.12, 0.12, 0.08), (0, 0, 0.01))))
    assert_at_rest(scene)
    assert placed[11].moved_m < 3e-3
    # The rim still stops what slides on the plate.
    high = [p for p in placed[10].collision if p.vertices[:, 2].max() > 0.029]
    assert min(np.abs(p.vertices[:, :2]).max(axis=1).min() for p in high) > 0.05


def test_overrides_say_what_can_move_but_not_of_what_hangs():
    items = [Instance(i, "box", 0.9, np.zeros(3), 0.0, np.full(3, 0.2), 1, i == 11) for i in (10, 11)]
    pointer = Pointer(
        InstanceSet(np.zeros(0, np.int32), (), tuple(items), np.zeros((0, 0, 0), np.uint16)), None
    )
    assets = room(box(10, (0.3, 0.3, 0.2), (0, 0, 0)), box(11, (0.1, 0.03, 0.03), (0, -0.165, 0.1)))
    graph = SceneGraph((Edge(10, "supported_by", 1, 1.0, ""), Edge(11, "attached_to", 10, 1.0, "")))
    assert Overrides([{"id": 10, "dynamic": False}]).movable(assets, graph, pointer) == {10: False}
    with pytest.raises(UsageError, match="attached to 10"):
        Overrides([{"id": 11, "dynamic": True}]).movable(assets, graph, pointer)


def test_overrides_refuse_a_dynamic_that_is_neither_true_nor_false(tmp_path):
    (tmp_path / "fixes.yaml").write_text("- {id: 10, dynamic: sometimes}")
    with pytest.raises(UsageError, match="dynamic must be true or false"):
        Overrides.load(tmp_path / "fixes.yaml")
