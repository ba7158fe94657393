"""CUDA backend: gsplat's `rasterization_2dgs`, with the training loss in torch.

Differences to the CPU rasterizer, by gsplat's design: blended depth uses the depth of each splat's center, the
distortion is its L1 form, and cut-offs are gsplat's own; of the settings, only `near` applies.
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

_THICKNESS = 1e-3  # third scale; gsplat ignores it


class GsplatBackend:
    """Renders with gsplat on the first CUDA device."""

    name = "gsplat"

    def __init__(self) -> None:
        try:
            import torch
        except ImportError as error:
            raise EnvironmentMissing(
                "gaussians: the gsplat backend needs torch with CUDA; install it, or use --set gaussians.backend=cpu"
            ) from error
        try:
            import gsplat  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise EnvironmentMissing(
                "gaussians: gsplat is not installed; run `pip install 'simrecon[gpu]'` with a CUDA build of torch, or "
                "use --set gaussians.backend=cpu"
            ) from error
        if not torch.cuda.is_available():
            raise EnvironmentMissing(
                "gaussians: gsplat needs a CUDA device, but torch finds none; use --set gaussians.backend=cpu"
            )
        self._torch, self._rasterization = torch, gsplat.rasterization_2dgs
        self._device = torch.device("cuda")

    def _tensor(self, array: np.ndarray, grad: bool = False):
        tensor = self._torch.as_tensor(np.asarray(array, np.float32), device=self._device)
        return tensor.clone().requires_grad_(True) if grad else tensor

    def _draw(self, leaves: dict, camera: Camera, world_from_camera: np.ndarray, settings: RasterSettings):
        """Render; leaves are parameters (n, 13), color shares (n, 3) and the pose twist xi (6,)."""
        from reconstruction.gaussians.torch_losses import TorchImage

        torch = self._torch
        p, xi = leaves["parameters"], leaves["xi"]
        rgb = (0.5 + SH_C0 * p[:, 10:13]).clamp(min=0) + leaves["shares"]
        scales = torch.cat([p[:, 7:9].exp(), torch.full_like(p[:, :1], _THICKNESS)], dim=1)
        zero = torch.zeros((), device=self._device)
        rows = (
            (zero, -xi[5], xi[4], xi[0]), (xi[5], zero, -xi[3], xi[1]), (-xi[4], xi[3], zero, xi[2]),
            (zero, zero, zero, zero),
        )  # fmt: skip
        twist = torch.stack([torch.stack(row) for row in rows])
        # Inverse of world_from_camera exp(xi) to first order, which suffices for the derivative at 0.
        fixed = self._tensor(invert_rigid(world_from_camera))
        camera_from_world = (torch.eye(4, device=self._device) - twist) @ fixed
        color, alpha, normal, _, distortion, median, meta = self._rasterization(
            p[:, :3], p[:, 3:7], scales, torch.sigmoid(p[:, 9]), rgb[None], camera_from_world[None],
            self._tensor(camera.matrix)[None], camera.width, camera.height, near_plane=settings.near,
            render_mode="RGB+ED", distloss=True,
        )  # fmt: skip
        # gsplat returns normals in world space, towards the camera.
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
        """Return the weighted sum over pixels of alpha T of each Gaussian (n,): the derivative by its color share."""
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
            {name: value.item() for name, value in terms.items()}, total.item(), by[0], by[1].astype(np.float64),
            by[2].astype(np.float64), by[3].astype(np.float64), rows.int().cpu().numpy(),
            depths.detach().cpu().numpy(), contribution, errors,
        )  # fmt: skip
