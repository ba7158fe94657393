"""Active viewpoint optimization: the cameras that show most of a thing, or of a region; docs/avo.md.

`import reconstruction.views` is light; what needs a compiler is imported when it is first used.
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
