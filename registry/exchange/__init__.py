"""Exchange of scenes: packs (one file a scene), cards, and places of any fsspec address that many machines share.

Formats and guarantees: docs/sharing.md. Only the functions that reach a URL import fsspec.
"""

from registry.exchange.adding import AddedScene, add_scene
from registry.exchange.card import NOT_STATED, licence_of, scene_card
from registry.exchange.pack import PackedScene, pack_scene
from registry.exchange.place import Place, open_place
from registry.exchange.pulling import pull_scene
from registry.exchange.sharing import PushedScene, SharedScene, list_place, push_scene

__all__ = [
    "NOT_STATED",
    "AddedScene",
    "PackedScene",
    "Place",
    "PushedScene",
    "SharedScene",
    "add_scene",
    "licence_of",
    "list_place",
    "open_place",
    "pack_scene",
    "pull_scene",
    "push_scene",
    "scene_card",
]
