# pyright: strict
"""Decide which objects of a bundle move and which are welded to another; used by the environment and the exports.

| in the bundle                         | in a simulator                        |
|---------------------------------------|---------------------------------------|
| `dynamic: false`                      | static                                |
| attached to a static object           | static                                |
| attached to a moving object           | welded to it, whatever `dynamic` says |
| everything else                       | dynamic                               |
"""

from registry.bundle import SceneBundle


def moving_ids(bundle: SceneBundle) -> set[int]:
    """Return the ids of the objects that can move, welded ones included."""
    attached = _attached(bundle)
    dynamic = {item.id: item.dynamic for item in bundle.objects}

    def root(key: int) -> int:
        while key in attached:
            key = attached[key]
        return key

    return {key for key in dynamic if dynamic.get(root(key), False)}


def welded_to(bundle: SceneBundle) -> dict[int, int]:
    """Return {id: id of the moving object that it is welded to}, from the edges of the scene graph."""
    moving = moving_ids(bundle)
    return {child: parent for child, parent in _attached(bundle).items() if parent in moving}


def _attached(bundle: SceneBundle) -> dict[int, int]:
    return {edge.child: edge.parent for edge in bundle.edges if edge.relation == "attached_to"}
