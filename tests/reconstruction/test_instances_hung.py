"""Flat things on walls without any depth: keyframes laid onto the wall show them, and nothing else."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from surfaces import frames_of, looking_at, sheet, surface_from

from reconstruction.instances import InstancesConfig
from reconstruction.instances.hung import add_hung
from reconstruction.instances.outlined_box import Wall, WallBox, silhouette
from reconstruction.types import BaseEntity, Camera, DepthMaps, Instance, InstanceSet, Plane, Surface

CAMERA = Camera(240, 180, 195.0, 195.0, 120.0, 90.0)
BASE = BaseEntity(2, "wall", Plane(np.array([0.0, -1.0, 0.0, 1.0]), np.zeros((3, 3))), True)  # y = 1
WALL = Wall.of(BASE)
SIDE = float(WALL.along[0])  # which way along the wall x goes
EYES = np.array([[x, -1.2, z] for x, z in ((-0.8, 1.5), (-0.4, 1.2), (0.0, 1.4), (0.4, 1.1), (0.8, 1.6))])
BLUE, CREAM = np.array([60.0, 80, 170]), np.array([208.0, 202, 188])


def plaster(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the colors (n, 3) of a wall with blotches, brighter to one side."""
    blotches = 5 * np.sin(7.1 * x + 3 * np.sin(4 * z)) * np.sin(5.3 * z + 1.0) + 6 * x
    return CREAM + blotches[:, None]


def rectangle(
    x: np.ndarray, z: np.ndarray, low: tuple[float, float], high: tuple[float, float]
) -> np.ndarray:
    return (x > low[0]) & (x < high[0]) & (z > low[1]) & (z < high[1])


class Silent:
    notes: list[str]

    def __init__(self):
        self.notes = []
        self.start = self.advance = lambda *_: None
        self.note = self.notes.append


@cache
def _surface() -> Surface:
    return surface_from(sheet((-1.5, 1.0, 0), (3.0, 0, 0), (0, 0, 2.2), (200, 200, 190), 0.05))


def find(paint, *, at_y: float = 1.0, box: WallBox | None = None, objects: tuple[Instance, ...] = ()):
    """Film a painted wall, or before a plain one, at `at_y`, what `paint` does not leave free; there is no depth."""
    poses = np.stack([looking_at(eye, np.array([0.0, 1.0, 1.2])) for eye in EYES])
    rows, columns = (v.ravel() for v in np.mgrid[: CAMERA.height, : CAMERA.width])
    rays = np.column_stack([(columns + 0.5 - 120) / 195, (rows + 0.5 - 90) / 195, np.ones(rows.size)])
    images = []
    for pose in poses:
        world = rays @ pose[:3, :3].T
        behind = pose[:3, 3] + world * ((1.0 - pose[1, 3]) / world[:, 1])[:, None]
        points = pose[:3, 3] + world * ((at_y - pose[1, 3]) / world[:, 1])[:, None]
        image = paint(points[:, 0], points[:, 2])
        bare = np.isnan(image[:, 0])
        image[bare] = plaster(behind[bare, 0], behind[bare, 2])
        image = image.reshape(CAMERA.height, CAMERA.width, 3)
        if box is not None:
            image[silhouette(box, WALL, CAMERA, pose)] = BLUE
        images.append(cv2.GaussianBlur(image, (0, 0), 0.6).clip(0, 255).astype(np.uint8))
    surface = _surface()
    posed = replace(
        frames_of(surface)[0], camera=CAMERA, images=np.stack(images), indices=np.arange(5, dtype=np.int32),
        times_s=np.arange(5) / 10, world_from_camera=poses, sharpness=np.ones(5, np.float32),
    )  # fmt: skip
    nothing = np.zeros((5, CAMERA.height, CAMERA.width))
    depth = DepthMaps(CAMERA, nothing.astype(np.float32), nothing.astype(np.uint8))
    floor = BaseEntity(1, "floor", Plane(np.array([0.0, 0, 1, 0]), np.zeros((3, 3))), True)
    owner = np.full(len(surface.vertices), 2, np.int32)
    for k, item in enumerate(objects):
        owner[k] = item.id
    ids = np.full(nothing.shape, 2, np.uint16)
    heard = Silent()
    given = InstanceSet(owner, (floor, BASE), objects, ids)
    return add_hung(given, posed, depth, surface, InstancesConfig(), progress=heard), heard.notes


def with_rectangles(*corners, color=BLUE):
    def paint(x, z):
        out = plaster(x, z)
        for low, high in corners:
            out[rectangle(x, z, low, high)] = color
        return out

    return paint


def test_a_picture_without_depth_is_found_where_frames_agree_on_it():
    found, notes = find(with_rectangles(((-0.3, 1.0), (0.2, 1.4))))
    (picture,) = found.objects
    assert (picture.label, picture.support_hint, picture.attached_hint) == ("picture", 2, True)
    assert picture.center == pytest.approx([-0.05, 0.9875, 1.2], abs=0.02)
    assert picture.extents_m == pytest.approx([0.025, 0.5, 0.4], abs=0.02)
    assert (found.id_maps == picture.id).mean() == pytest.approx(0.036, abs=0.004)
    assert len(notes) == 1


def test_a_round_thing_is_found_beside_a_leaf_that_touches_it():
    def paint(x, z):
        out = plaster(x, z)
        out[np.hypot(x - 0.2, z - 1.3) < 0.15] = BLUE
        out[rectangle(x, z, (0.19, 1.44), (0.21, 1.52))] = [90, 130, 80]
        return out

    (clock,) = find(paint)[0].objects
    assert clock.extents_m[1:] == pytest.approx([0.3, 0.3], abs=0.025)


def test_a_board_that_stands_out_from_the_wall_is_as_deep_as_it_looks():
    middle = 0.1 * SIDE
    shelf = WallBox(np.array([middle - 0.35, 1.0]), np.array([middle + 0.35, 1.12]), 0.22)
    (found,) = find(plaster, box=shelf)[0].objects
    assert found.extents_m == pytest.approx([0.22, 0.7, 0.12], abs=0.06)


def test_shadows_blotches_and_paint_are_no_things():
    def shadow(x, z):
        return plaster(x, z) * (1 - 0.4 / (1 + np.exp((np.hypot(x, z - 1.2) - 0.3) / 0.04)))[:, None]

    assert not find(plaster)[0].objects
    assert not find(shadow)[0].objects


def test_a_wallpaper_with_motifs_holds_no_things():
    motifs = [((x, z), (x + 0.16, z + 0.16)) for x in np.arange(-0.9, 0.9, 0.45) for z in (0.8, 1.15, 1.5)]
    assert not find(with_rectangles(*motifs))[0].objects
    assert find(with_rectangles(motifs[4]))[0].objects


def test_a_wall_of_many_colors_is_not_searched():
    colors = np.random.default_rng(5).uniform(60, 220, (40, 3))

    def tiles(x, z):
        return colors[(np.floor(x / 0.3) * 7 + np.floor(z / 0.2) * 3).astype(int) % 40]

    assert not find(tiles)[0].objects


def test_what_stands_before_the_wall_is_not_on_it():
    def plate(x, z):
        out = np.full((len(x), 3), np.nan)
        out[rectangle(x, z, (-0.2, 1.0), (0.15, 1.4))] = BLUE
        return out

    assert len(find(plate, at_y=0.99)[0].objects) == 1
    assert not find(plate, at_y=0.5)[0].objects


def test_what_reaches_down_to_the_floor_is_a_door():
    assert not find(with_rectangles(((-0.4, 0.0), (0.4, 1.6))))[0].objects


def test_pieces_of_a_thing_become_one_with_its_whole_box():
    def piece(number: int, x: float, width: float) -> Instance:
        extents = np.array([0.02, width, 0.1])
        return Instance(number, "unknown", 0.0, np.array([x, 0.99, 1.2]), WALL.yaw, extents, 2, True)

    pieces = (piece(3, -0.2, 0.15), piece(4, 0.1, 0.1))
    found, _ = find(with_rectangles(((-0.3, 1.0), (0.2, 1.4))), objects=pieces)
    (whole,) = found.objects
    assert whole.id == 3
    assert whole.extents_m[1:] == pytest.approx([0.5, 0.4], abs=0.02)
    assert found.vertex_instance[:2].tolist() == [3, 3]
    large = replace(pieces[0], extents_m=np.array([0.03, 0.48, 0.4]), center=np.array([-0.05, 0.985, 1.2]))
    kept, notes = find(with_rectangles(((-0.3, 1.0), (0.2, 1.4))), objects=(large,))
    assert kept.objects == (large,)
    assert not notes
