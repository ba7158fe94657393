"""Push scenes to a place and list them, without locks, renames or a server.

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
from registry.errors import BundleError, EnvironmentMissing, SceneNotFound, UsageError, did_you_mean
from registry.exchange.card import licence_of, scene_card, source_name
from registry.exchange.layout import SUFFIX
from registry.exchange.pack import pack_scene, with_licence
from registry.exchange.place import Place
from registry.exchange.wholefile import scratch_folder
from registry.index_rows import SceneRow, row_of, row_of_scene
from registry.schema import SCHEMA, check_scene_id

CATALOG = "catalog.json"
_CATALOG_FORMAT, _ENTRY_FORMAT = "simrecon.catalog/1", "simrecon.entry/1"
_SCENE = r"[a-z0-9_]{1,64}"
_KEY = re.compile(rf"(?P<scene>{_SCENE})/(?P<pushed>\d{{8}}T\d{{12}}Z)-(?P<revision>[0-9a-f]{{16}})\.json")
_WANTED = re.compile(rf"(?P<scene>{_SCENE})(@(?P<revision>[0-9a-f]{{16}}))?")
_MAX_CATALOG_BYTES, _MAX_ENTRY_BYTES, _MAX_ROW_BYTES = 32 << 20, 64 << 10, 48 << 10
_TRIES = 10


@dataclass(frozen=True, order=True)
class SharedScene:
    """A revision of a scene in a place."""

    scene_id: str
    pushed: str  # UTC, "20261126T081500123456Z"
    revision: str

    @property
    def pushed_utc(self) -> str:
        """Return the time as ISO 8601, "2026-11-26T08:15:00+00:00"."""
        p = self.pushed
        return f"{p[:4]}-{p[4:6]}-{p[6:8]}T{p[9:11]}:{p[11:13]}:{p[13:15]}+00:00"

    @property
    def pack_key(self) -> str:
        """Return the key of the pack."""
        return pack_key(self.scene_id, self.revision)

    @property
    def entry_key(self) -> str:
        """Return the key of the entry."""
        return f"index/{self.scene_id}/{self.pushed}-{self.revision}.json"

    @property
    def card_key(self) -> str:
        """Return the key of the card."""
        return f"packs/{self.scene_id}/{self.revision}.md"


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
    shared = SharedScene(scene_id, max([now, *(after(known[-1].pushed) for _ in known[-1:])]), revision)
    scene, size = with_licence(bundle, licence), 0
    for _ in range(_TRIES):
        if not there:
            with scratch_folder("simrecon-push-") as folder:
                packed = pack_scene(bundle, folder / f"{scene_id}{SUFFIX}", licence=licence)
                size = packed.bytes
                place.upload(shared.pack_key, packed.path)
            place.write(shared.card_key, scene_card(scene, revision).encode())
        write_entry(place, scene, shared, size)
        # `RemoteRegistry.remove` may have deleted the pack before it could see the entry, or both since.
        there = place.exists(shared.pack_key)
        if there or not place.exists(shared.entry_key):
            return PushedScene(shared, new=True, uploaded_bytes=size)
    raise EnvironmentMissing(f"{place.url}: somebody removes {scene_id} while it is pushed; run it again")


def write_entry(place: Place, scene: dict[str, Any], shared: SharedScene, size: int) -> None:
    """Write the entry that makes a pack visible.

    Args:
        place: Where the pack is.
        scene: Content of its scene.json.
        shared: What the entry says.
        size: Bytes of the pack; 0 if they are not known.
    """
    entry = {
        "format": _ENTRY_FORMAT,
        "scene": shared.scene_id,
        "revision": shared.revision,
        "pushed": shared.pushed,
        "bytes": size or None,
        "objects": len(scene["objects"]),
        "licence": licence_of(scene),
        "video": {"name": source_name(scene), "sha256": scene["source"]["sha256"]},
    }
    row = vars(row_of_scene(scene, shared.revision, shared.scene_id, shared.pushed_utc))
    if len(json.dumps(row)) <= _MAX_ROW_BYTES:
        entry["row"] = row
    place.write(shared.entry_key, json.dumps(entry, indent=1, sort_keys=True).encode())


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


def entries_of(place: Place) -> list[SharedScene]:
    """Return all pushed revisions of all scenes, ordered by id and time."""
    return sorted(_parse(place.keys("index")))


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
        return _parse_entry(place.read(shared.entry_key, _MAX_ENTRY_BYTES))
    except (FileNotFoundError, BundleError):
        return {}


def read_rows(place: Place, shared: list[SharedScene]) -> tuple[list[SceneRow], list[str]]:
    """Read the entries of revisions, many at once, as rows of an index of scenes.

    Entries that older versions wrote have no figures of physics: their rows have the status "unchecked".

    Returns:
        The valid rows, and one line about each entry that is malformed. Entries that were removed meanwhile are
        left out.
    """
    rows: list[SceneRow] = []
    problems: list[str] = []
    found = place.read_many([one.entry_key for one in shared], _MAX_ENTRY_BYTES)
    for one, data in zip(shared, found, strict=True):
        try:
            rows.append(_row(_parse_entry(data or b""), one))
        except (BundleError, KeyError, TypeError, ValueError) as error:
            if data is None and not place.exists(one.entry_key):
                continue
            said = str(error) if isinstance(error, BundleError) else "it is malformed"
            problems.append(f"scene {one.scene_id}: its entry {one.entry_key}: {said}; push it again")
    return rows, problems


def _parse_entry(data: bytes) -> dict[str, Any]:
    try:
        entry = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return entry if isinstance(entry, dict) and entry.get("format") == _ENTRY_FORMAT else {}


def _row(entry: dict[str, Any], shared: SharedScene) -> SceneRow:
    video = entry["video"]
    plain = {
        "schema_version": SCHEMA,
        "source_file": video["name"],
        "source_sha256": video["sha256"],
        "n_objects": entry["objects"],
        "status": "unchecked",
        "metrics": {},
    }
    said = plain | entry.get("row", {})
    names = ("schema_version", "source_file", "source_sha256", "n_objects", "status")
    version, file, digest, count, status = (said[name] for name in names)
    metrics = json.dumps(said["metrics"])
    # Scene, revision and time are those of the entry's name.
    return row_of(
        (shared.scene_id, shared.revision, version, shared.pushed_utc, file, digest, count, status, metrics)
    )


def write_catalog(place: Place) -> int:
    """Write catalog.json, the list of all entries for HTTP mirrors that cannot list; return the number of scenes.

    It shows the moment of its writing: write it again after pushes, once they are done.
    """
    scenes: dict[str, list[list[str]]] = {}
    for shared in entries_of(place):
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


def after(pushed: str) -> str:
    """Return the time one microsecond after that of an entry."""
    try:
        moment = datetime.datetime.strptime(pushed, "%Y%m%dT%H%M%S%fZ") + datetime.timedelta(microseconds=1)
    except (ValueError, OverflowError):
        return ""
    return moment.strftime("%Y%m%dT%H%M%S%fZ")
