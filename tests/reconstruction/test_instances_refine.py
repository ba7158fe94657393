"""A cut voted back by views: skirts return to what they lie on, things keep themselves, no thing is erased."""

from dataclasses import replace

import numpy as np
from surfaces import floor_sheet, frames_of, looking_at, merged, solid_box, surface_from

from reconstruction.instances import InstancesConfig
from reconstruction.instances.cut import Cut, Shell
from reconstruction.instances.refine import _far_scraps, refine_by_views
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import NO_PROGRESS
from reconstruction.rasterize import rasterize_mesh
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import Camera, DepthMaps

SIZE = (160, 120)
RED = np.array([200, 30, 30])


def filmed():
    """A red box on a brown table, eight frames around it with their colors and depth."""
    surface = surface_from(
        merged(
            floor_sheet((200, 200, 190), 1.0, 0.025),
            solid_box((-0.4, -0.3, 0.0), (0.4, 0.3, 0.4), (120, 80, 50)),
            solid_box((-0.1, -0.08, 0.4), (0.1, 0.08, 0.6), tuple(RED.tolist())),
        )
    )
    center = np.array([0.0, 0.0, 0.45])
    poses = np.stack(
        [
            looking_at(center + np.array([1.1 * np.cos(a), 1.1 * np.sin(a), 0.7]), center)
            for a in np.linspace(0, 5.5, 8)
        ]
    )
    camera = Camera(*SIZE, 150.0, 150.0, SIZE[0] / 2, SIZE[1] / 2)
    drawn = [rasterize_mesh(surface.vertices, surface.faces, camera, pose) for pose in poses]
    images = np.zeros((len(poses), SIZE[1], SIZE[0], 3), np.uint8)
    for image, raster in zip(images, drawn):
        hit = raster.face >= 0
        image[hit] = surface.colors[surface.faces[raster.face[hit], 0]]
    depth = np.stack([raster.depth for raster in drawn])
    posed = replace(
        frames_of(surface)[0], camera=camera, images=images, indices=np.arange(len(poses), dtype=np.int32),
        times_s=np.arange(len(poses)) / 10, world_from_camera=poses, sharpness=np.ones(len(poses), np.float32),
    )  # fmt: skip
    return surface, posed, DepthMaps(camera, depth, np.where(depth > 0, 2, 0).astype(np.uint8))


def parts_of(surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices of the box, of the table, and of the table's top around the box (its skirt)."""
    red = np.abs(surface.colors.astype(int) - RED).max(axis=1) == 0
    x, y, z = surface.vertices.T
    table = ~red & (surface.colors[:, 0] == 120)
    skirt = table & (np.abs(z - 0.4) < 1e-3) & (np.abs(x) < 0.13) & (np.abs(y) < 0.11)
    skirt &= (np.abs(x) > 0.1) | (np.abs(y) > 0.08)
    return np.flatnonzero(red), np.flatnonzero(table), np.flatnonzero(skirt)


def refined(surface, posed, depth, things: list[Thing], config: InstancesConfig) -> Cut:
    shell = Shell.of(surface, NO_PROGRESS)
    return refine_by_views(shell, Cut(things, shell.owner.copy()), surface, posed, depth, config, NO_PROGRESS)


def test_a_skirt_goes_back_to_what_it_lies_on():
    surface, posed, depth = filmed()
    box, table, skirt = parts_of(surface)
    assert len(skirt) > 30
    carrier = Thing(np.setdiff1d(table, skirt))
    wrong = Thing(np.union1d(box, skirt), rests_on=carrier)
    cut = refined(surface, posed, depth, [carrier, wrong], InstancesConfig())
    found_table, found_box = cut.things
    assert np.isin(skirt, found_table.vertices).mean() > 0.8
    assert np.isin(box, found_box.vertices).mean() > 0.95
    assert found_box.rests_on is found_table
    assert not np.intersect1d(found_table.vertices, found_box.vertices).size


def test_a_right_cut_stays():
    surface, posed, depth = filmed()
    box, table, _ = parts_of(surface)
    cut = refined(surface, posed, depth, [Thing(table), Thing(box)], InstancesConfig())
    for found, true in zip(cut.things, (table, box)):
        assert np.isin(true, found.vertices).mean() > 0.97
        assert np.isin(found.vertices, true).mean() > 0.97


def test_a_thing_that_would_lose_most_of_itself_keeps_it():
    """A scrap of the table's own color is seen as table: votes do not erase what the cut found."""
    surface, posed, depth = filmed()
    box, table, skirt = parts_of(surface)
    scrap = Thing(skirt)
    cut = refined(
        surface, posed, depth, [Thing(np.setdiff1d(table, skirt)), Thing(box), scrap], InstancesConfig()
    )
    areas = Shell.of(surface, NO_PROGRESS).graph.areas
    assert areas[cut.things[2].vertices].sum() >= 0.5 * areas[skirt].sum()


def test_without_snapping_the_cut_is_left_alone():
    surface, posed, depth = filmed()
    box, table, skirt = parts_of(surface)
    things = [Thing(np.setdiff1d(table, skirt)), Thing(np.union1d(box, skirt))]
    cut = refined(surface, posed, depth, things, InstancesConfig(snap_radius_px=0))
    assert cut.things is things


def test_a_scrap_far_from_the_rest_of_its_thing_is_none_of_it():
    surface, _, _ = filmed()
    box, _, _ = parts_of(surface)
    graph = MeshGraph.from_surface(surface)
    x, y, z = graph.points.T
    near = np.flatnonzero((np.abs(x - 0.2) < 0.02) & (np.abs(y) < 0.02) & (z > 0.39))
    far = np.flatnonzero((x > 0.37) & (y > 0.27) & (z > 0.39))
    assert len(near)
    assert len(far)
    found = _far_scraps(graph, np.sort(np.concatenate([box, near, far])), 0.02)
    np.testing.assert_array_equal(np.sort(found), far)
    legs = np.flatnonzero((np.abs(np.abs(x) - 0.35) < 0.04) & (z > 0.39))  # two halves of one thing
    assert len(_far_scraps(graph, legs, 0.02)) == 0
