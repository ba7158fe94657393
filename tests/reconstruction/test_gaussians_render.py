"""What a rendered view must be, whatever the Gaussians: conservation, order, emptiness; and the files."""

import numpy as np
import pytest

from reconstruction.core import artifacts
from reconstruction.core.types import Camera
from reconstruction.gaussians import (
    Gaussians,
    RasterSettings,
    evaluate_gaussians,
    read_ply,
    render_gaussians,
    write_ply,
)
from reconstruction.gaussians.backends import load_backend
from reconstruction.gaussians.model import from_packed
from reconstruction.gaussians.seeding import disks
from registry.errors import BundleError, EnvironmentMissing, UsageError
from registry.geometry import matrix_from_quat

pytestmark = pytest.mark.stage

CAMERA = Camera(48, 40, 50.0, 50.0, 24.0, 20.0)
EYE = np.eye(4)


def plate(z, rgb, opacity=0.97, half=2.0, spacing=0.05) -> np.ndarray:
    """A dense plate of disks across the view at depth z, packed."""
    grid = np.arange(-half, half, spacing)
    x, y = (a.ravel() for a in np.meshgrid(grid, grid))
    points = np.stack([x, y, np.full_like(x, z)], 1)
    normals = np.tile([0.0, 0.0, -1.0], (len(x), 1))
    return disks(points, normals, np.tile(rgb, (len(x), 1)), np.full(len(x), 0.6 * spacing), opacity)


def random_gaussians(n=200, seed=0) -> Gaussians:
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(n, 13))
    p[:, 2] += 4
    p[:, 7:9] = rng.uniform(np.log(0.02), np.log(0.4), (n, 2))
    return from_packed(p)


def test_no_gaussians_render_to_nothing():
    render = render_gaussians(from_packed(np.zeros((0, 13))), CAMERA, EYE, pixel_weights=np.ones((40, 48)))
    for image in (render.color, render.depth, render.median_depth, render.normal, render.opacity):
        assert not image.any()
    assert render.contribution.shape == (0,)


def test_gaussians_behind_the_camera_are_not_seen():
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])  # half a turn about y
    seen = from_packed(plate(2.0, (1, 0, 0)))
    assert render_gaussians(seen, CAMERA, EYE).opacity.min() > 0.9
    assert not render_gaussians(seen, CAMERA, turned).opacity.any()


def test_contributions_add_up_to_the_opacity():
    rng = np.random.default_rng(1)
    gaussians = random_gaussians()
    weights = rng.uniform(size=(CAMERA.height, CAMERA.width))
    for given in (np.ones_like(weights), weights):
        render = render_gaussians(gaussians, CAMERA, EYE, pixel_weights=given)
        assert render.contribution.sum() == pytest.approx((render.opacity * given).sum(), rel=1e-4)
        assert render.contribution.min() >= 0
    assert render.opacity.min() >= 0
    assert render.opacity.max() <= 1 + 1e-5
    assert np.linalg.norm(render.normal, axis=-1).max() <= 1 + 1e-4
    assert render_gaussians(gaussians, CAMERA, EYE).contribution is None


def test_near_hides_far_whatever_the_order_in_memory():
    near, far = plate(1.5, (1, 0, 0)), plate(3.0, (0, 0, 1), spacing=0.1, half=3.0)
    middle = (slice(8, -8), slice(8, -8))
    renders = [
        render_gaussians(from_packed(np.concatenate(p)), CAMERA, EYE) for p in ((near, far), (far, near))
    ]
    for render in renders:
        assert render.color[middle][..., 0].min() > 0.9
        assert render.color[middle][..., 2].max() < 0.1
        np.testing.assert_allclose(render.median_depth[middle], 1.5, rtol=1e-4)
    np.testing.assert_allclose(renders[0].color, renders[1].color, atol=1e-5)


def test_depth_and_normal_of_a_slanted_plate_are_those_of_the_plane():
    # The plane x sin a + z cos a = d, seen from the origin: z = d / (tan a x' + 1) / cos a.
    a = 0.5
    normal = np.array([-np.sin(a), 0, -np.cos(a)])
    grid = np.arange(-3, 3, 0.05)
    s, y = (v.ravel() for v in np.meshgrid(grid, grid))
    points = s[:, None] * np.array([np.cos(a), 0, -np.sin(a)]) + y[:, None] * np.array([0, 1.0, 0])
    points[:, 2] += 3
    p = disks(points, np.tile(normal, (len(s), 1)), np.full((len(s), 3), 0.5), np.full(len(s), 0.03), 0.9)
    render = render_gaussians(from_packed(p), CAMERA, EYE)
    x = (np.arange(CAMERA.width) + 0.5 - CAMERA.cx) / CAMERA.fx
    truth = np.broadcast_to(3 * np.cos(a) / (x * np.sin(a) + np.cos(a)), render.depth.shape)
    np.testing.assert_allclose(render.depth, truth, rtol=2e-3)
    np.testing.assert_allclose(
        render.normal / render.opacity[..., None], np.broadcast_to(normal, render.normal.shape), atol=1e-3
    )
    assert render.distortion.max() < 1e-5


def test_a_splat_smaller_than_a_pixel_is_still_seen():
    p = disks(np.array([[0.0, 0, 2]]), np.array([[0.0, 0, -1]]), np.ones((1, 3)), np.array([1e-4]), 0.9)
    assert render_gaussians(from_packed(p), CAMERA, EYE).opacity.sum() > 0.5


def test_the_image_does_not_depend_on_the_number_of_threads(monkeypatch):
    import numba

    from reconstruction.gaussians import threads

    gaussians = random_gaussians(3000, seed=3)
    renders = []
    for count in (1, 3):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", count)
        assert threads.thread_count() == count
        renders.append(render_gaussians(gaussians, CAMERA, EYE, pixel_weights=np.ones((40, 48))))
    for name in ("color", "depth", "normal", "contribution"):
        assert np.array_equal(getattr(renders[0], name), getattr(renders[1], name)), name


def test_ply_keeps_everything_that_a_viewer_needs(tmp_path):
    gaussians = random_gaussians()
    write_ply(gaussians, tmp_path / "g.ply")
    back = read_ply(tmp_path / "g.ply")
    np.testing.assert_allclose(back.packed(), gaussians.packed(), atol=1e-6)
    header = (tmp_path / "g.ply").read_bytes().split(b"end_header\n")[0].decode()
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property")]
    wanted = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert names == wanted.split()


def test_ply_of_other_programs_is_read_with_its_thinnest_axis_as_the_normal(tmp_path):
    gaussians = random_gaussians(5)
    names = ["x", "y", "z", "opacity", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0"]
    names += [f"rot_{c}" for c in range(4)] + [f"scale_{c}" for c in range(3)]
    # Identity axes, thinnest along x: the normal must come out as x, with y and z as tangents.
    rows = [
        [*gaussians.means[i], 0.5, *gaussians.colors[i], 9.0, 1, 0, 0, 0, -9.0, -2.0, -3.0] for i in range(5)
    ]
    text = ["ply", "format ascii 1.0", "comment made elsewhere", "element vertex 5"]
    text += [f"property float {name}" for name in names] + ["end_header"]
    text += [" ".join(f"{v:.9g}" for v in row) for row in rows]
    (tmp_path / "a.ply").write_text("\n".join(text) + "\n")
    back = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(back.means, gaussians.means, rtol=1e-6)
    np.testing.assert_allclose(back.log_scales, np.tile([-2.0, -3.0], (5, 1)), rtol=1e-6)
    axes = matrix_from_quat(back.quaternions)
    np.testing.assert_allclose(axes, np.tile(np.eye(3)[:, [1, 2, 0]], (5, 1, 1)), atol=1e-6)


@pytest.mark.parametrize("damage", ["not ply", "short", "properties"])
def test_damaged_ply_is_refused_with_its_name(tmp_path, damage):
    path = tmp_path / "bad.ply"
    write_ply(random_gaussians(4), path)
    data = path.read_bytes()
    changed = {
        "not ply": b"obj\n" + data,
        "short": data[:-7],
        "properties": data.replace(b"scale_1", b"scale_9"),
    }
    path.write_bytes(changed[damage])
    with pytest.raises(BundleError, match=r"bad\.ply"):
        read_ply(path)


def test_gaussians_are_an_artifact(tmp_path):
    gaussians = from_packed(
        random_gaussians().packed(), np.ones((2, 3), np.float32), None, np.stack([EYE, EYE])
    )
    artifacts.save(gaussians, tmp_path / "g")
    back = artifacts.load(Gaussians, tmp_path / "g")
    assert np.array_equal(back.packed(), gaussians.packed())
    assert back.exposure_gain.shape == back.exposure_bias.shape == (2, 3)


def test_evaluation_forgives_exposure_and_nothing_else(small_capture):
    posed = small_capture.posed
    pose, image = posed.held_out_world_from_camera[0], posed.held_out_images[0]
    # A gray card before the first kept-out camera: every pixel has the image's mean color after the exposure.
    local = plate(1.0, (0.5, 0.5, 0.5))
    points = local[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    normals = np.tile(-pose[:3, 2], (len(points), 1))
    card = from_packed(
        disks(points, normals, np.full((len(points), 3), 0.5), np.full(len(points), 0.03), 0.97)
    )
    figures = evaluate_gaussians(card, posed, small_capture.held_out_depth)
    assert figures.indices.tolist() == posed.held_out_indices.tolist()
    deviation = (image / 255 - (image / 255).mean((0, 1))).std()
    assert figures.psnr_db[0] == pytest.approx(-20 * np.log10(deviation), abs=0.3)
    truth = small_capture.held_out_depth[0]
    assert figures.depth_error[0] == pytest.approx(np.median(np.abs(1 / truth - 1)), rel=0.02)
    assert figures.coverage[0] > 0.99


def test_unknown_backend_is_wrong_use_and_missing_gsplat_is_said():
    with pytest.raises(UsageError, match="Built in: cpu, gsplat"):
        load_backend("opengl")
    import importlib.util

    import torch

    if importlib.util.find_spec("gsplat") is None or not torch.cuda.is_available():
        with pytest.raises(EnvironmentMissing, match="gsplat"):
            load_backend("gsplat")


def test_relaxed_cut_offs_let_through_more():
    gaussians = random_gaussians(400, seed=2)
    tight = render_gaussians(gaussians, CAMERA, EYE, settings=RasterSettings(sigma_cutoff=1.0)).opacity
    relaxed = RasterSettings(sigma_cutoff=6.0, alpha_min=1e-6, transmittance_stop=0.0)
    loose = render_gaussians(gaussians, CAMERA, EYE, settings=relaxed).opacity
    assert (loose - tight).min() > -1e-5
    assert loose.sum() > 1.02 * tight.sum()
