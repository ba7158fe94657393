"""Stage 1, keyframe selection: a video or image folder in, upright keyframes and held-out frames out."""

from reconstruction.frames.config import FRAMES_PRESETS, HELD_OUT_EVERY, FramesConfig
from reconstruction.frames.load import load_frames

__all__ = ["FRAMES_PRESETS", "HELD_OUT_EVERY", "FramesConfig", "load_frames"]
