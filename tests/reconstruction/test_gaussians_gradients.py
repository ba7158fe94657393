"""Values and derivatives of the rasterizer and of the losses, against float64 autograd and finite differences."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
import gaussians_reference as reference

from reconstruction.core.types import Camera
from reconstruction.gaussians.fit import exponential
from reconstruction.gaussians.losses import FrameTarget, LossWeights, image_loss, ssim
from reconstruction.gaussians.rasterizer import RasterSettings, rasterize, rasterize_backward
from reconstruction.gaussians.torch_losses import TorchImage, TorchTarget, torch_loss

pytestmark = pytest.mark.stage

CAMERA = Camera(36, 28, 40.0, 41.0, 18.3, 13.2)
UNCUT = RasterSettings(
    sigma_cutoff=9.0, alpha_min=1e-14, transmittance_stop=0.0, near=0.05, reference_depth=2.0
)


def splats(n=14, seed=0):
    """Disks of all sizes and tilts in front of the camera, one of them far smaller than a pixel."""
    rng = np.random.default_rng(seed)
    p = np.zeros((n, 13))
    p[:, :2], p[:, 2] = rng.uniform(-0.6, 0.6, (n, 2)), rng.uniform(1.4, 3.0, n)
    p[:, 3:7] = rng.normal(size=(n, 4))
    p[:, 7:9] = rng.uniform(np.log(0.02), np.log(0.35), (n, 2))
    p[:, 9], p[:, 10:] = rng.normal(size=n) + 0.5, 1.5 * rng.normal(size=(n, 3))
    p[0, 7:9] = np.log(0.004)
    return p


def wall(n=70, seed=1):
    """A slanted, noisy wall of disks: what the depth and normal losses are made for."""
    rng = np.random.default_rng(seed)
    p = splats(n, seed)
    p[:, :2] = rng.uniform(-1.1, 1.1, (n, 2))
    p[:, 2] = 2 + 0.3 * p[:, 0] + rng.normal(0, 0.02, n)
    p[:, 3:7] = np.array([1, 0, 0.1, 0]) + 0.2 * rng.normal(size=(n, 4))
    p[:, 7:9], p[:, 9] = rng.uniform(np.log(0.1), np.log(0.3), (n, 2)), rng.normal(size=n) + 1
    return p


POSE = exponential(np.array([0.05, -0.1, 0.02, 0.03, -0.08, 0.2]))


def reference_render(p, xi):
    return reference.render(p, xi, CAMERA, torch.tensor(POSE), UNCUT.reference_depth)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_derivatives_equal_autograd_through_a_dense_reference(dtype):
    p = splats()
    weights = np.random.default_rng(2).normal(size=(CAMERA.height, CAMERA.width, 9))
    leaf = torch.tensor(p, requires_grad=True)
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    expected = reference_render(leaf, xi)
    (expected * torch.tensor(weights)).sum().backward()
    image = rasterize(p.astype(dtype), CAMERA, POSE, UNCUT)
    gradients = rasterize_backward(image, weights.astype(dtype))
    tolerance = 2e-6 if dtype == np.float64 else 2e-4
    np.testing.assert_allclose(
        image.features[..., :9],
        expected.detach().numpy(),
        atol=tolerance * float(expected.detach().abs().max()),
    )
    for group in (slice(0, 3), slice(3, 7), slice(7, 9), slice(9, 10), slice(10, 13)):
        want = leaf.grad.numpy()[:, group]
        np.testing.assert_allclose(
            gradients.parameters[:, group], want, atol=5 * tolerance * np.abs(want).max(), rtol=0.005
        )
    np.testing.assert_allclose(
        gradients.pose, xi.grad.numpy(), atol=5 * tolerance * float(xi.grad.abs().max()), rtol=0.002
    )


def test_derivatives_equal_finite_differences():
    p, step = splats(8, seed=3), 1e-6
    weights = np.random.default_rng(4).normal(size=(CAMERA.height, CAMERA.width, 9))

    def value(parameters, pose):
        return float((rasterize(parameters, CAMERA, pose, UNCUT).features[..., :9] * weights).sum())

    gradients = rasterize_backward(rasterize(p, CAMERA, POSE, UNCUT), weights)
    differences = np.zeros_like(p)
    for index in np.ndindex(*p.shape):
        more, less = p.copy(), p.copy()
        more[index] += step
        less[index] -= step
        differences[index] = (value(more, POSE) - value(less, POSE)) / (2 * step)
    np.testing.assert_allclose(
        gradients.parameters, differences, rtol=1e-3, atol=1e-5 * np.abs(differences).max()
    )
    along = [
        (value(p, POSE @ exponential(step * e)) - value(p, POSE @ exponential(-step * e))) / (2 * step)
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(gradients.pose, along, rtol=1e-4)


@pytest.mark.parametrize("only", ["color", "ssim", "depth", "normal", "distortion", "opacity", "all"])
def test_losses_and_their_derivatives_equal_autograd(only):
    one = {
        name: float(only in (name, "all")) for name in ("ssim", "depth", "normal", "distortion", "opacity")
    }
    weights = LossWeights(
        0.3 * one["ssim"], one["depth"], 0.02, one["normal"], 5 * one["distortion"], one["opacity"]
    )
    rng = np.random.default_rng(5)
    shape = (CAMERA.height, CAMERA.width)
    known = (rng.uniform(size=shape) > 0.3) * rng.choice([0.2, 1.0], shape)
    target = FrameTarget(CAMERA, rng.uniform(size=(*shape, 3)), np.full(shape, 2.1), known)
    gain, bias = np.array([1.1, 0.9, 1.0]), np.array([0.01, 0.02, 0.0])
    p = wall()
    leaf = torch.tensor(p, requires_grad=True)
    exposure = [torch.tensor(x, requires_grad=True) for x in (gain, bias)]
    r = reference_render(leaf, torch.zeros(6, dtype=torch.float64))
    image = TorchImage(r[..., :3], r[..., 3] / r[..., 7], r[..., 4:7], r[..., 7], r[..., 8])
    moved = TorchTarget(
        *(torch.tensor(x) for x in (target.image, target.depth, target.depth_weight, target.rays))
    )
    total, terms = torch_loss(image, moved, *exposure, weights)
    total.backward()

    drawn = rasterize(p, CAMERA, POSE, UNCUT)
    loss = image_loss(drawn.features, target, gain, bias, weights)
    gradients = rasterize_backward(drawn, loss.image_gradients)
    assert loss.total == pytest.approx(float(total.detach()), rel=1e-5)
    assert loss.terms == pytest.approx({k: float(v.detach()) for k, v in terms.items()}, rel=1e-5)
    want = leaf.grad.numpy()
    assert np.abs(want).max() > 1e-4
    np.testing.assert_allclose(gradients.parameters, want, rtol=0.01, atol=1e-4 * np.abs(want).max())
    np.testing.assert_allclose(loss.gain, exposure[0].grad.numpy(), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(loss.bias, exposure[1].grad.numpy(), rtol=1e-4, atol=1e-9)


def test_cut_offs_change_little_of_the_image():
    p = wall()
    settings = RasterSettings(sigma_cutoff=3.0, reference_depth=2.0)
    full, cut = (rasterize(p, CAMERA, POSE, s).features for s in (UNCUT, settings))
    assert np.abs(full[..., :8] - cut[..., :8]).max() < 0.1
    assert np.abs(full[..., :8] - cut[..., :8]).mean() < 0.006


def test_ssim_is_one_only_for_equal_images():
    rng = np.random.default_rng(6)
    a = rng.uniform(size=(40, 50, 3))
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-5)
    assert ssim(a, np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1)) < 0.95


def test_a_splat_before_the_lens_does_not_outweigh_the_picture():
    """Distortion is bounded by (4 / 2)^2, also where a disk reaches through the plane of the lens."""
    p = np.concatenate([wall(), splats(1)])
    p[-1, :3], p[-1, 3:7], p[-1, 7:9] = POSE[:3, 3] + 0.09 * POSE[:3, 2], [1, 1, 0, 0], np.log(0.1)
    behind = p[:-1]
    weights = np.zeros((CAMERA.height, CAMERA.width, 9))
    weights[..., 8] = 1
    image = rasterize(p, CAMERA, POSE, UNCUT)
    assert image.features[..., 7].max() > 0.5
    assert 0.01 < image.features[..., 8].max() <= 4
    ours = rasterize_backward(image, weights).parameters[:-1, 9]
    alone = rasterize_backward(rasterize(behind, CAMERA, POSE, UNCUT), weights).parameters[:, 9]
    assert np.abs(ours).max() < 200 * np.abs(alone).max()
