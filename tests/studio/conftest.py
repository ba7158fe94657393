"""Scenes that are made by hand in a registry, and pages of them."""

import sys
from pathlib import Path

import pytest

from registry import SceneRegistry

pytest.importorskip("viser", reason="the studio needs viser: pip install 'simrecon[studio]'")
sys.path.append(str(Path(__file__).parents[1] / "simrecon_envs"))  # made_scenes.py


@pytest.fixture(scope="session")
def made_registry(tmp_path_factory: pytest.TempPathFactory) -> SceneRegistry:
    """Return a registry with `room` (furniture and Gaussians) and `hostile` (texts with HTML and control signs)."""
    from hostile_text import HOSTILE
    from made_scenes import BundleWriter, add_furniture, add_room, publish_with_gaussians

    registry = SceneRegistry(tmp_path_factory.mktemp("home") / "registry", create=True)
    publish_with_gaussians(registry, "room", tmp_path_factory.mktemp("room"))
    writer = BundleWriter(tmp_path_factory.mktemp("hostile"))
    add_room(writer)
    add_furniture(writer)
    for item in writer.objects:
        item["name"] = item["label"] = f"{HOSTILE} {item['id']}"
        item["material"] = item["provenance"]["geometry"] = HOSTILE
    for edge in writer.edges:
        edge["evidence"] = HOSTILE
    writer.seal("hostile")
    registry.publish(writer.folder, "hostile")
    return registry
