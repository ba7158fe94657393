"""Baked textures on a generated room with true depth and ids."""

import numpy as np
import pytest

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.texture import bake_object, unwrap
from reconstruction.assets.views import prepare_pixels

pytestmark = pytest.mark.stage

CONFIG = AssetsConfig(texture_max_px=128, texture_min_px=128, texture_frames=8)


@pytest.fixture(scope="module")
def bake(small_capture):
    """Return a function that bakes the book: from id maps, and depth that is `off_m` too large where they are 0."""
    book = next(e for e in small_capture.entities if e.name == "book")
    mesh = book.mesh()
    mapping, faces, uvs = unwrap(mesh.vertices, mesh.faces)
    vertices = np.asarray(mesh.vertices)[mapping]

    def run(ids, off_m=0.0):
        pixels = prepare_pixels(small_capture.posed, small_capture.depth, ids)
        pixels.depth[...] = np.where((ids == 0) & (pixels.depth > 0), pixels.depth + off_m, pixels.depth)
        return bake_object(
            vertices,
            faces,
            uvs,
            book.id,
            small_capture.posed,
            small_capture.depth.camera,
            pixels,
            CONFIG,
            0.01,
        )

    ids = small_capture.id_maps.copy()
    # The middle of the book has no id in any frame: pixels whose points lie within 40 % of its half size.
    camera, low_high = small_capture.depth.camera, mesh.bounds
    middle, reach = low_high.mean(axis=0), 0.4 * (low_high[1] - low_high[0]) / 2
    rays = camera.pixel_rays()
    for k, pose in enumerate(small_capture.posed.world_from_camera):
        points = (rays * small_capture.depth.depth[k][..., None]) @ pose[:3, :3].T + pose[:3, 3]
        inside = (np.abs(points - middle)[..., :2] < reach[:2]).all(axis=-1)
        ids[k][inside & (ids[k] == book.id)] = 0
    return run, ids


def test_pixels_without_id_color_the_surface_that_they_measure(bake, small_capture):
    run, ids = bake
    assert (ids != small_capture.id_maps).any()
    whole, gap = run(small_capture.id_maps), run(ids)
    assert gap.seen_share == pytest.approx(whole.seen_share, abs=0.01)
    difference = np.abs(gap.texture.astype(int) - whole.texture)
    assert np.percentile(difference, 95) < 25


def test_pixels_without_id_at_another_depth_do_not(bake, small_capture):
    run, ids = bake
    whole, gap = run(small_capture.id_maps), run(ids, off_m=0.08)
    assert gap.seen_share < whole.seen_share - 0.02
