"""gsplat's `rasterization_2dgs` on CUDA behind the same interface, with the same losses through torch.

Two things differ from the CPU rasterizer by gsplat's design: a splat has one depth, that of its center, in the
blended depth, and the distortion is its L1 form. Cut-offs are gsplat's own; of the settings, `near` applies.
"""

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.backend import StepResult
from reconstruction.gaussians.losses import FrameTarget, LossWeights
from reconstruction.gaussians.model import SH_C0
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.rendering import Render
from registry.errors import EnvironmentMissing
from registry.geometry import invert_rigid

_THICKNESS = 1e-3  # gsplat takes three scales and ignores the third


class GsplatBackend:
    """Renders with gsplat on the first CUDA device."""

    name = "gsplat"

    def __init__(self) -> None:
        try:
            import torch
        except ImportError as error:
            raise EnvironmentMissing("gaussians: the gsplat backend needs torch with CUDA") from error
        try:
            import gsplat
        except ImportError as error:
            raise EnvironmentMissing(
                "gaussians: gsplat is not installed; `pip install 'simrecon[gpu]'` beside a CUDA build of torch, "
                "or use --set gaussians.backend=cpu"
            ) from error
        if not torch.cuda.is_available():
            raise EnvironmentMissing(
                "gaussians: gsplat needs a CUDA device and torch sees none; use --set gaussians.backend=cpu"
            )
        self._torch, self._rasterization = torch, gsplat.rasterization_2dgs
        self._device = torch.device("cuda")

    def _tensor(self, array: np.ndarray, grad: bool = False):
        tensor = self._torch.as_tensor(np.asarray(array, np.float32), device=self._device)
        return tensor.clone().requires_grad_(True) if grad else tensor

    def _draw(self, leaves: dict, camera: Camera, world_from_camera: np.ndarray, settings: RasterSettings):
        """Render; leaves hold parameters (n, 13), color shares (n, 3) and the camera tangent xi (6,)."""
        from reconstruction.gaussians.torch_losses import TorchImage

        torch = self._torch
        p, xi = leaves["parameters"], leaves["xi"]
        rgb = (0.5 + SH_C0 * p[:, 10:13]).clamp(min=0) + leaves["shares"]
        scales = torch.cat([p[:, 7:9].exp(), torch.full_like(p[:, :1], _THICKNESS)], dim=1)
        zero = torch.zeros((), device=self._device)
        twist = torch.stack(
            [
                torch.stack([zero, -xi[5], xi[4], xi[0]]),
                torch.stack([xi[5], zero, -xi[3], xi[1]]),
                torch.stack([-xi[4], xi[3], zero, xi[2]]),
                torch.stack([zero, zero, zero, zero]),
            ]
        )
        # camera_from_world of world_from_camera exp(xi), to first order, which is what its derivative at 0 needs.
        camera_from_world = (torch.eye(4, device=self._device) - twist) @ self._tensor(
            invert_rigid(world_from_camera)
        )
        color, alpha, normal, _, distortion, median, meta = self._rasterization(
            p[:, :3], p[:, 3:7], scales, torch.sigmoid(p[:, 9]), rgb, camera_from_world[None],
            self._tensor(camera.matrix)[None], camera.width, camera.height, near_plane=settings.near,
            render_mode="RGB+ED", distloss=True,
        )  # fmt: skip
        # gsplat hands normals out in world space; where a normal is meant, it points at the camera.
        normal = normal[0] @ camera_from_world[:3, :3].T
        image = TorchImage(
            color[0, ..., :3], color[0, ..., 3], normal, alpha[0, ..., 0], distortion[0, ..., 0]
        )
        return image, median[0, ..., 0], meta

    def _leaves(self, parameters: np.ndarray) -> dict:
        return {
            "parameters": self._tensor(parameters, grad=True),
            "shares": self._tensor(np.zeros((len(parameters), 3)), grad=True),
            "xi": self._tensor(np.zeros(6), grad=True),
        }

    def render(
        self,
        parameters: np.ndarray,
        camera: Camera,
        world_from_camera: np.ndarray,
        settings: RasterSettings,
        pixel_weights: np.ndarray | None = None,
    ) -> Render:
        """See `Backend.render`."""
        leaves = self._leaves(parameters)
        image, median, _ = self._draw(leaves, camera, world_from_camera, settings)
        contribution = None
        if pixel_weights is not None:
            contribution = self._shares(image.color, leaves, self._tensor(pixel_weights), keep=False)

        def out(tensor) -> np.ndarray:
            return tensor.detach().float().cpu().numpy()

        depth = np.where(out(image.alpha) > 1e-6, out(image.depth), 0)
        return Render(
            out(image.color), depth, out(median), out(image.normal), out(image.alpha), out(image.distortion),
            contribution,
        )  # fmt: skip

    def _shares(self, color, leaves: dict, weights, keep: bool) -> np.ndarray:
        """Sum alpha T of every Gaussian over weighted pixels: the derivative of the color by a color share."""
        (by_share,) = self._torch.autograd.grad(
            (color[..., 0] * weights).sum(), leaves["shares"], retain_graph=keep
        )
        return by_share[:, 0].float().cpu().numpy()

    def _target(self, target: FrameTarget):
        """Move a frame's target to the device."""
        from reconstruction.gaussians.torch_losses import TorchTarget

        return TorchTarget(
            self._tensor(target.image), self._tensor(target.depth), self._tensor(target.depth_weight),
            self._tensor(target.rays),
        )  # fmt: skip

    def step(
        self,
        parameters: np.ndarray,
        world_from_camera: np.ndarray,
        target: FrameTarget,
        gain: np.ndarray,
        bias: np.ndarray,
        weights: LossWeights,
        settings: RasterSettings,
    ) -> StepResult:
        """See `Backend.step`."""
        from reconstruction.gaussians.torch_losses import torch_loss

        torch = self._torch
        leaves = self._leaves(parameters)
        exposure = (self._tensor(gain, grad=True), self._tensor(bias, grad=True))
        image, _, meta = self._draw(leaves, target.camera, world_from_camera, settings)
        moved = self._target(target)
        total, terms = torch_loss(image, moved, *exposure, weights)
        wanted = (leaves["parameters"], leaves["xi"], *exposure)
        by = [g.float().cpu().numpy() for g in torch.autograd.grad(total, wanted, retain_graph=True)]
        with torch.no_grad():
            error = (exposure[0] * image.color + exposure[1] - moved.image).abs().mean(-1)
        contribution = self._shares(image.color, leaves, torch.ones_like(error), keep=True)
        errors = self._shares(image.color, leaves, error, keep=False)
        radii = meta["radii"].reshape(len(parameters), -1)
        rows = torch.nonzero((radii > 0).all(dim=1))[:, 0]
        depths = meta["depths"].reshape(-1)[rows]
        return StepResult(
            {name: float(value) for name, value in terms.items()}, float(total), by[0], by[1].astype(np.float64),
            by[2].astype(np.float64), by[3].astype(np.float64), rows.int().cpu().numpy(),
            depths.detach().cpu().numpy(), contribution, errors,
        )  # fmt: skip
