"""Push scenes to a place and pull them from it, without locks, renames or a server.

    packs/<scene id>/<revision>.simrecon        a pack; its name is the hash of its content, so it never changes
    packs/<scene id>/<revision>.md              its card
    index/<scene id>/<time>-<revision>.json     "this revision was pushed at this time"; written after the pack
    README.md, catalog.json                     summaries: for people, and for HTTP mirrors that cannot list

The listing of `index/` is the index. Writers only ever add files with names of their own, so none can lose another's.
The current revision of a scene is that of its last entry by time (of the pushing machine's clock), then by revision.
"""

import datetime
import fnmatch
import json
import re
from dataclasses import dataclass
from typing import Any

from registry.bundle import SceneBundle
from registry.errors import BundleError, SceneNotFound, UsageError, did_you_mean
from registry.exchange.adding import AddedScene, add_scene
from registry.exchange.card import licence_of, scene_card, source_name
from registry.exchange.layout import MAX_PACK_BYTES, SUFFIX
from registry.exchange.pack import pack_scene, with_licence
from registry.exchange.place import Place
from registry.exchange.wholefile import scratch_folder
from registry.schema import check_scene_id
from registry.store import SceneRegistry

CATALOG = "catalog.json"
_CATALOG_FORMAT, _ENTRY_FORMAT = "simrecon.catalog/1", "simrecon.entry/1"
_SCENE = r"[a-z0-9_]{1,64}"
_KEY = re.compile(rf"(?P<scene>{_SCENE})/(?P<pushed>\d{{8}}T\d{{12}}Z)-(?P<revision>[0-9a-f]{{16}})\.json")
_WANTED = re.compile(rf"(?P<scene>{_SCENE})(@(?P<revision>[0-9a-f]{{16}}))?")
_MAX_CATALOG_BYTES, _MAX_ENTRY_BYTES = 32 << 20, 64 << 10


@dataclass(frozen=True, order=True)
class SharedScene:
    """A revision of a scene in a place."""

    scene_id: str
    pushed: str  # UTC, "20261126T081500123456Z"
    revision: str

    @property
    def pack_key(self) -> str:
        """Return the key of the pack."""
        return pack_key(self.scene_id, self.revision)

    @property
    def entry_key(self) -> str:
        """Return the key of the entry."""
        return f"index/{self.scene_id}/{self.pushed}-{self.revision}.json"


@dataclass(frozen=True)
class PushedScene:
    """Result of a push."""

    shared: SharedScene
    new: bool  # false: it was the place's current revision already
    uploaded_bytes: int


def pack_key(scene_id: str, revision: str) -> str:
    """Return the key of a pack in a place."""
    return f"packs/{scene_id}/{revision}{SUFFIX}"


def parse_wanted(text: str) -> tuple[str, str | None]:
    """Parse `SCENE` or `SCENE@REVISION`.

    Raises:
        UsageError: It is neither.
    """
    match = _WANTED.fullmatch(text)
    if match is None:
        check_scene_id(text.split("@")[0])
        raise UsageError(
            f"{text!r}: expected SCENE or SCENE@REVISION with a revision of 16 hexadecimal digits"
        )
    return match["scene"], match["revision"]


def push_scene(bundle: SceneBundle, place: Place, *, licence: str | None = None) -> PushedScene:
    """Upload a scene: its pack and card first, its entry of the index last. Killed at any moment, it is there or not.

    Args:
        bundle: An opened bundle.
        place: Where to.
        licence: As for `pack_scene`; a revision that is there already keeps its own.

    Raises:
        BundleError: A file of the bundle is damaged; nothing is uploaded.
        UsageError: The place is read-only.
        EnvironmentMissing: It cannot be reached or written.
    """
    scene_id, revision = bundle.scene["id"], bundle.revision
    known = revisions_of(place, scene_id)
    there = any(shared.revision == revision for shared in known) and place.exists(
        pack_key(scene_id, revision)
    )
    if there and known[-1].revision == revision:
        return PushedScene(known[-1], new=False, uploaded_bytes=0)
    now = datetime.datetime.now(datetime.timezone.utc).strftime("%Y%m%dT%H%M%S%fZ")
    # A clock that is behind does not hide what was pushed knowingly.
    shared = SharedScene(scene_id, max([now, *(_after(known[-1].pushed) for _ in known[-1:])]), revision)
    scene, size = with_licence(bundle, licence), 0
    if not there:
        with scratch_folder("simrecon-push-") as folder:
            packed = pack_scene(bundle, folder / f"{scene_id}{SUFFIX}", licence=licence)
            size = packed.bytes
            place.upload(shared.pack_key, packed.path)
        place.write(f"packs/{scene_id}/{revision}.md", scene_card(scene, revision).encode())
    place.write(shared.entry_key, json.dumps(_entry(scene, shared, size), indent=1, sort_keys=True).encode())
    return PushedScene(shared, new=True, uploaded_bytes=size)


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
    registry = SceneRegistry() if registry is None else registry
    name, revision = parse_wanted(wanted)
    if revision is None:
        revision = current(place, name).revision
    mine = scene_id or name
    there = _revision(registry, mine)
    if there == revision and registry.verify(mine).ok:
        return AddedScene(registry.get(mine), False, licence_of(registry.load(mine).scene))
    if there is not None and there != revision and not replace:
        raise UsageError(
            f"the registry {registry.root} has scene {mine} already, with revision {there}; {place.url} has "
            f"{revision}. Pull it under another id with --as NAME, or replace yours with --replace"
        )
    with scratch_folder("simrecon-pull-") as folder:
        pack = folder / f"{name}{SUFFIX}"
        try:
            place.fetch(pack_key(name, revision), pack, MAX_PACK_BYTES)
        except FileNotFoundError:
            raise SceneNotFound(_no_revision(place, name, revision)) from None
        return add_scene(pack, registry, scene_id=scene_id, replace=replace, expected=(name, revision))


def list_place(place: Place, pattern: str = "*") -> list[SharedScene]:
    """Return the current revision of every scene whose id matches a pattern (`*`, `?`), ordered by id.

    Reads names only: one listing request for each thousand scenes of an object store, none for packs or entries.
    """
    literal = re.split(r"[*?\[]", pattern)[0]
    if literal == pattern:
        return revisions_of(place, pattern)[-1:] if re.fullmatch(_SCENE, pattern) else []
    if (catalog := _catalog(place)) is not None:
        found = [shared for known in catalog.values() for shared in known]
    else:
        found = _parse(place.keys("index", literal))
    newest: dict[str, SharedScene] = {}
    for shared in sorted(found):
        newest[shared.scene_id] = shared
    return [shared for name, shared in newest.items() if fnmatch.fnmatchcase(name, pattern)]


def revisions_of(place: Place, scene_id: str) -> list[SharedScene]:
    """Return all pushed revisions of a scene, the current one last; one listing request."""
    if (catalog := _catalog(place)) is not None:
        return catalog.get(scene_id, [])
    return sorted(_parse(f"{scene_id}/{key}" for key in place.keys(f"index/{scene_id}")))


def current(place: Place, scene_id: str) -> SharedScene:
    """Return the current revision of a scene.

    Raises:
        SceneNotFound: The place has no such scene; names the closest.
    """
    known = revisions_of(place, scene_id)
    if known:
        return known[-1]
    names = [shared.scene_id for shared in list_place(place)]
    if not names:
        raise SceneNotFound(f"{place.url} has no scenes; push one with `simrecon push SCENE {place.url}`")
    some = ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
    raise SceneNotFound(
        f"{place.url} has no scene {scene_id!r}.{did_you_mean(scene_id, names)} There are: {some}"
    )


def read_entry(place: Place, shared: SharedScene) -> dict[str, Any]:
    """Return what the index says about a revision; {} if its entry cannot be read."""
    try:
        entry = json.loads(place.read(shared.entry_key, _MAX_ENTRY_BYTES))
    except (FileNotFoundError, BundleError, ValueError, RecursionError):
        return {}
    return entry if isinstance(entry, dict) and entry.get("format") == _ENTRY_FORMAT else {}


def write_catalog(place: Place) -> int:
    """Write catalog.json, the list of all entries for HTTP mirrors that cannot list; return the number of scenes.

    It shows the moment of its writing: write it again after pushes, once they are done.
    """
    scenes: dict[str, list[list[str]]] = {}
    for shared in sorted(_parse(place.keys("index"))):
        scenes.setdefault(shared.scene_id, []).append([shared.pushed, shared.revision])
    text = json.dumps({"format": _CATALOG_FORMAT, "scenes": scenes}, separators=(",", ":"), sort_keys=True)
    place.write(CATALOG, text.encode())
    return len(scenes)


def _catalog(place: Place) -> dict[str, list[SharedScene]] | None:
    """Return the catalog of a place that is read over HTTP; None if it has none, or can be listed."""
    if not place.read_only:
        return None
    if place.catalog is None:
        try:
            body = json.loads(place.read(CATALOG, _MAX_CATALOG_BYTES))
            rows = body["scenes"].items() if body.get("format") == _CATALOG_FORMAT else ()
            keys = [f"{name}/{pushed}-{revision}.json" for name, known in rows for pushed, revision in known]
        except FileNotFoundError:
            return None
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
            raise BundleError(f"{place.url}: {CATALOG} is damaged; push it again with --catalog") from error
        place.catalog = {}
        for shared in sorted(_parse(keys)):
            place.catalog.setdefault(shared.scene_id, []).append(shared)
    return place.catalog


def _parse(keys: Any) -> list[SharedScene]:
    """Return the entries among keys below `index/`; other files are not ours."""
    matches = (_KEY.fullmatch(key) for key in keys)
    return [SharedScene(m["scene"], m["pushed"], m["revision"]) for m in matches if m is not None]


def _entry(scene: dict[str, Any], shared: SharedScene, size: int) -> dict[str, Any]:
    return {
        "format": _ENTRY_FORMAT,
        "scene": shared.scene_id,
        "revision": shared.revision,
        "pushed": shared.pushed,
        "bytes": size or None,
        "objects": len(scene["objects"]),
        "licence": licence_of(scene),
        "video": {"name": source_name(scene), "sha256": scene["source"]["sha256"]},
    }


def _after(pushed: str) -> str:
    """Return the time one microsecond after that of an entry."""
    try:
        moment = datetime.datetime.strptime(pushed, "%Y%m%dT%H%M%S%fZ") + datetime.timedelta(microseconds=1)
    except (ValueError, OverflowError):
        return ""
    return moment.strftime("%Y%m%dT%H%M%S%fZ")


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
