"""Hostile packs: each case writes one; run as a program, it tries to add each and prints what happened as JSON.

python hostile_packs.py PACK.simrecon FOLDER
"""

import hashlib
import json
import os
import resource
import stat
import struct
import sys
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

from registry import content_revision

Files = dict[str, bytes]


def read_pack(pack: Path) -> Files:
    with zipfile.ZipFile(pack) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def entry(name: str, mode: int = stat.S_IFREG | 0o644, method: int = zipfile.ZIP_STORED) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    info.create_system, info.external_attr, info.compress_type = 3, mode << 16, method
    return info


def write(path: Path, files: Iterable[tuple[str | zipfile.ZipInfo, bytes]]) -> None:
    """Write a zip file with the given entries, in order; a name may occur twice."""
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w") as archive:
        warnings.simplefilter("ignore")
        for name, data in files:
            archive.writestr(entry(name) if isinstance(name, str) else name, data)


def sealed(files: Files, **changed: bytes) -> Files:
    """Replace files of a pack (`scene` stands for scene.json), and write their true hashes into its manifest."""
    files = files | {"scene.json" if name == "scene" else name: data for name, data in changed.items()}
    manifest = json.loads(files["manifest.json"])
    manifest["files"] = {
        name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
        for name, data in files.items()
        if name not in ("README.md", "manifest.json")
    }
    return files | {"manifest.json": json.dumps(manifest).encode()}


def renamed(*names: str) -> Callable[[Path, Files], None]:
    return lambda path, files: write(path, [*files.items(), *((name, b"x") for name in names)])


def attributes(name: str, mode: int) -> Callable[[Path, Files], None]:
    return lambda path, files: write(path, [*files.items(), (entry(name, mode), b"/etc/passwd")])


def patched(change: Callable[[bytearray, int], None]) -> Callable[[Path, Files], None]:
    """Change the bytes of a good pack; `change` gets them and the offset of the end record."""

    def make(path: Path, files: Files) -> None:
        write(path, files.items())
        data = bytearray(path.read_bytes())
        change(data, len(data) - 22)
        path.write_bytes(data)

    return make


def _bomb(path: Path, files: Files) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(entry(name), data)
        with archive.open(entry("zeros.bin", method=zipfile.ZIP_DEFLATED), "w") as stream:
            for _ in range(200):
                stream.write(bytes(1 << 20))


def _overlapping(path: Path, files: Files) -> None:
    """Write 10,000 entries that all are the same 200 kB: 2 GB."""
    name, data = "a", bytes(200_000)
    head = struct.pack("<4s5H3I2H", b"PK\3\4", 20, 0, 0, 0, 33, zlib.crc32(data), len(data), len(data), 5, 0)
    local = head + b"a0000" + data
    numbers = (0x314, 20, 0, 0, 0, 33, zlib.crc32(data), len(data), len(data), 5, 0, 0, 0, 0)
    fields = struct.pack("<4s6H3I5H2I", b"PK\1\2", *numbers, (stat.S_IFREG | 0o644) << 16, 0)
    central = b"".join(fields + f"{name}{number:04d}".encode() for number in range(10_000))
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 10_000, 10_000, len(central), len(local), 0)
    path.write_bytes(local + central + end)


def _count(data: bytearray, end: int) -> None:
    struct.pack_into("<2H", data, end + 8, 65_535, 65_535)


def _directory_size(data: bytearray, end: int) -> None:
    struct.pack_into("<2I", data, end + 12, 0xFFFFFFF0, 0)


def _local_name(data: bytearray, end: int) -> None:
    at = data.index(b"\x0a\0\0\0scene.json") + 4
    data[at : at + 10] = b"../../abcd"


def _encrypted(data: bytearray, end: int) -> None:
    at = data.index(b"PK\1\2")
    data[at + 8] |= 1


def _huge_size(data: bytearray, end: int) -> None:
    at = data.index(b"PK\1\2")
    struct.pack_into("<2I", data, at + 20, 0xFFFFFFFE, 0xFFFFFFFE)


def _prefix(data: bytearray, end: int) -> None:
    data[:0] = b"#!/bin/sh\n"


def _changed(path: Path, files: Files) -> None:
    name = next(name for name in files if name.endswith(".obj"))
    write(path, (files | {name: files[name].replace(b"v 0", b"v 7", 1)}).items())


def _other_revision(path: Path, files: Files) -> None:
    manifest = json.loads(files["manifest.json"])
    manifest["revision"] = "0123456789abcdef"
    write(path, (files | {"manifest.json": json.dumps(manifest).encode()}).items())


def _moved_object(path: Path, files: Files) -> None:
    """Change a mass and all hashes, but keep the revision that a suite would trust."""
    scene = json.loads(files["scene.json"])
    scene["objects"][0]["mass_kg"] = 900.0
    scene["objects"][0].pop("ranges", None)
    write(path, sealed(files, scene=json.dumps(scene).encode()).items())


def _scene(text: bytes) -> Callable[[Path, Files], None]:
    return lambda path, files: write(path, sealed(files, scene=text).items())


def _evil_id(path: Path, files: Files) -> None:
    scene = json.loads(files["scene.json"])
    scene["id"] = "../../../tmp/evil"
    write(path, sealed(files, scene=json.dumps(scene).encode()).items())


def _reading_mesh(path: Path, files: Files) -> None:
    name = next(name for name in files if name.endswith(".glb"))
    text = json.dumps({"asset": {"version": "2.0"}, "images": [{"uri": "/etc/passwd"}]}).encode()
    text += b" " * (-len(text) % 4)
    glb = struct.pack("<5I", 0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A) + text
    files = sealed(files, **{name: glb})
    manifest, scene = json.loads(files["manifest.json"]), json.loads(files["scene.json"])
    listed = {key: (value["sha256"], value["bytes"]) for key, value in manifest["files"].items()}
    manifest["revision"] = content_revision(scene, listed)
    write(path, (files | {"manifest.json": json.dumps(manifest).encode()}).items())


def _manifest_escapes(path: Path, files: Files) -> None:
    manifest = json.loads(files["manifest.json"])
    manifest["files"]["../../evil"] = {"sha256": "0" * 64, "bytes": 1}
    write(path, (files | {"manifest.json": json.dumps(manifest).encode()}).items())


def _sparse(path: Path, files: Files) -> None:
    with path.open("wb") as stream:
        stream.truncate(5 << 30)


# {case: (how it is written, a part of the error)}
CASES: dict[str, tuple[Callable[[Path, Files], None], str]] = {
    "a path out of the folder": (renamed("../../evil.txt"), "not a plain relative path"),
    "an absolute path": (renamed("/tmp/evil.txt"), "not a plain relative path"),
    "a path of Windows": (renamed("C:\\evil.txt"), "not a plain relative path"),
    "a control character in a name": (renamed("a\x1b[2Jb"), "not a plain relative path"),
    "a C1 control character in a name": (renamed("a\x9b2Jb"), "not a plain relative path"),
    "letters that run backwards": (renamed("a\u202etxt.exe"), "not a plain relative path"),
    "a symbolic link": (attributes("link", stat.S_IFLNK | 0o777), "a link, folder or device"),
    "a device": (attributes("null", stat.S_IFCHR | 0o666), "a link, folder or device"),
    "a folder": (attributes("folder", stat.S_IFDIR | 0o755), "a link, folder or device"),
    "a name twice": (renamed("scene.json"), "two files have the name"),
    "names that differ in case": (renamed("SCENE.json"), "two files have the name"),
    "a file that is a folder": (renamed("scene.json/x"), "a folder that is a file"),
    "a compressed bomb": (_bomb, "compressed"),
    "overlapping files": (_overlapping, "overlaps"),
    "65,535 files claimed": (patched(_count), "files, expected 1 to"),
    "a list of 4 GB claimed": (patched(_directory_size), "list of files is not where"),
    "a file of 4 GB claimed": (patched(_huge_size), "does not end before"),
    "another name before the content": (patched(_local_name), "described differently"),
    "an encrypted file": (patched(_encrypted), "encrypted"),
    "bytes before the first file": (patched(_prefix), "not where"),
    "bytes after the end": (patched(lambda data, _: data.extend(b"more")), "not a zip file"),
    "cut off": (patched(lambda data, _: data.__delitem__(slice(len(data) // 2, None))), "cut off"),
    "empty": (lambda path, _: path.write_bytes(b""), "no zip file"),
    "5 GB of zeros": (_sparse, "more than 4294967295"),
    "a pipe": (lambda path, _: os.mkfifo(path), "no regular file"),
    "no manifest": (lambda path, f: write(path, [i for i in f.items() if i[0] != "manifest.json"]), "is missing"),
    "a file that the manifest does not list": (renamed("extra.bin"), "not in the manifest"),
    "a manifest that leads out": (_manifest_escapes, "not in the folder"),
    "a changed mesh": (_changed, "does not match its SHA-256"),
    "a wrong revision": (_other_revision, "is not that of the content"),
    "a changed mass under the same revision": (_moved_object, "is not that of the content"),
    "an id that is a path": (_evil_id, "id: expected a scene id"),
    "a mesh that reads other files": (_reading_mesh, "names another file"),
    "a scene of nested lists": (_scene(b"[" * 400_000), "scene.json: "),
    "a scene of 5 million lists": (_scene(b"[" + b"[]," * 5_500_000 + b"[]]"), "more than 1000000"),
    "a scene of 17 MB": (_scene(b" " * (17 << 20)), "scene.json has"),
    "a scene with NaN": (_scene(b'{"id": NaN}'), "not strict JSON"),
    "a key twice": (_scene(b'{"id": "a", "id": "b"}'), "appears twice"),
}  # fmt: skip


def main(pack: Path, folder: Path) -> None:
    """Try every case; write {case: {error, seconds, peak_mb}}."""
    from registry import SceneRegistry, SimReconError
    from registry.exchange import add_scene

    files = read_pack(pack)
    said = {}
    for number, (case, (make, _)) in enumerate(CASES.items()):
        path = folder / f"{number}.simrecon"
        registry = SceneRegistry(folder / f"registry{number}")
        make(path, files)
        reading, writing = os.pipe()
        if not (child := os.fork()):  # a process each, so that each has a peak of its own
            began = time.perf_counter()
            try:
                add_scene(path, registry)
                error = ""
            except SimReconError as reason:
                error = f"{type(reason).__name__}: {reason}"
            except BaseException as reason:
                error = f"raw {reason!r}"
            row = {"error": error, "seconds": time.perf_counter() - began}
            row["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            os.write(writing, json.dumps(row).encode()[:60_000])
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading, "rb") as stream:
            said[case] = json.loads(stream.read())
        os.waitpid(child, 0)
        said[case]["written"] = registry.root.exists()
        path.unlink()
    sys.stdout.write(json.dumps(said))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
