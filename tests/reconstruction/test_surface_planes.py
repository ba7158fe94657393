"""The planes of a surface: in a generated room with true depth, and on sheets with known answers."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from surfaces import floor_sheet, merged, sheet, solid_box, surface_from

from reconstruction.core import artifacts
from reconstruction.core.types import SpaceGrid, Surface, SurfacePlane
from reconstruction.measure.scene import joined
from reconstruction.measure.surfaces import sample_seen
from reconstruction.surface import SurfaceConfig, fuse_surface
from reconstruction.surface.base_planes import plane_axes
from reconstruction.surface.planes import find_planes
from synthetic.capture import SyntheticCapture, make_test_capture

pytestmark = pytest.mark.stage

GRAY, BROWN, BLUE = (200, 200, 190), (120, 80, 50), (30, 60, 200)
CONFIG = SurfaceConfig(voxel_size_m=0.012)


def area(points: np.ndarray, plane: np.ndarray) -> float:
    """Return the area of a polygon (k, 3) on a plane."""
    return float(cv2.contourArea((points @ np.stack(plane_axes(plane), axis=1)).astype(np.float32)))


def hull_area(points: np.ndarray, plane: np.ndarray) -> float:
    uv = (points @ np.stack(plane_axes(plane), axis=1)).astype(np.float32)
    return float(cv2.contourArea(cv2.convexHull(uv)))


@pytest.fixture(scope="module")
def capture() -> SyntheticCapture:
    return make_test_capture(16, 240, 180, seed=3, objects=["table", "carton"], step_m=0.2, density=0.1)


@pytest.fixture(scope="module")
def surface(capture) -> Surface:
    return fuse_surface(capture.posed, capture.depth, CONFIG)


def nearest(
    surface: Surface, label: str, plane: np.ndarray, points: np.ndarray
) -> tuple[SurfacePlane, float]:
    """Return the plane of a kind and direction that lies nearest to points, and its distance."""
    found = [p for p in surface.planes if p.label == label and p.surface.plane[:3] @ plane[:3] > 0.9]
    gaps = [abs(float(np.median(points @ p.surface.plane[:3] + p.surface.plane[3]))) for p in found]
    assert found, f"no {label} faces along {plane[:3]}"
    return found[int(np.argmin(gaps))], min(gaps)


def test_floor_walls_and_table_top_of_a_room(capture, surface):
    meshes = [entity.mesh() for entity in capture.entities]
    poses = list(capture.posed.world_from_camera)
    seen = sample_seen(*joined(meshes), capture.posed.camera, poses, 400_000)
    top = capture.room.entity("table").mesh().bounds[1, 2]
    wanted = [("floor", np.array([0, 0, 1.0, 0])), ("support", np.array([0, 0, 1.0, -top]))]
    for axis in (0, 1):
        for side in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = side
            facing = seen.normals @ normal > 0.999
            far = float((seen.points[facing] @ normal).min()) if facing.any() else 0.0
            on_it = facing & (np.abs(seen.points @ normal - far) < 1e-3)
            if on_it.sum() > 0.1 * len(on_it):  # furniture has no side as large as a wall
                wanted.append(("wall", np.append(normal, -far)))
    assert sum(label == "wall" for label, _ in wanted) >= 1
    assert [p.label for p in surface.planes].count("wall") == sum(label == "wall" for label, _ in wanted)
    for label, true in wanted:
        points = seen.points[
            (np.abs(seen.points @ true[:3] + true[3]) < 1e-3) & (seen.normals @ true[:3] > 0.99)
        ]
        found, gap = nearest(surface, label, true, points)
        angle = np.degrees(np.arccos(min(1.0, found.surface.plane[:3] @ true[:3])))
        assert angle < 1.0, (label, angle)
        assert gap < 0.01, (label, gap)
        assert area(found.surface.polygon, found.surface.plane) == pytest.approx(
            hull_area(points, true), rel=0.25
        ), label
        assert found.area_m2 < 1.1 * area(found.surface.polygon, found.surface.plane)
        on_it = surface.vertices[found.vertices] @ found.surface.plane[:3] + found.surface.plane[3]
        assert np.abs(np.median(on_it)) < 0.005


def test_no_floor_in_view_gives_no_floor(capture):
    floor = next(e.id for e in capture.entities if e.label == "floor")
    hidden = np.where(capture.id_maps == floor, 0, capture.depth.depth).astype(np.float32)
    found = fuse_surface(capture.posed, replace(capture.depth, depth=hidden), CONFIG).planes
    assert "floor" not in {plane.label for plane in found}
    assert {"wall", "support"} <= {plane.label for plane in found}


CENTERS = np.array([[x, -1.0, 1.4] for x in (-0.8, -0.3, 0.3, 0.8)])


def walls_of(*parts) -> list[float]:
    """Return how far the walls are from the origin that are found on sheets above a floor."""
    surface = surface_from(merged(floor_sheet(GRAY), *parts))
    planes = find_planes(surface, SurfaceConfig(), CENTERS)
    return sorted(float(p.surface.plane[3]) for p in planes if p.label == "wall")


def test_a_wall_stays_one_though_another_room_is_seen_through_its_door_and_that_room_has_none():
    left = sheet((-1.2, 1.2, 0), (0.8, 0, 0), (0, 0, 2.0), GRAY)
    right = sheet((0.4, 1.2, 0), (0.8, 0, 0), (0, 0, 2.0), GRAY)
    behind = sheet((-0.4, 2.0, 0), (0.8, 0, 0), (0, 0, 1.6), BLUE)
    assert walls_of(left, right, behind) == pytest.approx([1.2], abs=0.01)


def test_a_front_over_which_the_wall_is_seen_is_furniture():
    front = sheet((-0.8, 0.6, 0), (1.6, 0, 0), (0, 0, 1.0), BROWN)
    behind = sheet((-0.6, 1.2, 1.0), (1.2, 0, 0), (0, 0, 0.5), GRAY)
    assert walls_of(front, behind) == pytest.approx([1.2], abs=0.01)


def test_no_vertex_is_on_two_planes(surface):
    vertices = np.concatenate([plane.vertices for plane in surface.planes])
    assert len(np.unique(vertices)) == len(vertices)


def test_planes_survive_being_saved(surface, tmp_path):
    artifacts.save(surface, tmp_path / "surface")
    again = artifacts.load(Surface, tmp_path / "surface")
    for left, right in zip(surface.planes, again.planes, strict=True):
        assert (left.label, left.area_m2, left.band_m) == (right.label, right.area_m2, right.band_m)
        assert np.array_equal(left.surface.plane, right.surface.plane)
        assert np.array_equal(left.surface.polygon, right.surface.polygon)
        assert np.array_equal(left.vertices, right.vertices)


def with_space(surface: Surface, free) -> Surface:
    """Return a surface in a grid of 2 cm whose voxels are free where `free(centers)` says so."""
    origin, shape = np.array([-1.5, -1.5, -0.1]), (150, 150, 80)
    centers = origin + (np.stack(np.indices(shape), -1) + 0.5) * 0.02
    space = SpaceGrid(origin, 0.02, np.where(free(centers), 1, 0).astype(np.uint8))
    return replace(surface, space=space)


def supports(surface: Surface) -> list[SurfacePlane]:
    return [p for p in find_planes(surface, SurfaceConfig()) if p.label == "support"]


def test_supports_at_several_heights_with_their_extents():
    shelf = [sheet((0.6, -0.3, z), (0.3, 0, 0), (0, 0.6, 0), BROWN) for z in (0.3, 0.6, 0.9)]
    table = solid_box((-0.5, -0.4, 0.0), (0.3, 0.4, 0.5), BROWN)
    box = solid_box((-0.4, -0.3, 0.5), (-0.1, 0.0, 0.62), BLUE)
    cup = solid_box((0.1, 0.1, 0.5), (0.18, 0.18, 0.6), BLUE)
    found = supports(
        with_space(surface_from(merged(floor_sheet(GRAY), table, box, cup, *shelf)), lambda c: c[..., 2] > 0)
    )
    heights = [float(-p.surface.plane[3] / p.surface.plane[2]) for p in found]
    np.testing.assert_allclose(heights, [0.3, 0.5, 0.6, 0.62, 0.9], atol=0.003)
    extents = [area(p.surface.polygon, p.surface.plane) for p in found]
    np.testing.assert_allclose(extents, [0.18, 0.64, 0.18, 0.09, 0.18], rtol=0.1)


def test_an_outline_follows_a_corner():
    corner = merged(
        sheet((-0.6, -0.6, 0.7), (1.2, 0, 0), (0, 0.4, 0), BROWN),
        sheet((-0.6, -0.2, 0.7), (0.4, 0, 0), (0, 0.8, 0), BROWN),
    )
    (found,) = supports(with_space(surface_from(merged(floor_sheet(GRAY), corner)), lambda c: c[..., 2] > 0))
    assert area(found.surface.polygon, found.surface.plane) == pytest.approx(0.8, rel=0.1)
    assert found.area_m2 == pytest.approx(0.8, rel=0.05)


@pytest.mark.parametrize(
    ("gap_m", "color", "seen_between", "count"),
    [
        (0.2, BROWN, True, 2),  # two seats side by side
        (0.2, BROWN, False, 1),  # a top whose middle something hides
        (0.2, BLUE, False, 2),  # a book and a plate
        (0.0, BLUE, True, 1),  # a top of two colors
    ],
)
def test_tops_are_one_if_they_touch_or_something_hides_what_joins_them(gap_m, color, seen_between, count):
    left = sheet((-0.5, -0.2, 0.45), (0.4, 0, 0), (0, 0.4, 0), BROWN)
    right = sheet((-0.1 + gap_m, -0.2, 0.45), (0.4, 0, 0), (0, 0.4, 0), color)
    surface = surface_from(merged(floor_sheet(GRAY), left, right))
    low = 0.0 if seen_between else 0.45
    found = supports(with_space(surface, lambda c: c[..., 2] > low))
    assert len(found) == count
    assert sum(p.area_m2 for p in found) == pytest.approx(0.32, rel=0.05)


def test_what_nothing_was_seen_above_is_no_support():
    surface = surface_from(merged(floor_sheet(GRAY), solid_box((-0.5, -0.4, 0.0), (0.3, 0.4, 0.5), BROWN)))
    assert len(supports(with_space(surface, lambda c: c[..., 2] > 0.5))) == 1
    assert supports(with_space(surface, lambda c: c[..., 2] < 0.5)) == []


def test_slopes_are_no_supports():
    ramp = sheet((-0.4, -0.4, 0.5), (0.8, 0, 0.14), (0, 0.8, 0), BROWN)
    surface = surface_from(merged(floor_sheet(GRAY), ramp))
    assert supports(with_space(surface, lambda c: c[..., 2] > 0)) == []
