"""What is in a container is told from it by color, whole; its inside, prints and corners are its own."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from fused_surfaces import box, can, fused, tray
from surfaces import Patchwork, filmed, floor_sheet, looking_at, merged, sheet, solid_box, surface_from

from reconstruction.instances import InstancesConfig
from reconstruction.instances.contents import cut_contents
from reconstruction.instances.cut import Shell
from reconstruction.instances.flush import merge_flush
from reconstruction.instances.foreign import ColorView, main_colors
from reconstruction.instances.scraps import without_skirts
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.sightings import sightings
from reconstruction.instances.skirt_colors import mark_unlike
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import Camera

WOOD, PURPLE, GREEN, CREAM = (150, 105, 60), (95, 45, 130), (60, 140, 50), (220, 200, 150)
CRATE = tray((-0.16, -0.12, 0.0), (0.16, 0.12, 0.1), 0.015, WOOD)
CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)


def seen(surface):
    """Return a surface, filmed from all around, with its graph."""
    turns = np.linspace(0.0, 2 * np.pi, 10, endpoint=False)
    poses = np.stack([looking_at((0.7 * np.cos(t), 0.7 * np.sin(t), 0.7), (0.0, 0.0, 0.05)) for t in turns])
    truth = Patchwork(surface.vertices, surface.faces, surface.normals, surface.colors)
    posed, depth = filmed(truth, surface.colors.astype(float), surface, poses, CAMERA)
    shell = Shell.of(surface, NO_PROGRESS)
    return ColorView.of(shell, sightings(surface, posed, depth)), shell


def contents_of(solids, *, container=True, taken=None):
    """Return the graph, the crate on the floor, what is cut off it, and what was found in it before."""
    view, _ = seen(fused(solids, half_m=0.3, top_m=0.3))
    points = view.graph.points
    whole = Thing(np.flatnonzero(points[:, 2] > 0.012), container=container)
    known = []
    if taken is not None:
        known = [Thing(whole.vertices[taken(points[whole.vertices])], whole, 1)]
        whole.vertices = np.setdiff1d(whole.vertices, known[0].vertices)
    things = cut_contents(view, [whole, *known], InstancesConfig(), NO_PROGRESS)
    assert things[0] is whole
    return view.graph, things[1 + len(known) :], known


def bounds(graph, thing):
    return graph.points[thing.vertices].min(axis=0), graph.points[thing.vertices].max(axis=0)


@pytest.mark.parametrize("container", [True, False], ids=["known for one", "that none knew"])
def test_a_can_that_leans_on_a_side_is_a_thing_in_the_crate(container):
    """The mesh joins them, so that it has neither a foot nor a crease there."""
    graph, found, _ = contents_of([*CRATE, can((-0.1, 0.0), 0.035, 0.015, 0.13, PURPLE)], container=container)
    assert len(found) == 1
    low, high = bounds(graph, found[0])
    np.testing.assert_allclose([*low, *high], [-0.135, -0.035, 0.015, -0.065, 0.035, 0.13], atol=0.02)
    assert found[0].rests_on.vertices.size > len(found[0].vertices)
    assert np.intersect1d(found[0].vertices, found[0].rests_on.vertices).size == 0


def test_what_is_under_a_lid_of_another_color_is_of_one_thing_with_it():
    """The lower half of the can has the color of the crate."""
    half = can((0.05, 0.02), 0.035, 0.015, 0.07, WOOD)
    graph, found, _ = contents_of([*CRATE, half, can((0.05, 0.02), 0.035, 0.07, 0.12, PURPLE)])
    assert len(found) == 1
    low, high = bounds(graph, found[0])
    assert low[2] < 0.04
    assert high[2] > 0.11


def test_a_slice_that_something_else_in_the_crate_had_comes_back():
    """What was found before, a block beside the can, keeps what is its own."""
    block = box((0.03, -0.06, 0.015), (0.11, 0.04, 0.05), GREEN)

    def taken(points):
        of_block = (points[:, 0] > 0.02) & (points[:, 1] > -0.075) & (points[:, 1] < 0.055)
        of_can = np.hypot(points[:, 0] + 0.02, points[:, 1]) < 0.05
        inner = (np.abs(points[:, 0]) < 0.13) & (points[:, 2] > 0.025)
        return inner & ((of_block & ~of_can) | (of_can & (points[:, 2] > 0.05) & (points[:, 2] < 0.07)))

    graph, found, (known,) = contents_of(
        [*CRATE, block, can((-0.02, 0.0), 0.035, 0.015, 0.12, PURPLE)], taken=taken
    )
    assert len(found) == 1
    assert bounds(graph, found[0])[0][2] < 0.04
    heights = graph.points[found[0].vertices, 2]
    assert ((heights > 0.05) & (heights < 0.07)).sum() > 20
    assert graph.points[known.vertices, 0].max() > 0.1
    assert graph.points[known.vertices, 2].max() < 0.07


def test_what_stands_free_in_a_container_may_have_another_color_in_part():
    """The knob is too small for a thing, and nothing of what it is on lies right under it."""
    body = can((0.03, 0.0), 0.035, 0.015, 0.05, WOOD)
    graph, found, _ = contents_of([*CRATE, body, can((0.03, 0.0), 0.022, 0.05, 0.07, PURPLE)])
    assert len(found) == 1
    low, high = bounds(graph, found[0])
    np.testing.assert_allclose([*low[:2], *high], [-0.005, -0.035, 0.065, 0.035, 0.07], atol=0.01)
    assert low[2] < 0.03


@pytest.mark.parametrize(
    "solids",
    [
        [*CRATE, can((-0.1, 0.0), 0.035, 0.015, 0.13, WOOD)],
        [*CRATE, box((-0.145, -0.105, 0.01), (0.145, 0.105, 0.018), PURPLE)],
        [*CRATE, box((-0.162, -0.122, 0.0), (-0.1, -0.06, 0.102), PURPLE)],
        [
            box((-0.16, -0.12, 0.0), (0.16, 0.12, 0.1), WOOD),
            box((-0.08, -0.06, 0.09), (0.08, 0.06, 0.101), PURPLE),
        ],
    ],
    ids=["of its color", "a lining", "its corner", "a print on a closed box"],
)
def test_what_is_of_the_container_stays(solids):
    assert contents_of(solids, container=len(solids) > 2)[1] == []


@pytest.mark.parametrize(("color", "kept"), [(GREEN, True), (WOOD, False), (CREAM, False)])
def test_a_slanted_low_thing_is_no_skirt_if_nothing_around_has_its_color(color, kept):
    """It rises to the side of a box, as smeared depth does; the box is of wood, the ground cream."""
    block = solid_box((-0.1, -0.1, 0.0), (0.1, 0.1, 0.12), WOOD)
    slope = sheet((-0.06, 0.102, 0.06), (0.12, 0, 0), (0, 0.07, -0.055), color)
    view, shell = seen(surface_from(merged(floor_sheet(CREAM, 0.4), block, slope)))
    points = view.graph.points
    near = (np.abs(points[:, :2]) < 0.2).all(axis=1)
    ground = Thing(np.flatnonzero((points[:, 2] < 1e-3) & near))
    of_slope = near & (points[:, 2] > 1e-3) & (points[:, 1] > 0.101)
    things = [ground, Thing(np.flatnonzero(near & (points[:, 2] > 1e-3) & ~of_slope), ground)]
    things.append(Thing(np.flatnonzero(of_slope), ground))
    mark_unlike(view, things, shell.owner)
    assert things[2].foreign == kept
    assert len(without_skirts(view.graph, things, NO_PROGRESS)) == 2 + kept


def ramp(low_x, high_x, color, bottom_m=0.003, rise_m=0.065):
    """Return a steep sheet, as smeared depth makes them, that bulges nowhere and has no top."""
    return sheet((low_x, -0.05, bottom_m), (high_x - low_x, 0, 0), (0, 0.045, rise_m), color)


def skirts_left_out(carried_by=None, **parts):
    """Return names of parts on a cream ground that are taken for skirts, and what each of the others rests on."""
    view, shell = seen(surface_from(merged(floor_sheet(CREAM, 0.4), *parts.values())))
    points = view.graph.points
    ground = Thing(np.flatnonzero((points[:, 2] < 1e-3) & (np.abs(points[:, :2]) < 0.25).all(axis=1)))
    things = {"ground": ground}
    for name, part in parts.items():
        low, high = part.vertices.min(axis=0) - 1e-4, part.vertices.max(axis=0) + 1e-4
        inside = ((points > low) & (points < high)).all(axis=1) & (points[:, 2] > 1e-3)
        things[name] = Thing(np.flatnonzero(inside), ground)
    for upper, lower in (carried_by or {}).items():
        things[upper].rests_on = things[lower]
    mark_unlike(view, list(things.values()), shell.owner)
    kept = {id(thing) for thing in without_skirts(view.graph, list(things.values()), NO_PROGRESS)}
    names = {id(thing): name for name, thing in things.items()}
    rests = {name: names[id(thing.rests_on)] for name, thing in things.items() if thing is not ground}
    return {name for name, thing in things.items() if id(thing) not in kept}, rests


@pytest.mark.parametrize(("color", "gone"), [(CREAM, {"sheet"}), (WOOD, set())])
def test_a_sheet_between_two_things_is_a_skirt_if_it_has_the_color_of_what_carries_it(color, gone):
    """It is farther from each than a skirt may be; that of wood has the color of the two."""
    first, second = (solid_box((x, -0.06, 0.0), (x + 0.06, 0.06, 0.12), WOOD) for x in (-0.16, 0.1))
    assert skirts_left_out(sheet=ramp(-0.1, 0.1, color), first=first, second=second)[0] == gone


@pytest.mark.parametrize(("color", "gone"), [(CREAM, True), (GREEN, False)])
def test_what_seems_to_rest_on_a_sheet_in_the_furnitures_color_rests_on_the_furniture(color, gone):
    thing = solid_box((-0.05, -0.04, 0.05), (0.05, 0.04, 0.14), WOOD)
    out, rests = skirts_left_out({"thing": "sheet"}, sheet=ramp(-0.15, 0.15, color), thing=thing)
    assert out == ({"sheet"} if gone else set())
    assert rests["thing"] == ("ground" if gone else "sheet")


def test_a_sheet_that_seems_to_lie_on_something_small_may_have_the_color_of_what_carries_that():
    book = solid_box((-0.1, -0.1, 0.0), (0.1, 0.1, 0.02), WOOD)
    upper = ramp(-0.08, 0.02, CREAM, bottom_m=0.022)
    assert skirts_left_out({"sheet": "book"}, book=book, sheet=upper)[0] == {"sheet"}


LEVEL = sheet((-0.1, -0.005, 0.068), (0.03, 0, 0), (0, 0.03, 0), CREAM)


@pytest.mark.parametrize(
    "part",
    [
        solid_box((-0.1, -0.08, 0.0), (0.1, 0.08, 0.02), CREAM),
        merged(ramp(-0.1, 0.0, CREAM), LEVEL),
        ramp(-0.1, 0.0, CREAM, rise_m=0.095),
    ],
    ids=["a board", "a good part of it is a level top", "higher than smears"],
)
def test_what_has_the_color_of_the_furniture_is_no_skirt_for_that(part):
    assert skirts_left_out(part=part)[0] == set()


@pytest.mark.parametrize(
    ("rise_m", "color", "parts"),
    [(0.0, GREEN, 1), (0.0, WOOD, 2), (0.03, GREEN, 2)],
    ids=["one top", "two colors", "two heights"],
)
def test_a_cut_through_one_top_is_undone(rise_m, color, parts):
    left = solid_box((-0.1, -0.06, 0.0), (0.0, 0.06, 0.03), GREEN)
    right = solid_box((0.0, -0.06, 0.0), (0.08, 0.06, 0.03 + rise_m), color)
    graph = MeshGraph.from_surface(surface_from(merged(floor_sheet(CREAM, 0.4), left, right)))
    points, ground = graph.points, Thing(np.flatnonzero(graph.points[:, 2] < 1e-3))
    above, first = points[:, 2] > 1e-3, points[:, 0] < -0.005
    things = [
        ground,
        Thing(np.flatnonzero(above & first), ground),
        Thing(np.flatnonzero(above & ~first), ground),
    ]
    found = merge_flush(graph, things, NO_PROGRESS)
    assert len(found) == 1 + parts
    assert sum(len(thing.vertices) for thing in found) == len(points)


def test_of_a_crate_of_all_colors_nothing_is_told_by_color():
    """None of them covers a good part of its rim."""
    surface = fused(CRATE, half_m=0.3, top_m=0.3)
    turn = np.arctan2(surface.vertices[:, 1], surface.vertices[:, 0])
    lab = np.stack([np.full(len(turn), 65.0), 40 * np.cos(turn), 40 * np.sin(turn)], axis=-1).astype(
        np.float32
    )
    rgb = np.clip(255 * cv2.cvtColor(lab[None], cv2.COLOR_LAB2RGB)[0], 0, 255)
    painted = replace(surface, colors=rgb.astype(np.uint8))
    view, _ = seen(painted)
    whole = Thing(np.flatnonzero(view.graph.points[:, 2] > 0.012), container=True)
    assert len(main_colors(view.graph, whole.vertices)) == 0
    assert not view.foreign(whole.vertices, np.zeros((0, 3))).any()
    assert cut_contents(view, [whole], InstancesConfig(), NO_PROGRESS) == [whole]
