"""Assembly moves things by as little as it can, and by nothing where shapes are what is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box, box_part, floor, room, thing

from reconstruction.assembly import AssemblyConfig, assemble, restless_objects
from reconstruction.assembly.collision_trimming import cut_out, give_way
from reconstruction.assembly.depenetration import least_move, make_clear
from reconstruction.assembly.placement import base_specs
from reconstruction.assembly.tops import seat
from reconstruction.assembly.workbench import Workbench, object_spec, support_margin
from reconstruction.assets.gltf import read_obj, write_obj
from reconstruction.core.types import AssetSet, Edge, SceneGraph
from registry.geometry import rigid
from registry.report_card import physics_report
from registry.simulation import read_obj_points


def standing_on(*pairs: tuple[int, int]) -> SceneGraph:
    return SceneGraph(tuple(Edge(child, "supported_by", parent, 1.0, "") for child, parent in pairs))


@pytest.mark.parametrize(
    ("normals", "least", "expected"),
    [
        ([[1, 0, 0]], [0.004], [0.004, 0, 0]),
        ([[1, 0, 0], [0, 0, 1]], [0.004, 0.001], [0.004, 0, 0.001]),
        ([[1, 0, 0], [0.6, 0.8, 0]], [0.004, 0.001], [0.004, 0, 0]),  # the second one is met by the first
        ([[0.6, 0, 0.8]], [0.005], [0.003, 0, 0.004]),
        ([[1, 0, 0], [-1, 0, 0]], [0.004, 0.001], None),
    ],
)
def test_the_least_move_out_of_planes(normals, least, expected):
    found = least_move(np.array(normals, float), np.array(least))
    if expected is None:
        assert found is None
    else:
        assert found == pytest.approx(np.array(expected), abs=1e-7)


def test_a_lift_that_settling_takes_back_is_preferred_to_a_shift():
    found = least_move(np.array([[0.6, 0, 0.8]]), np.array([0.005]), lift_cost=0.5)
    assert found[2] > 3 * found[0]
    assert 0.6 * found[0] + 0.8 * found[2] == pytest.approx(0.005)


def test_a_thing_leaves_its_neighbor_by_the_shortest_way():
    """3 mm into one side of a neighbor and 1 mm into the floor: 3 mm sideways, 1 mm up, not over it."""
    near, stuck = box(10, (0.1, 0.1, 0.1), (0, 0, 0)), box(11, (0.1, 0.1, 0.1), (0.02, 0.097, -0.001))
    bench = Workbench(base_specs(AssetSet((floor(),), ())))
    for item in (near, stuck):
        bench.put(object_spec(item, item.collision, item.world_from_object, dynamic=True))
    pose, clear = make_clear(
        bench, 11, stuck.world_from_object, max_lift_m=0.06, max_shift_m=0.03, tolerance_m=3e-4
    )
    assert clear
    assert pose[:3, 3] - stuck.world_from_object[:3, 3] == pytest.approx([0, 0.003, 0.001], abs=4e-4)


def test_only_pieces_that_overlap_sideways_give_way():
    pose, part = rigid(), box_part((0.1, 0.1, 0.1))
    far = box_part((0.1, 0.1, 0.1), (-0.11, 0, 0))
    beside = rigid(None, np.array([0.09, 0, 0]))
    options = {"tolerance_m": 3e-4, "most_m": 0.012, "rests_on": False}
    ours, theirs, depth = give_way((part, far), pose, (part,), beside, **options)
    assert depth == pytest.approx(0.01, abs=1e-6)
    assert ours[1] is far
    assert ours[0].vertices[:, 0].max() == pytest.approx(0.0449, abs=1e-5)
    assert theirs[0].vertices[:, 0].min() == pytest.approx(-0.0449, abs=1e-5)
    # Deeper than both may give, and not at all: nothing is cut.
    for x in (0.07, 0.1001):
        ours, _, depth = give_way((part,), pose, (part,), rigid(None, np.array([x, 0, 0])), **options)
        assert depth == 0
        assert ours[0] is part
    # What carries a thing is below it: the way out is up, which is not theirs to cut.
    above = rigid(None, np.array([0.0, 0, 0.09]))
    assert give_way((part,), above, (part,), pose, **options | {"rests_on": True})[2] == 0


def test_what_is_cut_out_of_another_ends_at_its_surface():
    plank, pose = box_part((0.2, 0.03, 0.5)), rigid()
    inside = rigid(None, np.array([0.05, 0.01, 0.0]))  # 2 cm of 3 are in it
    (left,), depth = cut_out((plank,), inside, (plank,), pose, 1e-4)
    assert depth == pytest.approx(0.02, abs=1e-6)
    assert left.vertices[:, 1].min() + 0.01 == pytest.approx(0.0152, abs=1e-5)
    assert np.ptp(left.vertices[:, 1]) == pytest.approx(0.0098, abs=1e-5)
    assert cut_out((plank,), pose, (plank,), pose, 1e-4) == ((), pytest.approx(0.03))


def test_a_probe_pushes_out_what_is_free_whoever_was_free_first():
    lower, upper = box(10, (0.4, 0.4, 0.1), (0, 0, 0.5)), box(11, (0.1, 0.1, 0.1), (0, 0, 0.59))
    bench = Workbench(base_specs(AssetSet((floor(),), ())))
    for item in (lower, upper):
        bench.put(object_spec(item, item.collision, item.world_from_object, dynamic=True))
    for number, item, up in ((11, upper, 1), (10, lower, -1), (11, upper, 1), (10, lower, -1)):
        contacts = bench.probe(number, item.world_from_object, 3e-4)
        assert contacts
        assert all(c.first == number and c.normal[2] == pytest.approx(up) for c in contacts)


def test_furniture_in_a_wall_stays_and_its_shape_ends_there():
    scene = assemble(
        room(box(10, (1.0, 0.4, 0.8), (0, 0.815, 0), label="table")), standing_on((10, 1)), AssemblyConfig()
    )
    (placed,) = scene.placed
    assert placed.moved_m < 3e-4
    assert max(p.vertices[:, 1].max() for p in placed.collision) + 0.815 <= 1.0
    assert scene.physics_report["spawn_penetration_mm"] < 0.1


def test_what_cannot_stand_is_held_where_it_was_seen():
    """Half of it hangs over the edge of a post, too far for any repair; it touches the post still."""
    assets = room(box(10, (0.1, 0.1, 0.8), (0, 0, 0)), box(11, (0.3, 0.06, 0.06), (0.12, 0, 0.806)))
    scene = assemble(assets, standing_on((10, 1), (11, 10)), AssemblyConfig())
    held = {p.id: p for p in scene.placed}[11]
    assert not held.dynamic
    assert held.moved_m < 7e-3
    assert held.turned_deg < 1e-3
    assert scene.physics_report["contacts"]["support_edges_real"] == 2


def test_what_hangs_on_a_hanging_thing_is_not_moved_off_the_wall():
    """A head on a panel, both said to hang on the wall, the panel inside the head's back."""
    panel, head = box(10, (1.0, 0.06, 1.0), (0, 0.97, 0.5)), box(11, (0.3, 0.4, 0.3), (0, 0.8, 0.9))
    graph = SceneGraph(tuple(Edge(i, "attached_to", 2, 1.0, "seen") for i in (10, 11)))
    scene = assemble(room(panel, head), graph, AssemblyConfig())
    placed = {p.id: p for p in scene.placed}
    assert max(p.moved_m for p in scene.placed) < 1e-3
    assert {e.child: e.parent for e in scene.graph.edges} == {10: 2, 11: 10}
    assert "hangs on 10 instead of 2" in placed[11].repair
    assert scene.physics_report["contacts"]["attached_edges_real"] == 2


def test_a_thing_stays_where_it_stood_on_a_top_that_nobody_saw():
    """Of the carrier's top only one half was closed; what stands on it would tip into the other one."""
    low, half = box_part((0.2, 0.2, 0.08), (0, 0, 0.04)), box_part((0.08, 0.2, 0.02), (-0.06, 0, 0.09))
    carrier = thing(10, [low, half], (0, 0, 0))
    child = box(11, (0.16, 0.12, 0.05), (0.01, 0, 0.1))
    scene = assemble(room(carrier, child), standing_on((10, 1), (11, 10)), AssemblyConfig())
    placed = {p.id: p for p in scene.placed}
    assert scene.physics_report["stable_rate"] == 1.0
    assert placed[11].moved_m < 2e-3
    assert placed[11].turned_deg < 1.0
    assert placed[11].dynamic
    assert "made level under box 11" in placed[10].repair


def test_a_seat_leaves_walls_and_other_boards():
    top, wall_piece = box_part((0.4, 0.4, 0.02), (0, 0, 0.005)), box_part((0.02, 0.4, 0.2), (0.05, 0, 0.1))
    bump = box_part((0.02, 0.02, 0.01), (-0.03, 0, 0.016))
    place = np.array([[-0.06, -0.06], [0.06, -0.06], [0.06, 0.06], [-0.06, 0.06]])
    made = seat((top, wall_piece, bump), rigid(), place, 0.015, 0.024)
    assert any(p is wall_piece for p in made)
    assert max(p.vertices[:, 2].max() for p in made if p is not wall_piece) == pytest.approx(0.015, abs=1e-6)
    beside = (wall_piece,)
    assert seat(beside, rigid(), place - 1.0, 0.015, 0.024) is beside


def test_a_plank_across_a_foot_is_kept_where_their_outlines_cross_without_a_corner_in_common():
    plank = box_part((0.8, 0.04, 0.01), (0, 0, 0.005))
    place = np.array([[-0.02, -0.4], [0.02, -0.4], [0.02, 0.4], [-0.02, 0.4]])
    assert len(seat((plank,), rigid(), place, 0.012, 0.024)) == 1


def test_the_margin_of_a_stand():
    square = np.array([[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]], float)
    assert support_margin(square, np.array([0.05, 0.02])) == pytest.approx(0.02)
    assert support_margin(square, np.array([0.05, -0.01])) == pytest.approx(-0.01)
    assert support_margin(square[:2], np.array([0.0, 0.03])) == pytest.approx(-0.03)
    assert support_margin(square[:0], np.zeros(2)) == -np.inf


def test_what_a_thing_carries_counts_for_where_it_stands():
    """A plate stands by itself on the edge of a box, and tips once the weight beyond the edge is put on it."""
    base, plate = (
        box(10, (0.1, 0.1, 0.1), (0, 0, 0), mass=1.0),
        box(11, (0.2, 0.1, 0.01), (0.03, 0, 0.1), mass=0.2),
    )
    weight = box(12, (0.06, 0.06, 0.06), (0.075, 0, 0.11), mass=0.35)
    graph = standing_on((10, 1), (11, 10), (12, 11))
    scene = assemble(room(base, plate, weight), graph, AssemblyConfig())
    placed = {p.id: p for p in scene.placed}
    assert scene.physics_report["stable_rate"] == 1.0
    assert all(p.dynamic for p in scene.placed)
    assert max(p.moved_m for p in scene.placed) < 0.02
    assert max(p.turned_deg for p in scene.placed) < 3.0
    # Nothing on it: it stays where it was seen.
    alone = assemble(room(base, plate), standing_on((10, 1), (11, 10)), AssemblyConfig())
    assert {p.id: p for p in alone.placed}[11].moved_m < placed[11].moved_m


def test_who_reads_the_written_pieces_measures_the_same(tmp_path):
    """Files hold seven digits: what assembly measures has them, too, to the last bit."""
    rng = np.random.default_rng(3)
    item = box(10, (0.1 / 3, 0.2 / 3, 0.1), (0.2, 0.1 / 7, 0.0))
    (part,) = item.collision
    rough = replace(
        part, vertices=(part.vertices + 1e-4 * rng.normal(size=part.vertices.shape)).astype(np.float32)
    )
    doubled = replace(rough, vertices=np.concatenate([rough.vertices, rough.vertices[:1]]))
    for number, made in enumerate((rough, doubled)):
        spec = object_spec(item, (made,), item.world_from_object, dynamic=True)
        write_obj(made, tmp_path / f"{number}.obj")
        assert np.array_equal(spec.parts[0], read_obj_points(tmp_path / f"{number}.obj"))
        assert len(read_obj(tmp_path / f"{number}.obj").vertices) == 8
    scene = assemble(room(replace(item, collision=(rough,))), standing_on((10, 1)), AssemblyConfig())
    (placed,) = scene.placed
    write_obj((placed.collision or (rough,))[0], tmp_path / "part.obj")
    spec = replace(
        object_spec(item, (rough,), placed.world_from_object, dynamic=True),
        parts=(read_obj_points(tmp_path / "part.obj"),),
    )
    specs = [*base_specs(room()), spec]
    assert physics_report(specs, scene.graph.edges) == scene.physics_report


def test_the_margin_to_the_bounds_is_half_of_them():
    still = {"id": 1, "floating": False, "moved_m": 0.0, "turned_deg": 0.0}
    entries = [still, still | {"id": 2, "moved_m": 0.011}, still | {"id": 3, "turned_deg": 2.6}]
    entries += [still | {"id": 4, "floating": True}, still | {"id": 5, "moved_m": 0.009, "turned_deg": 2.4}]
    assert restless_objects({"objects": entries}) == {2, 3, 4}
