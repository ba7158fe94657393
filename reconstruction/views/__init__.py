"""Active viewpoint optimization: find the cameras that show most of an object or a region; see docs/avo.md.

Importing this package does not import Numba; modules with kernels are imported at first use.
"""

from reconstruction.views.config import AVO_PRESETS, AvoConfig
from reconstruction.views.find import TargetViews, find_views
from reconstruction.views.inpainting import Inpainter, load_inpainter
from reconstruction.views.pictures import View
from reconstruction.views.scene import Target, ViewScene, make_target, prepare_scene
from reconstruction.views.stage import SceneViews, make_views
from reconstruction.views.strategies import STRATEGIES, Strategy, Viewpoint, load_strategy

__all__ = [
    "AVO_PRESETS",
    "STRATEGIES",
    "AvoConfig",
    "Inpainter",
    "SceneViews",
    "Strategy",
    "Target",
    "TargetViews",
    "View",
    "ViewScene",
    "Viewpoint",
    "find_views",
    "load_inpainter",
    "load_strategy",
    "make_target",
    "make_views",
    "prepare_scene",
]
