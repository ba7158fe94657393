"""Add a scene to a registry: an untrusted pack, bundle folder or URL -> verified copy, registered."""

import contextlib
import re
import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

from registry.bundle import SceneBundle
from registry.errors import BundleError, SceneBusy, SceneNotFound, UsageError
from registry.exchange.card import licence_of
from registry.exchange.layout import MAX_PACK_BYTES
from registry.exchange.place import download, local_path, shown
from registry.exchange.unpacking import scratch_errors, unpack
from registry.exchange.wholefile import scratch_folder
from registry.opening import open_registry
from registry.schema import check_scene_id
from registry.store import SceneRecord, SceneRegistry

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*(::|://)")
_SCRATCH = "simrecon-add-"
_BUSY_WAIT_S = 20.0


@dataclass(frozen=True)
class AddedScene:
    """A scene that `add_scene` put into a registry, or found there."""

    record: SceneRecord
    new: bool  # false: this revision was there already, and intact
    licence: str

    @property
    def scene_id(self) -> str:
        """Return the scene's id in the registry."""
        return self.record.scene_id

    @property
    def env_id(self) -> str:
        """Return the id for `gym.make`, once `simrecon_envs` has registered the registry's scenes."""
        return f"SimRecon/{self.record.scene_id}"


def add_scene(
    source: Path | str,
    registry: SceneRegistry | None = None,
    *,
    scene_id: str | None = None,
    replace: bool = False,
    expected: tuple[str, str] | None = None,
) -> AddedScene:
    """Verify a scene from elsewhere and publish it; until it is verified, the registry is not touched.

    Args:
        source: A pack, the folder of a bundle, or the URL of a pack (any protocol of fsspec).
        registry: Where to; None for the default registry.
        scene_id: Id in the registry; None for the scene's own.
        replace: Replace a scene that has this id and another revision.
        expected: (scene id, revision) that the source must have.

    Raises:
        UsageError: There is no such source, or the id is taken by another revision.
        BundleError: The source is malformed, unsafe, damaged or too large, or is not the expected scene.
        EnvironmentMissing: A place cannot be reached, or a disk cannot be written.
    """
    registry = open_registry() if registry is None else registry
    if scene_id is not None:
        check_scene_id(scene_id)
    label = shown(str(source))
    with _bundle_of(source, label) as bundle:
        found = (bundle.scene["id"], bundle.revision)
        if expected is not None and found != expected:
            raise BundleError(
                f"{label}: holds scene {found[0]}, revision {found[1]}; expected {expected[0]}, {expected[1]}"
            )
        name = scene_id or found[0]
        with _held(registry, name):
            before = _record(registry, name)
            if before is not None and before.revision != bundle.revision and not replace:
                raise UsageError(
                    f"the registry {registry.where} has scene {name} already, with revision {before.revision}; this is "
                    f"{bundle.revision}. Add it under another id with --as NAME, or replace yours with --replace"
                )
            intact = before is not None and before.revision == bundle.revision and registry.verify(name).ok
            record = before if intact and before is not None else registry.publish(bundle.root, name)
            return AddedScene(record, not intact, licence_of(registry.load(name).scene))


@contextlib.contextmanager
def _bundle_of(source: Path | str, label: str) -> Generator[SceneBundle, None, None]:
    """Open the bundle of a source with all hashes checked, in place or in a temporary folder."""
    with contextlib.ExitStack() as stack:
        path = Path(source).expanduser() if isinstance(source, Path) or not _URL.match(source) else None
        if path is None:
            path = local_path(str(source))
            if path is None:
                with scratch_errors():
                    folder = stack.enter_context(scratch_folder(_SCRATCH))
                path = folder / "download"
                download(str(source), path, MAX_PACK_BYTES)
        if path.is_dir():
            yield SceneBundle.open(path, check_hashes=True)
            return
        if not path.exists():
            raise UsageError(f"{label}: there is no such file or folder")
        with scratch_errors():
            folder = stack.enter_context(scratch_folder(_SCRATCH))
        yield unpack(path, folder / "bundle", label)


@contextlib.contextmanager
def _held(registry: SceneRegistry, scene_id: str) -> Generator[None, None, None]:
    """Hold the lock of a scene; wait for short holders, such as another `add`."""
    end = time.monotonic() + _BUSY_WAIT_S
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(registry.hold(scene_id))
                break
            except SceneBusy:
                if time.monotonic() > end:
                    raise
                time.sleep(0.05)
        yield


def _record(registry: SceneRegistry, scene_id: str) -> SceneRecord | None:
    try:
        return registry.get(scene_id)
    except SceneNotFound:
        return None
