"""Nothing is published inside anything: what fills the place of another thing is hollowed out."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box, box_part, floor, mesh_of, room, thing, wall

from reconstruction.assembly import AssemblyConfig, assemble, faults_of, scene_specs
from reconstruction.assembly.base import convex_part
from reconstruction.assembly.collision_trimming import cut_out
from reconstruction.assembly.hollow import fills_air, hollowed, volume
from reconstruction.assembly.place import Placer
from reconstruction.assembly.placement import Placement, base_specs
from reconstruction.assembly.workbench import object_spec
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import AssembledScene, AssetSet, Edge, ObjectAsset, SceneGraph
from registry.geometry import rigid, transform_points
from registry.report_card import physics_report

SIZE = (1.2, 0.6, 0.9)


def cabinet(number: int = 10, at=(0.0, 0.0, 0.0)) -> ObjectAsset:
    """A solid cabinet, and solid to the eye, too."""
    return box(number, SIZE, at, label="cabinet", mass=60.0)


def counter(number: int = 10) -> ObjectAsset:
    """A counter with a back panel, as a coarse decomposition has it: one piece that fills the air above the top."""
    low, back = box_part((1.2, 0.6, 0.5), (0, 0, 0.25)), box_part((1.2, 0.06, 0.4), (0, 0.27, 0.7))
    whole = convex_part(np.concatenate([low.vertices, back.vertices]))
    return replace(thing(number, [whole], (0, 0, 0), label="counter", mass=60.0), visual=mesh_of([low, back]))


def placement(asset: ObjectAsset, pose: np.ndarray | None = None) -> Placement:
    edge = Edge(asset.id, "supported_by", 1, 1.0, "")
    where = asset.world_from_object if pose is None else pose
    return Placement(asset, edge, where, asset.collision, asset.collision, False, 0.0, (), True)


def edges(*triples: tuple[int, str, int]) -> SceneGraph:
    return SceneGraph(tuple(Edge(child, relation, parent, 1.0, "") for child, relation, parent in triples))


def assert_nothing_inside(scene: AssembledScene) -> None:
    report = scene.physics_report
    assert report["spawn_penetration_mm"] <= 1.0, report["spawn_penetration_between"]
    assert report["stable_rate"] == 1.0
    assert report["floating_rate"] == 0.0


def share_filled(parts, points: np.ndarray) -> float:
    """Return the share of points (n, 3) that are within some piece."""
    from scipy.spatial import ConvexHull

    inside = np.zeros(len(points), bool)
    for part in parts:
        planes = ConvexHull(np.asarray(part.vertices, np.float64)).equations
        inside |= np.all(points @ planes[:, :3].T + planes[:, 3] <= 1e-9, axis=1)
    return float(inside.mean())


@pytest.mark.parametrize("turn_deg", [0.0, 30.0])
def test_what_is_hollowed_out_loses_the_place_of_the_thing_and_little_else(turn_deg):
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    pose = rigid(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([0.2, 0.05, 0.3]))
    big, small = placement(cabinet()), placement(box(11, (0.1, 0.2, 0.3), (0, 0, 0)), pose)
    left = hollowed(big, small, 1e-4)
    rng = np.random.default_rng(0)
    within = transform_points(pose, rng.uniform((-0.05, -0.1, 0), (0.05, 0.1, 0.3), (500, 3)))
    assert share_filled(left, within) == 0.0
    low, high = np.array([-0.6, -0.3, 0.0]), np.array([0.6, 0.3, 0.9])
    anywhere = rng.uniform(low, high, (20000, 3))
    own = (anywhere - pose[:3, 3]) @ pose[:3, :3]
    beside = (np.abs(own[:, :2]) > [0.052, 0.102]).any(axis=1) | (own[:, 2] < -0.002) | (own[:, 2] > 0.302)
    assert share_filled(left, anywhere[beside]) > 0.999
    # What is under it, and above it, is in one piece as wide as all of the cabinet.
    assert sum(np.ptp(part.vertices[:, 0]) > 1.19 for part in left) >= 2


def test_only_the_pieces_that_a_thing_is_in_are_hollowed_out():
    top, leg = box_part((1.0, 0.6, 0.05), (0, 0, 0.7)), box_part((0.05, 0.05, 0.675), (0.4, 0.2, 0.3375))
    table = placement(thing(10, [top, leg], (0, 0, 0), label="table"))
    left = hollowed(table, placement(box(11, (0.1, 0.1, 0.2), (0, 0, 0.6))), 1e-4)
    assert any(part is leg for part in left)
    assert all(part is not top for part in left)
    # A table is hollow below its top: what is there is in none of its pieces, although it is in their hull.
    assert hollowed(table, placement(box(11, (0.1, 0.1, 0.2), (0, 0, 0.2))), 1e-4) == (top, leg)


def test_pieces_that_fill_air_are_told_from_what_was_seen():
    standing = placement(box(11, (0.1, 0.1, 0.2), (0, 0.1, 0.5)))
    sunk = placement(box(11, (0.1, 0.1, 0.2), (0, 0.1, 0.1)))
    assert fills_air(placement(counter()), standing, 1e-4)
    assert not fills_air(placement(counter()), sunk, 1e-4)
    assert not fills_air(placement(counter()), placement(box(11, (0.1, 0.1, 0.2), (3, 0, 0))), 1e-4)


def test_a_thing_stands_where_it_was_seen_in_the_air_that_its_carriers_pieces_fill():
    assets = room(counter(), box(11, (0.08, 0.08, 0.2), (0.1, 0.1, 0.501)))
    scene = assemble(assets, edges((10, "supported_by", 1), (11, "supported_by", 10)), AssemblyConfig())
    assert_nothing_inside(scene)
    placed = {p.id: p for p in scene.placed}
    assert placed[11].dynamic
    assert placed[11].moved_m < 0.005
    assert placed[11].collision is None or "cut off" not in placed[11].repair
    assert "hollowed out where box 11 is" in placed[10].repair
    assert scene.physics_report["contacts"]["support_edges_real"] == 2


def test_a_thing_is_not_lifted_off_its_place_by_what_its_carriers_pieces_fill():
    """A place clear of the pieces is some 5 cm away: in reach, and nevertheless not where it was seen."""
    assets = room(counter(), box(11, (0.04, 0.04, 0.1), (0, -0.22, 0.501)))
    scene = assemble(assets, edges((10, "supported_by", 1), (11, "supported_by", 10)), AssemblyConfig())
    assert_nothing_inside(scene)
    placed = {p.id: p for p in scene.placed}
    assert placed[11].dynamic
    assert placed[11].moved_m < 0.003


@pytest.mark.parametrize("relation", ["supported_by", "attached_to"])
def test_a_thing_wholly_inside_furniture_is_held_in_a_hollow(relation):
    """Solid to the eye and in its collision shape; what was seen in it is there nevertheless."""
    bottle = box(11, (0.08, 0.08, 0.25), (0.1, 0.05, 0.4), label="bottle")
    onlookers = [box(12, (0.2, 0.2, 0.1), (0.1, 0.05, 0.9)), box(13, (0.1, 0.1, 0.3), (-0.3, 0, 0.9))]
    graph = edges(
        (10, "supported_by", 1), (11, relation, 10), (12, "supported_by", 10), (13, "supported_by", 10)
    )
    scene = assemble(room(cabinet(), bottle, *onlookers), graph, AssemblyConfig())
    assert_nothing_inside(scene)
    placed = {p.id: p for p in scene.placed}
    assert not placed[11].dynamic
    assert placed[11].moved_m < 0.035
    assert "hollowed out where bottle 11 is" in placed[10].repair
    # What stands on the cabinet stands on it still, right above the hollow, too.
    assert all(placed[i].dynamic and placed[i].moved_m < 2e-3 for i in (12, 13))
    assert scene.physics_report["contacts"]["edges_without_contact"] == []
    assert scene.physics_report["without_collision"] == []


def test_furniture_wholly_inside_furniture_is_in_a_hollow():
    inner = box(11, (0.7, 0.3, 0.5), (0, 0, 0), label="cabinet", mass=30.0)
    graph = edges((10, "supported_by", 1), (11, "supported_by", 1))
    scene = assemble(room(cabinet(), inner), graph, AssemblyConfig())
    assert_nothing_inside(scene)
    assert "hollowed out" in next(p.repair for p in scene.placed if p.id == 10)
    assert scene.physics_report["contacts"]["support_edges_real"] == 2


class Notes:
    """Progress that keeps what it is told."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.start, self.advance = NO_PROGRESS.start, NO_PROGRESS.advance

    def note(self, message: str) -> None:
        self.lines.append(message)


def test_of_two_things_at_one_place_the_second_has_no_collision_shape_and_that_is_said():
    """Nothing would be left of either; what stands on the second one stands on the first then."""
    assets = room(cabinet(10), cabinet(11), box(12, (0.1, 0.1, 0.1), (0, 0, 0.9)))
    graph = edges((10, "supported_by", 1), (11, "supported_by", 1), (12, "supported_by", 11))
    notes = Notes()
    scene = assemble(assets, graph, AssemblyConfig(), progress=notes)
    assert_nothing_inside(scene)
    placed = {p.id: p for p in scene.placed}
    assert placed[11].collision == ()
    assert not placed[11].dynamic
    assert "without a collision shape: no place is free of cabinet 10" in placed[11].repair
    assert scene.physics_report["without_collision"] == ["cabinet_11"]
    assert any("cabinet 11" in line and "without a collision shape" in line for line in notes.lines)
    assert {e.child: e.parent for e in scene.graph.edges}[12] == 10
    assert placed[12].dynamic


def test_a_thing_behind_a_wall_has_no_collision_shape():
    """A wall is as thick as it is; the thing is where it was seen, through a window."""
    assets = AssetSet((floor(), wall()), (box(10, (0.3, 0.1, 0.3), (0, 1.15, 1.0)),))
    scene = assemble(assets, edges((10, "attached_to", 2)), AssemblyConfig(max_wall_snap_m=0.05))
    assert_nothing_inside(scene)
    (placed,) = scene.placed
    assert placed.collision == ()
    assert placed.moved_m < 1e-6
    assert "no place is free of wall 2" in placed.repair


def test_neighbors_are_as_they_were_where_a_way_was_not_taken():
    """Two things at one place, in the air that a counter fills: the second one finds none, and the counter is whole."""
    item = box(12, (0.1, 0.1, 0.2), (0, 0.1, 0.501))
    assets = room(counter(), box(11, (0.1, 0.1, 0.2), (0, 0.1, 0.501)), item)
    graph = edges((10, "supported_by", 1), (11, "supported_by", 10), (12, "supported_by", 10))
    placer = Placer(assets, graph.edges, AssemblyConfig(), {})
    for other in assets.objects[:2]:
        placer.commit(placement(other))
    before = dict(placer.placed)
    found = placer.cut_clear(placement(item))
    assert not found.stands
    assert found.parts is item.collision
    assert all(placer.placed[i] is before[i] for i in (10, 11))


def test_pieces_are_cut_until_the_engine_finds_them_apart():
    """Of a rough top the engine merges faces that are nearly level: its shape is half a millimetre larger there."""
    rng = np.random.default_rng(7)
    plan = rng.uniform(-1, 1, (60, 2)) * [0.2, 0.4]
    height = 0.2 - 0.006 * ((plan / [0.2, 0.4]) ** 2).sum(axis=1) + rng.normal(0, 7e-4, 60)
    points = np.concatenate(
        [box_part((0.4, 0.8, 0.1), (0, 0, 0.05)).vertices, np.column_stack([plan, height])]
    )
    rough = thing(10, [convex_part(points)], (0, 0, 0), label="cabinet", mass=60.0)
    item = box(11, (0.1, 0.1, 0.05), (-0.07416939661426308, -0.15085813607461027, 0.1998136))
    graph = edges((10, "supported_by", 1), (11, "supported_by", 10))
    placer = Placer(room(rough, item), graph.edges, AssemblyConfig(), {})
    placer.commit(placement(rough))
    assert cut_out(item.collision, item.world_from_object, rough.collision, rigid(), 0.0)[1] == 0.0
    placer.bench.put(object_spec(item, item.collision, item.world_from_object, dynamic=True))
    assert placer.bench.probe(11, item.world_from_object, 3e-4)
    found = placer.cut_clear(placement(item), at_any_cost=True)
    assert 0.95 * volume(item.collision) < volume(found.parts) < volume(item.collision)
    placer.bench.put(object_spec(item, found.parts, found.pose, dynamic=True))
    assert not placer.bench.probe(11, found.pose, 3e-4)


def test_what_is_inside_something_in_the_end_is_found_with_who_came_later():
    assets = room(cabinet(), box(11, (0.1, 0.1, 0.1), (0, 0, 0.895)), box(12, (0.1, 0.1, 0.1), (0.3, 0, 0.9)))
    graph = edges((10, "supported_by", 1), (11, "supported_by", 10), (12, "supported_by", 10))
    placer = Placer(assets, graph.edges, AssemblyConfig(), {})
    for item in assets.objects:
        placer.placed[item.id] = placement(item)
    base = base_specs(assets)
    report = physics_report(scene_specs(placer.placed.values(), base), graph.edges)
    assert faults_of(placer, base, report, set()) == {11: "overlaps cabinet 10"}
    assert faults_of(placer, base, report, {11}) == {}
