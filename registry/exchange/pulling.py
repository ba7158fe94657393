"""Pull a scene from a place: download, verify, publish in a registry."""

from registry.errors import SceneNotFound, UsageError
from registry.exchange.adding import AddedScene, add_scene
from registry.exchange.card import licence_of
from registry.exchange.layout import MAX_PACK_BYTES, SUFFIX
from registry.exchange.place import Place
from registry.exchange.sharing import current, pack_key, parse_wanted, revisions_of
from registry.exchange.wholefile import scratch_folder
from registry.opening import open_registry
from registry.store import SceneRegistry


def pull_scene(
    place: Place,
    wanted: str,
    registry: SceneRegistry | None = None,
    *,
    scene_id: str | None = None,
    replace: bool = False,
) -> AddedScene:
    """Download a scene, verify it and publish it in a registry. A revision that is there is not downloaded again.

    Args:
        place: Where from.
        wanted: `SCENE` (its current revision) or `SCENE@REVISION`.
        registry: Where to; None for the default registry.
        scene_id: Id in the registry; None for the scene's own.
        replace: Replace a scene that has this id and another revision.

    Raises:
        SceneNotFound: The place has no such scene or revision; names what it has.
        UsageError: The id is taken by another revision.
        BundleError: The pack is malformed, damaged, or of another scene or revision.
        EnvironmentMissing: The place cannot be reached, or a disk cannot be written.
    """
    registry = open_registry() if registry is None else registry
    name, revision = parse_wanted(wanted)
    if revision is None:
        revision = current(place, name).revision
    mine = scene_id or name
    there = _revision(registry, mine)
    if there == revision and registry.verify(mine).ok:
        return AddedScene(registry.get(mine), False, licence_of(registry.load(mine).scene))
    if there is not None and there != revision and not replace:
        raise UsageError(
            f"the registry {registry.where} has scene {mine} already, with revision {there}; {place.url} has "
            f"{revision}. Pull it under another id with --as NAME, or replace yours with --replace"
        )
    with scratch_folder("simrecon-pull-") as folder:
        pack = folder / f"{name}{SUFFIX}"
        try:
            place.fetch(pack_key(name, revision), pack, MAX_PACK_BYTES)
        except FileNotFoundError:
            raise SceneNotFound(_no_revision(place, name, revision)) from None
        return add_scene(pack, registry, scene_id=scene_id, replace=replace, expected=(name, revision))


def _revision(registry: SceneRegistry, scene_id: str) -> str | None:
    try:
        return registry.get(scene_id).revision
    except SceneNotFound:
        return None


def _no_revision(place: Place, scene_id: str, revision: str) -> str:
    known = revisions_of(place, scene_id)
    if not known:
        current(place, scene_id)  # raises with what there is
    others = ", ".join(dict.fromkeys(shared.revision for shared in reversed(known)))
    return f"{place.url} has no pack of {scene_id}, revision {revision}; its revisions, the newest first: {others}"
