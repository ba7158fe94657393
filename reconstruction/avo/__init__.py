"""Active viewpoint optimization: the cameras that show most of a thing, or of a region; docs/avo.md."""

from reconstruction.avo.config import AvoConfig
from reconstruction.avo.find import TargetViews, find_views
from reconstruction.avo.inpainting import Inpainter, load_inpainter
from reconstruction.avo.pictures import View
from reconstruction.avo.scene import Target, ViewScene, make_target, prepare_scene
from reconstruction.avo.strategies import STRATEGIES, Strategy, Viewpoint, load_strategy

__all__ = [
    "STRATEGIES",
    "AvoConfig",
    "Inpainter",
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
    "prepare_scene",
]
