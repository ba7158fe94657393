"""Pack a bundle: a registered scene -> one zip file of stored entries, the same bytes for the same bundle.

README.md       the scene card; for people, never read by `add`
manifest.json   SHA-256 and size of every file below, and the revision
scene.json      and the other files of the bundle, in order of their names
"""

import hashlib
import json
import stat
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from registry.bundle import MANIFEST_FORMAT, SceneBundle, hash_file
from registry.errors import BundleError, EnvironmentMissing, UsageError
from registry.exchange.card import NOT_STATED, check_licence, scene_card
from registry.exchange.layout import CARD, MAX_PACK_BYTES, SUFFIX, check_pack_sizes
from registry.exchange.wholefile import whole_file

_CHUNK = 1 << 20


@dataclass(frozen=True)
class PackedScene:
    """A written pack."""

    path: Path
    scene_id: str
    revision: str
    files: int
    bytes: int
    sha256: str


def pack_scene(bundle: SceneBundle, path: Path | None = None, *, licence: str | None = None) -> PackedScene:
    """Write a bundle to one file, whole or not at all.

    Args:
        bundle: An opened bundle.
        path: The file; None for `<scene id>.simrecon` in the working folder. A folder gets a file of that name.
        licence: Stated in the pack and kept by who adds it; None keeps what the bundle states. The revision stays.

    Raises:
        BundleError: A file does not match its hash, or the bundle exceeds the limits of a pack.
        UsageError: The licence is empty.
        EnvironmentMissing: The file cannot be written; none is left.
    """
    name = f"{bundle.scene['id']}{SUFFIX}"
    target = Path(name) if path is None else path / name if path.is_dir() else path
    try:
        with whole_file(target) as stream:
            write_pack(bundle, stream, licence)
    except OSError as error:
        raise EnvironmentMissing(
            f"pack: cannot write {target}: {error.strerror}; choose another -o"
        ) from error
    return PackedScene(
        path=target,
        scene_id=bundle.scene["id"],
        revision=bundle.revision,
        files=len(bundle.files),
        bytes=target.stat().st_size,
        sha256=hash_file(target),
    )


def write_pack(bundle: SceneBundle, stream: IO[bytes], licence: str | None = None) -> None:
    """Write the pack of a bundle to a seekable stream; arguments and errors as for `pack_scene`."""
    scene = with_licence(bundle, licence)
    scene_text = _scene_text(bundle, scene)
    files = {**bundle.files, "scene.json": (hashlib.sha256(scene_text).hexdigest(), len(scene_text))}
    listed = {name: {"sha256": digest, "bytes": size} for name, (digest, size) in files.items()}
    manifest = {"format": MANIFEST_FORMAT, "revision": bundle.revision, "files": listed}
    made = {
        CARD: scene_card(scene, bundle.revision).encode(),
        "manifest.json": (json.dumps(manifest, indent=1, sort_keys=True) + "\n").encode(),
        "scene.json": scene_text,
    }
    others = sorted(bundle.files.keys() - made.keys())
    check_pack_sizes(
        {name: len(data) for name, data in made.items()} | {n: bundle.files[n][1] for n in others}
    )
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED, allowZip64=False) as archive:
        for name, data in made.items():
            archive.writestr(_entry(name, len(data)), data)
        for name in others:
            _copy(bundle, name, archive)
    if stream.tell() > MAX_PACK_BYTES:
        raise BundleError(f"scene {scene['id']}: its pack has more than {MAX_PACK_BYTES} bytes")


def with_licence(bundle: SceneBundle, licence: str | None) -> dict[str, Any]:
    """Return scene.json with a licence stated in `report.volatile`, which no revision depends on; None: unchanged.

    Raises:
        UsageError: The licence is empty.
    """
    if licence is None:
        return bundle.scene
    if check_licence(licence) == NOT_STATED and licence.strip() != NOT_STATED:
        raise UsageError("--licence is empty; name it, for example --licence CC-BY-4.0, or leave it out")
    report = bundle.scene["report"]
    volatile = {**(report.get("volatile") or {}), "licence": check_licence(licence)}
    return {**bundle.scene, "report": {**report, "volatile": volatile}}


def _scene_text(bundle: SceneBundle, scene: dict[str, Any]) -> bytes:
    if scene is not bundle.scene:
        text = json.dumps(scene, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False)
        return (text + "\n").encode()
    path = bundle.resolve("scene.json")
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != bundle.files["scene.json"][0]:
        raise BundleError(f"{path}: changed while it was read")
    return data


def _entry(name: str, size: int) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    entry.create_system, entry.external_attr = 3, (stat.S_IFREG | 0o644) << 16
    entry.file_size = size
    return entry


def _copy(bundle: SceneBundle, name: str, archive: zipfile.ZipFile) -> None:
    expected, size = bundle.files[name]
    digest = hashlib.sha256()
    with bundle.resolve(name).open("rb") as source, archive.open(_entry(name, size), "w") as target:
        while chunk := source.read(_CHUNK):
            digest.update(chunk)
            target.write(chunk)
    if digest.hexdigest() != expected:
        raise BundleError(
            f"scene {bundle.scene['id']}: {name} does not match its SHA-256; `simrecon verify` says more"
        )
