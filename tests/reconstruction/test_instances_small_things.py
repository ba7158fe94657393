"""Small things on, in and beside others, on surfaces that are smooth and blurred where things touch."""

import numpy as np
import pytest
from fused_surfaces import box, can, fused, tray
from surfaces import Patchwork, frames_of, sheet, surface_from

from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.convexity import bulge, is_inside
from reconstruction.instances.insides import merge_insides
from reconstruction.instances.segmentation import Thing, _absorb_fragments
from reconstruction.instances.splitting import split_touching
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph

WOOD, DARK, WHITE, RED, BLUE, GREEN = (
    (205, 170, 115), (30, 40, 35), (235, 235, 230), (190, 30, 30), (40, 60, 190), (40, 140, 60)
)  # fmt: skip
TABLE = box((-0.4, -0.35, 0.0), (0.4, 0.35, 0.4), (120, 80, 50))


def ids_at(surface, *points):
    """Return the ids of the things at points, and what each rests on."""
    posed, depth = frames_of(surface, 320, 240)
    found = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    nearest = [int(np.argmin(np.linalg.norm(surface.vertices - np.array(p), axis=1))) for p in points]
    ids = [int(found.vertex_instance[i]) for i in nearest]
    return ids, {o.id: o.support_hint for o in found.objects}


def parts_of(solids, voxel_m=0.008):
    """Return the split of what stands above the floor, and the graph."""
    surface = fused(solids, voxel_m, half_m=0.25, top_m=0.45)
    graph = MeshGraph.from_surface(surface)
    return split_touching(graph, np.flatnonzero(graph.points[:, 2] > 0.01), InstancesConfig()), graph


def part_at(parts, graph, point):
    nearest = int(np.argmin(np.linalg.norm(graph.points - np.array(point), axis=1)))
    return next(i for i, part in enumerate(parts) if nearest in part)


def test_a_book_on_a_book_of_the_same_color_is_a_thing():
    """The upper one is turned and smaller: the lower one begins all around its foot."""
    lower_book = box((-0.15, -0.11, 0.4), (0.15, 0.11, 0.44), DARK)
    upper_book = box((-0.1, -0.08, 0.44), (0.1, 0.08, 0.48), DARK, yaw_rad=0.4)
    surface = fused([TABLE, lower_book, upper_book], top_m=0.6)
    (table, lower, upper), rests = ids_at(surface, (-0.35, -0.3, 0.4), (0.14, 0.1, 0.44), (0, 0, 0.48))
    assert len({table, lower, upper}) == 3
    assert rests[upper] == lower
    assert rests[lower] == table


def test_things_in_a_tray_rest_on_it():
    """Two cans, away from the sides and not, and the tray stays one."""
    cans = [can((-0.1, 0.0), 0.035, 0.4, 0.52, RED), can((0.13, 0.08), 0.035, 0.4, 0.5, BLUE)]
    surface = fused([TABLE, *tray((-0.2, -0.15, 0.4), (0.2, 0.15, 0.47), 0.012, WOOD), *cans], top_m=0.65)
    points = (0.0, -0.1, 0.412), (-0.1, 0.0, 0.52), (0.13, 0.08, 0.5), (-0.2, 0.0, 0.44), (0.2, -0.1, 0.44)
    (bottom, first, second, left, right), rests = ids_at(surface, *points)
    assert len({bottom, first, second}) == 3
    assert bottom == left == right
    assert rests[first] == rests[second] == bottom


@pytest.mark.parametrize("voxel_m", [0.005, 0.008])
def test_touching_boxes_of_other_colors_are_cut_where_they_touch(voxel_m):
    """Whatever the spacing of the mesh; and on the right side of the contact."""
    parts, graph = parts_of(
        [box((-0.1, -0.05, 0), (0.0, 0.05, 0.2), RED), box((0.0, -0.04, 0), (0.09, 0.06, 0.14), WHITE)],
        voxel_m,
    )
    assert len(parts) == 2
    high = parts[part_at(parts, graph, (-0.05, 0, 0.2))]
    assert np.percentile(graph.points[high, 0], 98) < 0.012
    other = parts[1 - part_at(parts, graph, (-0.05, 0, 0.2))]
    assert np.percentile(graph.points[other, 0], 2) > -0.012


@pytest.mark.parametrize(
    "solids",
    [
        [box((-0.05, -0.05, 0), (0.05, 0.05, 0.1), RED), box((-0.05, -0.05, 0.1), (0.05, 0.05, 0.2), BLUE)],
        [can((0, 0), 0.05, 0.0, 0.16, BLUE), box((0.04, -0.012, 0.05), (0.09, 0.012, 0.13), WHITE)],
        [*tray((-0.15, -0.1, 0.0), (0.15, 0.1, 0.08), 0.014, WOOD)],
        [box((-0.1, -0.05, 0), (0.0, 0.05, 0.2), WHITE), box((0.0, -0.05, 0), (0.09, 0.05, 0.14), WHITE)],
    ],
    ids=["a label", "a handle of another color", "the inside of a tray", "a step of one color"],
)
def test_one_thing_stays_whole(solids):
    parts, _ = parts_of(solids)
    assert len(parts) == 1


def test_a_thing_amid_a_hole_of_its_table_rests_on_it():
    """A glossy top that was not seen around the thing: the thing is in mid-air, at the height of the top."""
    surface = fused([TABLE, box((-0.05, -0.04, 0.4), (0.05, 0.04, 0.55), GREEN)], top_m=0.65)
    around = np.abs(surface.vertices[:, :2]).max(axis=1)
    unseen = (np.abs(surface.vertices[:, 2] - 0.4) < 0.02) & (around < 0.16)
    kept = ~unseen[surface.faces].any(axis=1)
    holed = surface.__class__(**{**vars(surface), "faces": surface.faces[kept]})
    (table, thing), rests = ids_at(holed, (-0.35, -0.3, 0.4), (0, 0, 0.55))
    assert thing not in (0, table)
    assert rests[thing] == table


def test_the_back_of_a_seat_stays_with_it():
    """It stands on the seat in front, but its back goes on below it."""
    surface = fused(
        [box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.25), WOOD), box((-0.2, 0.15, 0.2), (0.2, 0.2, 0.5), WOOD)],
        top_m=0.65,
    )
    (seat, back), _ = ids_at(surface, (0, -0.1, 0.25), (0, 0.15, 0.4))
    assert seat == back


def hollow(depth_m: float):
    """Return a graph of a sheet, 20 x 20 cm, bent upwards at its rim (depth > 0) or downwards."""
    steps = np.linspace(-0.1, 0.1, 21)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    z = depth_m * (x**2 + y**2) / 0.02
    flat = sheet((-0.1, -0.1, 0), (0.2, 0, 0), (0, 0.2, 0), WOOD)
    slope = np.stack([-2 * depth_m * x / 0.02, -2 * depth_m * y / 0.02, np.ones_like(x)], axis=-1).reshape(
        -1, 3
    )
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    normals = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    return MeshGraph.from_surface(surface_from(Patchwork(points, flat.faces, normals, flat.colors)))


@pytest.mark.parametrize(
    ("depth_m", "low", "high"), [(0.08, -1.0, -0.2), (0.0, -0.02, 0.02), (-0.08, 0.2, 1.0)]
)
def test_bulge_tells_a_hollow_from_a_sheet_from_a_thing(depth_m, low, high):
    graph = hollow(depth_m)
    assert low < bulge(graph, np.arange(len(graph.points))) < high


@pytest.mark.parametrize("seen_from_m", [0.01, 0.025])
def test_the_bottom_of_a_tray_is_joined_with_its_sides_and_what_lies_in_it_is_not(seen_from_m):
    """Both lie within the outline of the sides, also of sides of which no foot was seen; only the thing bulges."""
    can_in_tray = [
        can((0.0, 0.0), 0.035, 0.0, 0.1, RED),
        *tray((-0.2, -0.15, 0.0), (0.2, 0.15, 0.07), 0.014, WOOD),
    ]
    graph = MeshGraph.from_surface(fused(can_in_tray, half_m=0.25, top_m=0.15))
    points = graph.points
    in_can = np.linalg.norm(points[:, :2], axis=1) < 0.042
    in_bottom = (np.abs(points[:, 0]) < 0.18) & (np.abs(points[:, 1]) < 0.13) & ~in_can
    in_sides = ~in_bottom & ~in_can & (points[:, 2] > seen_from_m)
    sides, bottom = (Thing(np.flatnonzero(chosen)) for chosen in (in_sides, in_bottom))
    inner = Thing(np.flatnonzero(in_can), rests_on=bottom)
    left = merge_insides(graph, [sides, bottom, inner], NO_PROGRESS)
    assert len(left) == 2
    assert any(thing is inner for thing in left)
    assert inner.rests_on is sides
    assert np.isin(bottom.vertices, sides.vertices).all()


def test_what_rested_on_a_scrap_that_it_takes_in_rests_on_what_carried_the_scrap():
    """The scrap is a sheet around the thing's foot, nearer to the thing than to anything else."""
    solids = [TABLE, box((-0.05, -0.04, 0.4), (0.05, 0.04, 0.55), GREEN)]
    graph = MeshGraph.from_surface(fused(solids, top_m=0.65))
    points = graph.points
    around = np.abs(points[:, :2]).max(axis=1)
    near_top = np.abs(points[:, 2] - 0.4) < 0.02
    table = Thing(np.flatnonzero((points[:, 2] > 0.05) & (points[:, 2] < 0.42) & (around > 0.12)))
    scrap = Thing(np.flatnonzero(near_top & (around < 0.1) & (around > 0.06)), rests_on=table)
    thing = Thing(np.flatnonzero((points[:, 2] > 0.41) & (around < 0.06)), rests_on=scrap)
    kept = _absorb_fragments(graph, [table, scrap, thing], InstancesConfig())
    assert [id(one) for one in kept] == [id(table), id(thing)]
    assert thing.rests_on is table


def test_what_is_in_a_container_goes_on_behind_the_rim():
    """A can in a basket, seen from 6 cm above the bottom on; the basket's inner sides are seen lower than that."""
    basket = tray((-0.15, -0.1, 0.0), (0.15, 0.1, 0.1), 0.018, WOOD)
    surface = fused([*basket, can((0.03, 0.0), 0.035, 0.018, 0.16, RED)], half_m=0.25, top_m=0.3)
    graph = MeshGraph.from_surface(surface)
    above = graph.points[:, 2] > 0.002
    on_can = np.hypot(graph.points[:, 0] - 0.03, graph.points[:, 1]) < 0.045
    hidden = (graph.points[:, 2] < 0.06) & (np.hypot(graph.points[:, 0] - 0.03, graph.points[:, 1]) < 0.06)
    inner = np.flatnonzero(on_can & ~hidden & above)
    container = np.flatnonzero(~on_can & ~hidden & above)
    assert is_inside(graph, container, inner, 0.06)
    # On its bottom, which is seen all around, it is not hidden; nor on a table without a rim.
    whole = np.flatnonzero(on_can & (graph.points[:, 2] > 0.024))
    assert not is_inside(graph, np.flatnonzero(~on_can & above), whole, 0.024)
    table = fused([TABLE, can((0.0, 0.0), 0.035, 0.4, 0.5, RED)], half_m=0.45, top_m=0.6)
    graph = MeshGraph.from_surface(table)
    low = graph.points[:, 2] < 0.404
    assert not is_inside(graph, np.flatnonzero(low), np.flatnonzero(~low), 0.404)
