"""Active viewpoint optimization: the cameras that show most of a thing, or of a region; docs/avo.md.

`import reconstruction.avo` is light; what needs a compiler is imported when it is first used.
"""

from reconstruction.avo.config import AVO_PRESETS, AvoConfig
from reconstruction.avo.find import TargetViews, find_views
from reconstruction.avo.inpainting import Inpainter, load_inpainter
from reconstruction.avo.pictures import View
from reconstruction.avo.scene import Target, ViewScene, make_target, prepare_scene
from reconstruction.avo.stage import SceneViews, make_views
from reconstruction.avo.strategies import STRATEGIES, Strategy, Viewpoint, load_strategy

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
