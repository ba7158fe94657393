"""Settings of the frames stage."""

from dataclasses import dataclass

HELD_OUT_EVERY = 10  # CONTRACT section 4: every tenth video frame is kept out of all fitting


@dataclass(frozen=True)
class FramesConfig:
    """How keyframes are selected."""

    max_side_px: int = 960
    """Longer side of the images of all later stages, in pixels; smaller inputs are not enlarged."""
    min_keyframes: int = 64
    """Least number of keyframes, if the video has that many different sharp frames."""
    max_keyframes: int = 96
    """Largest number of keyframes."""
    max_held_out: int = 40
    """Largest number of held-out frames, spread evenly."""
    step: float = 0.045
    """Desired image displacement between keyframes, as a share of the longer image side."""
    blurred_below: float = 0.4
    """A frame is blurred if its sharpness is below this share of that of its neighbors in time."""
    widest_gap: float = 0.22
    """A blurred frame is kept if the gap without it would exceed this share of the longer image side."""
    still_below: float = 0.012
    """A video with less total displacement than this share of the longer image side is refused as at rest."""
    min_usable_frames: int = 8
    """Inputs with fewer different frames are refused."""
    hold_out_images_from: int = 60
    """Image folders with fewer images hold none out for evaluation."""
    max_analysis_fps: float = 30.0
    """Videos with more frames per second are analyzed at about this rate."""


FRAMES_PRESETS = {
    "fast": FramesConfig(max_side_px=640, min_keyframes=48, max_keyframes=64, max_held_out=30),
    "default": FramesConfig(),
    "quality": FramesConfig(
        max_side_px=1280, min_keyframes=72, max_keyframes=120, step=0.035, max_held_out=40
    ),
}
