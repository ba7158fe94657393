"""Stage 5: fit 2D Gaussians (Huang et al. 2024) to posed frames and depth maps, on the CPU or with gsplat.

Importing this package does not import Numba; modules with kernels are imported at first use.
"""

from reconstruction.gaussians.config import GAUSSIANS_PRESETS, GaussiansConfig
from reconstruction.gaussians.evaluate import GaussiansEvaluation, evaluate_gaussians
from reconstruction.gaussians.fit import fit_gaussians
from reconstruction.gaussians.model import Gaussians, moved
from reconstruction.gaussians.ply import read_ply, write_ply
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.rendering import Render
from reconstruction.gaussians.stage import GaussianScene, make_gaussians
from reconstruction.gaussians.views import render_gaussians

__all__ = [
    "GAUSSIANS_PRESETS",
    "GaussianScene",
    "Gaussians",
    "GaussiansConfig",
    "GaussiansEvaluation",
    "RasterSettings",
    "Render",
    "evaluate_gaussians",
    "fit_gaussians",
    "make_gaussians",
    "moved",
    "read_ply",
    "render_gaussians",
    "write_ply",
]
