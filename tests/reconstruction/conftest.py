"""What the tests of several files share."""

import pytest
from exports_room import make_room

from registry import SceneBundle


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> SceneBundle:
    """Return the room that exports are tested with; read only."""
    return make_room(tmp_path_factory.mktemp("exports_room") / "bundle")
