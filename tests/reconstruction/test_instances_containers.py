"""Open containers are whole, with or without contents; tables side by side are two."""

import numpy as np
import pytest
from fused_surfaces import box, can, fused, tray
from surfaces import floor_sheet, frames_of, merged, sheet, solid_box, surface_from

from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.hollows import clings_to, hollows_on, looks_like, shell_and_contents
from reconstruction.instances.scraps import without_skirts
from reconstruction.instances.segmentation import Thing, segment
from reconstruction.instances.stacks import cut_stacks
from reconstruction.instances.supports import find_supports
from reconstruction.instances.tops import cut_between_tops
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph

WOOD, GREEN, RED, WHITE = (120, 80, 50), (40, 140, 60), (190, 30, 30), (235, 235, 230)
TABLE = box((-0.4, -0.35, 0.0), (0.4, 0.35, 0.4), WOOD)
LOW_TRAY = tray((-0.16, -0.12, 0.4), (0.16, 0.12, 0.44), 0.012, WOOD)


def hollows_in(solids, top_m=0.6):
    """Return the hollows on the table, and the graph."""
    graph = MeshGraph.from_surface(fused([TABLE, *solids], voxel_m=0.007, half_m=0.45, top_m=top_m))
    body = np.flatnonzero(graph.points[:, 2] > 0.01)
    top = max(find_supports(graph, body, InstancesConfig()), key=lambda one: one.footprint.area_m2)
    return hollows_on(graph, body, top), graph


def test_a_low_tray_in_the_color_of_its_table_is_a_container_with_what_is_in_it():
    (found,), graph = hollows_in([*LOW_TRAY, can((0.12, 0.08), 0.03, 0.41, 0.5, RED)])
    low, high = graph.points[found].min(axis=0), graph.points[found].max(axis=0)
    np.testing.assert_allclose([*low[:2], *high[:2]], [-0.16, -0.12, 0.16, 0.12], atol=0.025)
    assert high[2] > 0.49


@pytest.mark.parametrize(
    "solids",
    [
        [box((-0.1, -0.1, 0.4), (0.1, 0.1, 0.45), RED)],
        [
            box((-0.2, -0.05, 0.4), (-0.1, 0.05, 0.55), RED),
            box((0.1, -0.05, 0.4), (0.2, 0.05, 0.45), GREEN),
            box((-0.05, 0.1, 0.4), (0.05, 0.2, 0.5), WHITE),
        ],
        [box((-0.15, -0.1, 0.4), (0.15, 0.1, 0.43), RED), can((0.0, 0.0), 0.04, 0.43, 0.5, WHITE)],
    ],
    ids=["a closed box", "things around a place", "a can on a book"],
)
def test_what_has_no_closed_rim_is_no_container(solids):
    assert hollows_in(solids)[0] == []


@pytest.mark.parametrize("tower_top_m", [0.65, 0.8])
def test_a_tall_stack_beside_a_tray_is_no_hollow(tower_top_m):
    """Its top may be higher than what is looked at, so that its sides seem to be a rim."""
    deep = tray((-0.16, -0.12, 0.4), (0.16, 0.12, 0.5), 0.012, WOOD)
    tower = box((0.165, 0.0, 0.4), (0.3, 0.2, tower_top_m), RED)
    (found,), graph = hollows_in([*deep, tower], top_m=0.9)
    low, high = graph.points[found].min(axis=0), graph.points[found].max(axis=0)
    np.testing.assert_allclose([*low[:2], *high[:2]], [-0.16, -0.12, 0.16, 0.12], atol=0.03)


def test_a_bin_under_nothing_is_a_container():
    (found,), graph = hollows_in(tray((-0.1, -0.1, 0.4), (0.1, 0.1, 0.66), 0.012, GREEN), top_m=0.9)
    assert np.ptp(graph.points[found, 2]) > 0.2


def test_a_tray_is_one_thing_and_carries_what_is_in_it():
    """Whose bottom is hardly higher than the table."""
    surface = fused([TABLE, *LOW_TRAY, can((-0.05, 0.03), 0.03, 0.41, 0.5, RED)], top_m=0.6)
    posed, depth = frames_of(surface, 320, 240)
    found = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    at = [(-0.35, -0.3, 0.4), (0.1, -0.05, 0.412), (0.16, 0.0, 0.44), (-0.16, 0.0, 0.44), (-0.05, 0.03, 0.5)]
    nearest = [int(np.argmin(np.linalg.norm(surface.vertices - np.array(p), axis=1))) for p in at]
    table, bottom, right, left, thing = (int(found.vertex_instance[i]) for i in nearest)
    rests = {o.id: o.support_hint for o in found.objects}
    assert len(rests) == 3
    assert bottom == right == left
    assert rests[bottom] == table
    assert rests[thing] == bottom


def test_a_handle_is_the_containers_and_a_skirt_of_another_color_is_not():
    parts = {
        "tray": solid_box((-0.15, -0.1, 0.0), (0.15, 0.1, 0.06), GREEN),
        "handle": solid_box((0.15, -0.03, 0.02), (0.18, 0.03, 0.05), GREEN),
        "skirt": sheet((-0.1, 0.102, 0.0), (0.2, 0, 0), (0, 0.03, 0.04), WOOD),
        "far": solid_box((-0.35, -0.05, 0.0), (-0.16, 0.05, 0.05), GREEN),
    }
    graph = MeshGraph.from_surface(surface_from(merged(floor_sheet(WHITE), *parts.values())))
    rows = {name: _vertices_of(graph, part) for name, part in parts.items()}
    assert [name for name in rows if name != "tray" and clings_to(graph, rows[name], rows["tray"])] == [
        "handle",
        "skirt",
    ]
    assert looks_like(graph, rows["handle"], rows["tray"])
    assert not looks_like(graph, rows["skirt"], rows["tray"])


def _vertices_of(graph, part):
    low, high = part.vertices.min(axis=0) - 1e-4, part.vertices.max(axis=0) + 1e-4
    inside = ((graph.points > low) & (graph.points < high)).all(axis=1)
    return np.flatnonzero(inside & (graph.points[:, 2] > 1e-3))


@pytest.mark.parametrize(("gap_m", "parts"), [(0.1, 2), (0.0, 1)])
def test_tables_with_a_gap_between_them_are_two(gap_m, parts):
    """Joined by smeared surface that slopes down from one top across a part of the gap."""
    left = solid_box((-0.9, -0.3, 0.0), (-0.5 * gap_m, 0.3, 0.45), WOOD)
    right = solid_box((0.5 * gap_m, -0.3, 0.0), (0.9, 0.3, 0.46 if gap_m else 0.45), RED)
    smear = sheet((-0.05, -0.1, 0.45), (0.1, 0, -0.04), (0, 0.06, 0), WOOD)
    graph = MeshGraph.from_surface(surface_from(merged(left, right, *([smear] if gap_m else []))))
    found = cut_between_tops(graph, np.arange(len(graph.points)))
    assert len(found) == parts
    assert sum(len(part) for part in found) == len(graph.points)
    if parts == 2:
        assert {tuple(np.sign(np.median(graph.points[part, 0], keepdims=True))) for part in found} == {
            (-1.0,),
            (1.0,),
        }


def test_a_ragged_sheet_beside_a_box_is_a_skirt_and_a_small_box_there_is_none():
    """A sheet that slopes from the top of the box down to the ground behind it, as smeared depth does."""
    parts = {
        "box": solid_box((-0.1, -0.1, 0.0), (0.1, 0.1, 0.12), RED),
        "sheet": sheet((-0.08, 0.102, 0.06), (0.16, 0, 0), (0, 0.05, -0.05), WOOD),
        "small": solid_box((0.105, -0.04, 0.0), (0.16, 0.04, 0.04), WHITE),
    }
    graph = MeshGraph.from_surface(surface_from(merged(floor_sheet(WOOD), *parts.values())))
    ground = Thing(np.flatnonzero(graph.points[:, 2] < 1e-3))
    things = {name: Thing(_vertices_of(graph, part), ground) for name, part in parts.items()}
    kept = without_skirts(graph, [ground, *things.values()], NO_PROGRESS)
    assert [id(one) for one in kept] == [id(ground), id(things["box"]), id(things["small"])]
    on_it = Thing(things["small"].vertices, things["sheet"])
    kept = without_skirts(graph, [ground, things["box"], things["sheet"], on_it], NO_PROGRESS)
    assert [id(one) for one in kept] == [id(ground), id(things["box"]), id(on_it)]
    assert on_it.rests_on is ground
    box_on_it = Thing(
        things["box"].vertices, things["sheet"]
    )  # it begins as low: the sheet is around its foot
    assert len(without_skirts(graph, [ground, things["sheet"], box_on_it], NO_PROGRESS)) == 2
    high = things["box"].vertices[graph.points[things["box"].vertices, 2] > 0.03]
    covering = Thing(high, things["sheet"])  # what it lies on may be a plate, whose top it hides
    assert len(without_skirts(graph, [ground, things["sheet"], covering], NO_PROGRESS)) == 3


@pytest.mark.parametrize(("boxes", "kept"), [(("left", "right"), False), (("left",), True)])
def test_a_sheet_across_the_gap_between_two_boxes_is_a_skirt(boxes, kept):
    """It is near to both, though most of it is far from either one; it has not the color of the ground."""
    parts = {
        "left": solid_box((-0.2, -0.1, 0.0), (-0.06, 0.1, 0.12), RED),
        "right": solid_box((0.06, -0.1, 0.0), (0.2, 0.1, 0.12), RED),
        "sheet": sheet((-0.059, -0.02, 0.003), (0.118, 0, 0), (0, 0.04, 0.055), RED),
    }
    graph = MeshGraph.from_surface(surface_from(merged(floor_sheet(WOOD), *parts.values())))
    ground = Thing(np.flatnonzero(graph.points[:, 2] < 1e-3))
    things = [ground, *(Thing(_vertices_of(graph, parts[name]), ground) for name in (*boxes, "sheet"))]
    assert len(without_skirts(graph, things, NO_PROGRESS)) == len(things) - (not kept)


def test_a_container_is_not_cut_into_stacks():
    """Its rim may be narrower than its lower part, and of another color."""
    lower = tray((-0.13, -0.11, 0.4), (0.13, 0.11, 0.44), 0.022, WOOD)
    upper = tray((-0.12, -0.1, 0.44), (0.12, 0.1, 0.5), 0.012, GREEN)[1:]
    surface = fused([TABLE, *lower, *upper], voxel_m=0.007, half_m=0.45, top_m=0.6)
    graph = MeshGraph.from_surface(surface)
    body = np.flatnonzero(graph.points[:, 2] > 0.01)
    things = segment(graph, body, InstancesConfig())
    assert [thing.container for thing in things] == [False, True]
    before = len(things[1].vertices)
    posed, depth = frames_of(surface, 320, 240)
    after = cut_stacks(graph, surface, things, posed, depth, InstancesConfig(), NO_PROGRESS)
    assert len(after) == 2
    assert len(after[1].vertices) == before


@pytest.mark.parametrize(
    ("foot", "under"), [(WHITE, [0]), (RED, [])], ids=["a white plate", "a foot of the bowl's own color"]
)
def test_a_plate_below_a_bowl_is_told_from_a_foot_by_its_color(foot, under):
    """The skirt that depth drapes around the bowl makes it nearly as wide as the plate that it stands on."""
    bowl = tray((-0.10, -0.10, 0.02), (0.10, 0.10, 0.09), 0.012, RED)
    graph = MeshGraph.from_surface(
        fused(
            [box((-0.112, -0.112, 0.0), (0.112, 0.112, 0.02), foot), *bowl],
            voxel_m=0.006,
            half_m=0.2,
            top_m=0.2,
        )
    )
    body = np.flatnonzero(graph.points[:, 2] > 0.003)
    parts = [body[graph.points[body, 2] < 0.023], body[graph.points[body, 2] >= 0.023]]
    assert shell_and_contents(graph, body, parts)[0] == under
