"""A hand-made room whose floor and wall have collision shapes, and a page of it."""

import pytest

from registry import SceneRegistry


@pytest.fixture(scope="session")
def play_registry(tmp_path_factory: pytest.TempPathFactory) -> SceneRegistry:
    """Return a registry with `room`: a table with a box, a cup and a book with a knob on it; a picture on the wall."""
    from made_scenes import BundleWriter, add_furniture, box

    registry = SceneRegistry(tmp_path_factory.mktemp("play") / "registry", create=True)
    writer = BundleWriter(tmp_path_factory.mktemp("playroom"))
    writer.add_base(1, "floor", box((4.0, 3.0, 0.1), -0.1), [0, 0, 1, 0])
    writer.add_base(2, "wall", box((4.0, 0.1, 2.4), at=(0, 1.55)), [0, -1, 0, 1.5])
    add_furniture(writer)
    writer.seal("room")
    registry.publish(writer.folder, "room")
    return registry


@pytest.fixture
def page(play_registry: SceneRegistry):
    """Return a page of `room` with the tab "Play"."""
    from studio.playing.part import PlayingPart
    from studio.scene_view import StudioPage

    page = StudioPage(play_registry, "room", parts=(PlayingPart,))
    yield page
    page.close()
