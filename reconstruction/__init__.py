"""Reconstruction of a video as a simulation-ready scene bundle in the registry.

`reconstruct` runs the whole pipeline (stages: `reconstruction.pipeline`) with the options of a `PipelineConfig`. Both
are imported on first use, to keep `import reconstruction` fast.
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
    """Import a public name on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(
            f"module 'reconstruction' has no attribute {name!r}; it has {', '.join(__all__)}"
        )
    import importlib

    return getattr(importlib.import_module(_HOME[name]), name)
