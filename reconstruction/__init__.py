"""From a video to a simulation-ready scene bundle in the registry.

`reconstruct` is the whole pipeline; its stages are in `reconstruction.pipeline`. `PipelineConfig` holds its options.
Both are loaded on first use, so that importing the package stays light.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from reconstruction.config import PipelineConfig
    from reconstruction.video_to_scene import Reconstruction, reconstruct

__all__ = ["PipelineConfig", "Reconstruction", "reconstruct"]
_HOME = {
    "PipelineConfig": "reconstruction.config",
    "Reconstruction": "reconstruction.video_to_scene",
    "reconstruct": "reconstruction.video_to_scene",
}


def __getattr__(name: str) -> object:
    """Load a public name on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(
            f"module 'reconstruction' has no attribute {name!r}; it has {', '.join(__all__)}"
        )
    import importlib

    return getattr(importlib.import_module(_HOME[name]), name)
