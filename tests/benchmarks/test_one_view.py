"""The stand-in for a generative model: what it makes of one view, over the protocol that it speaks."""

import io

import numpy as np
import pytest
import trimesh

from benchmarks.one_view import OneViewServer, Shown, complete_from_view
from reconstruction.assets.generation.base import GenerationError, Job, ObjectPictures, Picture
from reconstruction.assets.generation.hunyuan import Hunyuan3D
from reconstruction.assets.generation.pictures import encode_png
from reconstruction.assets.generation.service import ServiceLimits
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.views.cameras import look_at, square_camera
from registry.geometry import GLTF_FROM_WORLD

SIZE = np.array([0.4, 0.2, 0.3])


@pytest.fixture(scope="module")
def shown() -> Shown:
    """A box from one corner, above it."""
    box = trimesh.creation.box(SIZE)
    camera, pose = square_camera(160, 50.0), look_at(np.array([0.7, 0.6, 0.6]), np.zeros(3), 80.0)
    raster = rasterize_mesh(np.asarray(box.vertices), np.asarray(box.faces), camera, pose)
    mask = raster.face >= 0
    picture = np.full((160, 160, 3), (200, 40, 30), np.uint8)
    return Shown(picture, mask, np.where(mask, raster.depth, 0).astype(np.float32), camera, pose)


def read(data: bytes) -> trimesh.Trimesh:
    mesh = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh")
    mesh.apply_transform(np.linalg.inv(GLTF_FROM_WORLD))
    return mesh


def test_a_box_seen_from_a_corner_is_closed_by_a_half_turn(shown):
    mesh = read(complete_from_view(shown))
    assert mesh.is_watertight
    assert mesh.volume > 0
    sides = np.sort(mesh.bounding_box_oriented.primitive.extents)
    np.testing.assert_allclose(sides / sides[-1], np.sort(SIZE) / SIZE.max(), atol=0.06)
    assert mesh.volume / sides.prod() > 0.85


def test_it_answers_the_real_client_for_pictures_that_it_was_told_of(shown):
    picture = Picture(shown.picture, shown.mask)
    asked = ObjectPictures(1, "box", (picture,))
    with OneViewServer() as server:
        client = Hunyuan3D(
            server.url, "one-view", textured=True, poll=False, seed=0, limits=ServiceLimits(20.0)
        )
        with pytest.raises(GenerationError, match="no mesh"):
            client.generate(asked, Job())
        server.tell(encode_png(picture.cut_out()), shown)
        assert client.generate(asked, Job()) == complete_from_view(shown)
