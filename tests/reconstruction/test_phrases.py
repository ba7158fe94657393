"""Referring expressions follow the measured attributes and are unique in a scene."""

import numpy as np
import pytest
import trimesh

from reconstruction.core.types import TexturedMesh
from reconstruction.publish.phrases import Described, color_name, phrases, shape_noun

FLOOR, SHELF, TABLE = 1, 2, 3


def mesh_of(shape, rgb=(200, 30, 30)):
    """Return a shape of one color."""
    texture = np.broadcast_to(np.array(rgb, np.uint8), (4, 4, 3)).copy()
    uvs = np.full((len(shape.vertices), 2), 0.5, np.float32)
    return TexturedMesh(shape.vertices.astype(np.float32), shape.faces.astype(np.int32), uvs, texture)


def thing(key, label="unknown", rgb=(200, 30, 30), size=(0.1, 0.1, 0.1), at=(0, 0, 0), on=FLOOR, shape=None):
    """Return the attributes of a placed object."""
    pose = np.eye(4)
    pose[:3, 3] = at
    mesh = mesh_of(trimesh.creation.box(size) if shape is None else shape, rgb)
    return Described.of(key, label, mesh, pose, on)


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((200, 30, 30), "red"), ((20, 20, 20), "black"), ((235, 235, 230), "white"), ((120, 120, 120), "gray"),
        ((30, 60, 190), "blue"), ((40, 140, 60), "green"), ((240, 210, 40), "yellow"), ((110, 70, 40), "brown"),
        ((70, 45, 30), "brown"), ((240, 140, 30), "orange"), ((120, 40, 150), "purple"), ((245, 170, 190), "pink"),
    ],
)  # fmt: skip
def test_colors_have_the_names_that_people_use(rgb, name):
    assert color_name(mesh_of(trimesh.creation.box((0.1, 0.1, 0.1)), rgb)) == name


def test_a_thing_of_many_colors_has_no_color():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    texture = np.zeros((3, 3, 3), np.uint8)
    texture[:] = (200, 30, 30), (30, 60, 190), (240, 210, 40)
    vertices, faces = box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    uvs = np.repeat(np.stack([(np.arange(12) % 3 + 0.5) / 3, np.full(12, 0.5)], 1), 3, axis=0)
    mesh = TexturedMesh(vertices.astype(np.float32), faces.astype(np.int32), uvs.astype(np.float32), texture)
    assert color_name(mesh) == ""


@pytest.mark.parametrize(
    ("shape", "noun"),
    [
        (trimesh.creation.box((0.1, 0.2, 0.1)), "box"),
        (trimesh.creation.box((0.3, 0.2, 0.02)), "flat thing"),
        (trimesh.creation.cylinder(0.05, 0.08), "round thing"),
        (trimesh.creation.cone(0.05, 0.3), "tall thing"),
        (trimesh.creation.icosphere(subdivisions=3, radius=0.05).apply_scale([5, 1, 1]), "long thing"),
    ],
)
def test_what_has_no_label_is_named_by_its_shape(shape, noun):
    assert shape_noun(shape.vertices) == noun


def test_size_color_and_place_tell_things_apart():
    things = [
        thing(SHELF, "shelf", (110, 70, 40), (0.8, 0.3, 1.2), (2, 0, 0)),
        thing(TABLE, "table", (235, 235, 230), (1.2, 0.8, 0.7)),
        thing(4, "book", size=(0.2, 0.15, 0.03), at=(2, 0, 1.2), on=SHELF),
        thing(5, "book", size=(0.2, 0.15, 0.03), at=(0, 0, 0.7), on=TABLE),
        thing(6, rgb=(30, 60, 190), size=(0.2, 0.2, 0.2), at=(0.4, 0, 0.7), on=TABLE),
        thing(7, rgb=(30, 60, 190), size=(0.1, 0.1, 0.1), at=(0.1, 0.2, 0.7), on=TABLE),
        thing(8, "mug", (120, 120, 120), at=(-0.5, 0, 0.7), on=TABLE),
        thing(9, "can", (40, 140, 60), at=(-0.45, 0.1, 0.7), on=TABLE),
        thing(10, "can", (40, 140, 60), at=(0.5, -0.3, 0.7), on=TABLE),
    ]
    names = phrases(things, {FLOOR: "floor"})
    assert names == {
        SHELF: "brown shelf", TABLE: "white table", 4: "red book on the brown shelf", 5: "red book on the white table",
        6: "large blue box", 7: "small blue box", 8: "gray mug", 9: "green can beside the gray mug",
        10: "green can beside the large blue box",
    }  # fmt: skip


def test_two_pictures_on_two_walls_are_not_both_the_picture_on_the_wall():
    names = phrases(
        [thing(5, "picture", on=1), thing(6, "picture", at=(3, 0, 1), on=2)], {1: "wall", 2: "wall"}
    )
    assert names == {5: "red picture 5", 6: "red picture 6"}


def test_the_shape_comes_before_the_color():
    plate = trimesh.creation.box((0.3, 0.2, 0.02))
    assert phrases([thing(2, shape=plate)], {FLOOR: "floor"}) == {2: "flat red thing"}


@pytest.mark.parametrize("seed", range(5))
def test_no_two_objects_share_a_name_and_order_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    things = []
    for key in range(2, 32):
        label, rgb = str(rng.choice(["unknown", "box", "mug"])), tuple(rng.choice([20, 120, 230], 3))
        size, at = tuple(rng.uniform(0.05, 0.3, 3)), tuple(rng.uniform(-1, 1, 3))
        things.append(thing(key, label, rgb, size, at, int(rng.choice([FLOOR, 2, 3])) if key > 3 else FLOOR))
    names = phrases(things, {FLOOR: "floor"})
    assert len(set(names.values())) == len(things)
    shuffled = [things[k] for k in rng.permutation(len(things))]
    assert phrases(shuffled, {FLOOR: "floor"}) == names
