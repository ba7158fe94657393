"""Fixtures that all tests share: a filmed room with known truth, and the shipped video."""

from pathlib import Path

import pytest

from synthetic.capture import SyntheticCapture, make_test_capture

DEMO_VIDEO = Path(__file__).parents[1] / "examples" / "data" / "demo_room.mp4"


@pytest.fixture(scope="session")
def small_capture() -> SyntheticCapture:
    """Twelve 320x240 frames of the generated room, world space, true cameras, depth, ids and entities."""
    return make_test_capture()


@pytest.fixture(scope="session")
def demo_video() -> Path:
    """Return the path of the video that ships with the project; its truth lies beside it."""
    assert DEMO_VIDEO.is_file(), "examples/data/demo_room.mp4 is missing: run tools/make_demo_video.py"
    return DEMO_VIDEO
