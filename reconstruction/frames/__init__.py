"""Stage 1: a video, or a folder of images -> upright keyframes, and frames held out for evaluation."""

from reconstruction.frames.config import FRAMES_PRESETS, HELD_OUT_EVERY, FramesConfig
from reconstruction.frames.load import load_frames

__all__ = ["FRAMES_PRESETS", "HELD_OUT_EVERY", "FramesConfig", "load_frames"]
