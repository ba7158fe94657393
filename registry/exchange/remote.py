"""A registry at an address of fsspec: a place that many machines publish to, with a copy of what this machine opened.

The place is the registry: its index is the listing of `index/` (registry/exchange/sharing.py), which every look-up asks
for. The copy is a registry in a folder. It holds the bundles that were published or opened here, rows that need not be
read again, and the locks of this machine. It may be deleted at any time.

    ids/<scene id>      an automatic id that somebody was given; it is not given again
"""

import contextlib
import datetime
import json
import socket
from collections.abc import Generator
from pathlib import Path

from registry.bundle import SceneBundle
from registry.errors import BundleError, SceneBusy, SceneNotFound
from registry.exchange.layout import MAX_PACK_BYTES, SUFFIX
from registry.exchange.place import open_place
from registry.exchange.sharing import (
    SharedScene,
    entries_of,
    list_place,
    pack_key,
    push_scene,
    read_rows,
    revisions_of,
    write_entry,
)
from registry.exchange.unpacking import unpack
from registry.exchange.wholefile import scratch_folder
from registry.files import write_whole
from registry.index_rows import SceneRow, is_revision
from registry.schema import check_scene_id, is_scene_id
from registry.store import (
    Names,
    Records,
    SceneRecord,
    SceneRegistry,
    VerifyReport,
    highest_number,
    scene_name,
)

_IDS = "ids"
_TRIES = 10
_LISTED = "listed.json"  # in the copy


class RemoteRegistry(SceneRegistry):
    """All scenes of a place. Look-ups ask the place; bundles are copied to this machine when they are opened.

    Methods as of `SceneRegistry`; each also raises EnvironmentMissing where the place cannot be reached, and
    those that write raise UsageError where it is read-only.
    """

    def __init__(self, root: Path, address: str) -> None:
        super().__init__(root)
        self.address = address
        self.place = open_place(address)

    @property
    def where(self) -> str:
        """Return the address."""
        return self.address

    def list_with_problems(self) -> tuple[Records, Names]:
        """Return all scenes, and one line about each malformed entry of the place."""
        rows, problems = self._rows(self._list())
        return [self._record(row) for row in rows], problems

    def revisions(self, ordered: bool = True, known_only: bool = False) -> dict[str, str]:
        """Return {scene id: current revision}; with `known_only` of the last list that this machine asked for."""
        if known_only:
            return self._listed_before()
        return {shared.scene_id: shared.revision for shared in self._list()}

    def get(self, scene_id: str) -> SceneRecord:
        """Return the record of a scene; one listing request, and one entry unless it was read before."""
        while known := revisions_of(self.place, check_scene_id(scene_id)):
            rows, problems = self._rows(known[-1:])
            if problems:
                raise BundleError(problems[0])
            if rows:  # otherwise the entry was removed since it was listed
                return self._record(rows[0])
        raise SceneNotFound(self._not_found(scene_id))

    def load(self, scene_id: str, check_hashes: bool = False) -> SceneBundle:
        """Open the current revision of a scene; download it if this machine has no copy."""
        while True:
            record = self.get(scene_id)
            try:
                return SceneBundle.open(record.path, check_hashes)
            except BundleError:  # absent or damaged here
                with self._downloaded(scene_id, record.revision) as bundle:
                    super().publish(bundle.root, scene_id)
            try:
                return SceneBundle.open(record.path, check_hashes)
            except BundleError:  # another process opened a newer one, and removed this copy
                if self.get(scene_id).revision == record.revision:
                    raise

    def verify(self, scene_id: str) -> VerifyReport:
        """Download a scene and check it as `SceneRegistry.verify` does; the copy on this machine is not looked at."""
        record = self.get(scene_id)
        try:
            with self._downloaded(scene_id, record.revision) as bundle:
                sizes = [size for _, size in bundle.files.values()]
                return VerifyReport(scene_id, record.revision, True, (), len(sizes), sum(sizes))
        except BundleError as error:
            return VerifyReport(scene_id, record.revision, False, (str(error),), 0, 0)

    def publish(self, staging: Path, scene_id: str) -> SceneRecord:
        """Publish a copy of a sealed bundle on this machine, then in the place: whole or not at all.

        Of machines that publish one scene at the same time the last one wins; the place keeps all revisions.

        Raises:
            SceneBusy: Other processes of this machine replaced it each time before it could be pushed.
        """
        for _ in range(_TRIES):
            record = super().publish(staging, scene_id)
            try:
                bundle = SceneBundle.open(record.path, check_hashes=False)
            except BundleError:  # another process published another revision, and removed this one
                continue
            push_scene(bundle, self.place)  # while it is open, no other process removes it
            return record
        raise SceneBusy(
            f"scene {scene_id}: other processes of this machine publish it all the time; run it again"
        )

    def remove(self, scene_id: str) -> None:
        """Remove a scene with all its revisions from the place, and its copy: entries first, then packs.

        A scene that is pushed meanwhile is there as a whole afterwards, or not at all.
        """
        known = revisions_of(self.place, check_scene_id(scene_id))
        if not known:
            raise SceneNotFound(self._not_found(scene_id))
        while known:
            self.place.remove([shared.entry_key for shared in known])
            keys = [key for key in self.place.keys(f"packs/{scene_id}") if key.endswith(SUFFIX)]
            packs = {key.removesuffix(SUFFIX) for key in keys} | {shared.revision for shared in known}
            pushed = {shared.revision for shared in revisions_of(self.place, scene_id)}
            doomed = [SharedScene(scene_id, "", name) for name in packs - pushed if is_revision(name)]
            self.place.remove([key for shared in doomed for key in (shared.pack_key, shared.card_key)])
            # Entries that came since name packs that are gone; who wrote them looks for the pack, too.
            gone = {shared.revision for shared in doomed}
            known = [shared for shared in revisions_of(self.place, scene_id) if shared.revision in gone]
        if self._index.has(scene_id):
            super().remove(scene_id)

    def rebuild(self) -> tuple[Records, Names]:
        """Download and check every pack; write entries for packs of scenes that have none.

        The last written of several packs of such a scene becomes current. A pack without an entry, of a scene that has
        others, is the rest of a killed push, and stays unseen.
        """
        keys = [key for key in self.place.keys("packs") if key.endswith(SUFFIX)]
        packs = {tuple(key.removesuffix(SUFFIX).split("/")) for key in keys}
        packs = sorted(p for p in packs if len(p) == 2 and is_scene_id(p[0]) and is_revision(p[1]))
        entries = {(shared.scene_id, shared.revision) for shared in entries_of(self.place)}
        lost = sorted(entries - set(packs))
        problems = [f"scene {scene}: the pack of its revision {revision} is gone" for scene, revision in lost]
        listed = {scene for scene, _ in entries}
        for scene, revision in packs:
            try:
                with self._downloaded(scene, revision) as bundle:
                    if scene not in listed:
                        written = self.place.modified_s(pack_key(scene, revision))
                        moment = datetime.datetime.fromtimestamp(written, datetime.timezone.utc)
                        shared = SharedScene(scene, moment.strftime("%Y%m%dT%H%M%S%fZ"), revision)
                        write_entry(self.place, bundle.scene, shared, 0)
            except BundleError as error:
                problems.append(f"scene {scene}: {error}")
        records, malformed = self.list_with_problems()
        return records, problems + malformed

    @contextlib.contextmanager
    def reserve_next_id(self) -> Generator[str, None, None]:
        """Choose the next free id and write it down in the place; it is never given again, published or not."""
        number = self._highest_number() + 1
        while True:
            scene_id = scene_name(number)
            if self.place.create(f"{_IDS}/{scene_id}", socket.gethostname().encode()):
                with self.hold(scene_id):
                    yield scene_id
                return
            number += 1

    # ---- What the methods of SceneRegistry use.

    def _rows(self, shared: list[SharedScene]) -> tuple[list[SceneRow], Names]:
        """Return the rows of revisions, ordered by id, from the copy's index or from the place."""
        one = self._valid_row(shared[0].scene_id) if len(shared) == 1 else None
        stored = [one] if one is not None else self._index.rows() if len(shared) > 1 else []
        known = {row.scene_id: row for row in stored}
        unknown = [s for s in shared if s.scene_id not in known or known[s.scene_id].revision != s.revision]
        rows, problems = read_rows(self.place, unknown)
        if rows:
            self._index.put(*rows)
            known |= {row.scene_id: row for row in rows}
        bad = {s.scene_id for s in unknown} - {row.scene_id for row in rows}
        return [known[s.scene_id] for s in shared if s.scene_id not in bad], problems

    @contextlib.contextmanager
    def _downloaded(self, scene_id: str, revision: str) -> Generator[SceneBundle, None, None]:
        """Download a pack to a temporary folder, unpacked and checked."""
        with scratch_folder("simrecon-open-") as folder:
            try:
                self.place.fetch(pack_key(scene_id, revision), folder / "pack", MAX_PACK_BYTES)
            except FileNotFoundError:
                raise BundleError(
                    f"{self.place.url}: the pack of {scene_id}, revision {revision} is gone"
                ) from None
            bundle = unpack(
                folder / "pack", folder / "bundle", f"{self.place.url}/{pack_key(scene_id, revision)}"
            )
            if (bundle.scene["id"], bundle.revision) != (scene_id, revision):
                raise BundleError(
                    f"{self.place.url}: the pack of {scene_id}, revision {revision} holds another scene"
                )
            yield bundle

    def _list(self) -> list[SharedScene]:
        """Ask for the current revisions of all scenes, ordered by id; keep them for `known_only`."""
        found = list_place(self.place)
        listed = {shared.scene_id: shared.revision for shared in found}
        if listed != self._listed_before():
            with contextlib.suppress(OSError):  # only the next import would use it
                write_whole(self.root / _LISTED, json.dumps(listed).encode())
        return found

    def _listed_before(self) -> dict[str, str]:
        try:
            listed = json.loads((self.root / _LISTED).read_bytes())
        except (OSError, ValueError):
            return {}
        listed = listed if isinstance(listed, dict) else {}
        return {key: value for key, value in listed.items() if is_scene_id(key) and is_revision(value)}

    def _known_ids(self) -> Names:
        return [shared.scene_id for shared in self._list()]

    def _highest_number(self) -> int:
        return highest_number([*self._known_ids(), *self.place.keys(_IDS)])

    def _create_index(self) -> None:
        self._index.create()  # nothing is lost with the copy's index
