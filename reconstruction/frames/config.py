"""Settings of the frames stage."""

from dataclasses import dataclass

HELD_OUT_EVERY = 10  # CONTRACT section 4: every tenth video frame is kept out of all fitting


@dataclass(frozen=True)
class FramesConfig:
    """How frames are chosen."""

    max_side_px: int = 960
    """Longer side of the images that all later stages see, in pixels; smaller inputs stay as they are."""
    min_keyframes: int = 64
    """As many keyframes at least, where the video has that many different sharp frames."""
    max_keyframes: int = 96
    """As many keyframes at most."""
    max_held_out: int = 40
    """As many held-out frames at most, spread evenly."""
    step: float = 0.045
    """Wanted displacement between keyframes, as a share of the longer image side."""
    blurred_below: float = 0.4
    """A frame is blurred where its sharpness is below this share of that of its neighbours in time."""
    widest_gap: float = 0.22
    """Blurred frames are still taken where a wider gap than this share of the side would open."""
    still_below: float = 0.012
    """A video that moves less than this share of the longer side was filmed by a camera at rest."""
    min_usable_frames: int = 8
    """Fewer different frames than this cannot become a scene."""
    hold_out_images_from: int = 60
    """A folder with fewer images than this gives all of them to the reconstruction and holds none out."""
    max_analysis_fps: float = 30.0
    """Videos with more frames per second are analysed at about this rate."""


FRAMES_PRESETS = {
    "fast": FramesConfig(max_side_px=640, min_keyframes=48, max_keyframes=64, max_held_out=30),
    "default": FramesConfig(),
    "quality": FramesConfig(
        max_side_px=1280, min_keyframes=72, max_keyframes=120, step=0.035, max_held_out=40
    ),
}
