"""Inputs with traps in them: bombs, damaged and encrypted archives, playlists, devices, folders of other things."""

import io
import json
import os
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from reconstruction.cache import digest_input
from reconstruction.frames import FramesConfig, load_frames
from reconstruction.frames.decoding import ImageFolder
from reconstruction.phone_exports.exports import find_export
from reconstruction.phone_exports.polycam import read_polycam
from reconstruction.phone_exports.record3d import read_record3d
from reconstruction.poses.importers.nerfstudio import read_transforms
from reconstruction.video_to_scene import reconstruct
from registry.errors import EnvironmentMissing, InputError, UsageError

pytestmark = pytest.mark.stage
ROOT = Path(__file__).resolve().parents[2]
GOOD = {
    "w": 160,
    "h": 120,
    "K": [100, 0, 0, 0, 100, 0, 80, 60, 1],
    "poses": [[0, 0, 0, 1, 0.1 * k, 0, 0] for k in range(12)],
}


def png(width: int, height: int) -> bytes:
    """Return a PNG file that announces a size, and holds a thousand zeros."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(bytes(1000)))
        + chunk(b"IEND", b"")
    )


def gif(width: int, height: int) -> bytes:
    """Return a GIF file that announces a size, with one small image."""
    screen = struct.pack("<HHBBB", width, height, 0x80, 0, 0) + bytes(6)
    image = b"," + struct.pack("<HHHHB", 0, 0, width, height, 0) + b"\x02\x02\x44\x01\x00;"
    return b"GIF89a" + screen + image


def photo(seed: int = 0) -> bytes:
    out = io.BytesIO()
    pixels = np.random.default_rng(seed).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(out, "JPEG")
    return out.getvalue()


def r3d(path: Path, metadata: bytes | dict = GOOD, images: int = 12) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", metadata if isinstance(metadata, bytes) else json.dumps(metadata))
        for number in range(images):
            archive.writestr(f"rgb/{number}.jpg", photo(number))
    return path


def read_r3d(path: Path) -> object:
    export = find_export(path)
    assert export is not None
    read_record3d(export)
    return load_frames(path, FramesConfig())


def test_the_archive_that_the_others_are_made_from_is_read(tmp_path: Path) -> None:
    export = find_export(r3d(tmp_path / "a.r3d"))
    assert export is not None
    assert len(read_record3d(export).named) == 12
    assert len(list(export.unpack_images(tmp_path).glob("*.jpg"))) == 12


METADATA: dict[str, bytes | dict] = {
    "no JSON": b"{",
    "nested": b"[" * 100_000,
    "a list": b"[]",
    "not UTF-8": b"\xff\xfe\x00",
    "no poses": {key: value for key, value in GOOD.items() if key != "poses"},
    "words for poses": GOOD | {"poses": "x"},
    "six numbers": GOOD | {"poses": [[0] * 6] * 12},
    "words for numbers": GOOD | {"poses": [["x"] * 7] * 12},
    "NaN": GOOD | {"poses": [[0, 0, 0, 1, float("nan"), 0, k] for k in range(12)]},
    "infinity": GOOD | {"poses": [[0, 0, 0, 1, float("inf"), 0, k] for k in range(12)]},
    "large places": GOOD | {"poses": [[0, 0, 0, 1, 1e30, 0, k] for k in range(12)]},
    "no rotation": GOOD | {"poses": [[0, 0, 0, 0, 0, 0, k] for k in range(12)]},
    "no width": GOOD | {"w": 0},
    "endless width": GOOD | {"w": float("inf")},
    "width below zero": GOOD | {"w": -160},
    "no focal length": GOOD | {"K": [0] * 9},
    "NaN for a focal length": GOOD | {"K": [float("nan"), 0, 0, 0, 1, 0, 0, 0, 1]},
    "a short lens": GOOD | {"K": [1, 2]},
    "words for a lens": GOOD | {"perFrameIntrinsicCoeffs": "abc"},
    "one number for a lens": GOOD | {"perFrameIntrinsicCoeffs": [1]},
    "a short lens a frame": GOOD | {"perFrameIntrinsicCoeffs": [[1, 2]]},
}


@pytest.mark.parametrize("name", METADATA)
def test_a_recording_with_bad_numbers_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"metadata in .*a\.r3d"):
        read_r3d(r3d(tmp_path / "a.r3d", METADATA[name]))


def test_names_without_a_number_have_no_pose(tmp_path: Path) -> None:
    path = r3d(tmp_path / "a.r3d")
    with zipfile.ZipFile(path, "a") as archive:
        for name in ("rgb/x.jpg", "rgb/-1.jpg", "rgb/" + "9" * 5000 + ".jpg", "rgb/².jpg"):
            archive.writestr(name, photo())
    export = find_export(path)
    assert export is not None
    assert len(read_record3d(export).named) == 12


def _encrypt(path: Path) -> None:
    """Set the flag of encryption on every member."""
    data = bytearray(path.read_bytes())
    for head, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.find(head)
        while at >= 0:
            data[at + offset] |= 1
            at = data.find(head, at + 4)
    path.write_bytes(data)


def _spoil(path: Path) -> None:
    """Change bytes in the middle of the data, under the checksums."""
    data = bytearray(path.read_bytes())
    at = data.find(b"rgb/3.jpg") + 2000
    data[at : at + 20] = bytes(20)
    path.write_bytes(data)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _odd_compression(path: Path) -> None:
    data = bytearray(path.read_bytes())
    for head, offset in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        at = data.find(head)
        while at >= 0:
            data[at + offset] = 97
            at = data.find(head, at + 4)
    path.write_bytes(data)


def _no_directory(path: Path) -> None:
    data = path.read_bytes()
    at = data.find(b"PK\x01\x02")
    path.write_bytes(data[:at] + bytes(46) + data[at + 46 :])


def _bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("metadata", json.dumps(GOOD))
        for number in range(4):
            archive.writestr(f"rgb/{number}.jpg", bytes(100 << 20))


def _metadata_bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("metadata", b" " * (40 << 20))
        archive.writestr("rgb/0.jpg", photo())


ARCHIVES: dict[str, tuple[Callable[[Path], None], str]] = {
    "encrypted": (_encrypt, "is encrypted: export it without a password"),
    "bad checksum": (_spoil, r"rgb/3\.jpg in it is damaged"),
    "cut": (_cut, "only a part of one: copy it again"),
    "a compression nobody has": (_odd_compression, "damaged or missing"),
    "no directory": (_no_directory, "damaged zip file"),
    "images that unpack far": (_bomb, "its 4 images unpack to 0.4 GB"),
    "metadata that unpacks far": (_metadata_bomb, "larger than 32 MB"),
    "text": (lambda path: path.write_text("hello"), "is no recording of Record3D"),
}


@pytest.mark.parametrize("name", ARCHIVES)
def test_a_damaged_or_hostile_archive_is_refused(name: str, tmp_path: Path) -> None:
    make, says = ARCHIVES[name]
    path = r3d(tmp_path / "a.r3d")
    make(path)
    with pytest.raises(InputError, match=says):
        read_r3d(path)


CAMERA = {f"t_{i}{j}": float(i == j) for i in range(3) for j in range(4)} | {
    "fx": 100, "fy": 100, "cx": 80, "cy": 60, "width": 160, "height": 120,
}  # fmt: skip


@pytest.mark.parametrize(
    "change",
    [
        {"fx": "x"},
        {"fx": float("nan")},
        {"fx": 0},
        {"width": float("inf")},
        {"width": -1},
        {"t_00": 5},
        {"t_03": None},
    ],
)
def test_polycam_with_bad_numbers_is_refused(change: dict, tmp_path: Path) -> None:
    for folder in ("images", "cameras"):
        (tmp_path / "keyframes" / folder).mkdir(parents=True)
    for number in range(3):
        (tmp_path / "keyframes" / "images" / f"{number}.jpg").write_bytes(photo())
        (tmp_path / "keyframes" / "cameras" / f"{number}.json").write_text(json.dumps(CAMERA | change))
    export = find_export(tmp_path)
    assert export is not None
    with pytest.raises(InputError, match=r"keyframes/cameras/0\.json"):
        read_polycam(export)


FRAME = {"file_path": "0.jpg", "transform_matrix": np.eye(4).tolist()}
LENS = {"w": 160, "h": 120, "fl_x": 100}


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "[]",
        "3",
        json.dumps({**LENS, "frames": 3}),
        json.dumps({**LENS, "frames": [3]}),
        json.dumps({**LENS, "frames": [{**FRAME, "file_path": 3}]}),
        json.dumps({**LENS, "w": float("inf"), "frames": [FRAME]}),
        json.dumps({**LENS, "h": 0, "frames": [FRAME]}),
        json.dumps({**LENS, "fl_x": float("nan"), "frames": [FRAME]}),
        json.dumps({**LENS, "k3": "x", "frames": [FRAME]}),
        json.dumps({"w": 160, "h": 120, "camera_angle_x": 0, "frames": [FRAME]}),
        json.dumps({**LENS, "frames": [{**FRAME, "transform_matrix": [[float("nan")] * 4] * 4}]}),
    ],
    ids=range(12),
)
def test_transforms_with_bad_numbers_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(UsageError, match=r"transforms\.json (is not a usable|has)"):
        read_transforms(tmp_path / "transforms.json")


PLAYLISTS = {
    "ffconcat": (b"ffconcat version 1.0\nfile 'secret.gif'\n", r"a list of videos \(ffconcat\)"),
    "M3U": (b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nsecret.gif\n", r"a playlist \(M3U\)"),
    "DASH": (b'<?xml version="1.0"?><MPD></MPD>', "an XML file"),
    "SDP": (b"v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\n", r"a session \(SDP\)"),
}


@pytest.mark.parametrize("name", PLAYLISTS)
@pytest.mark.parametrize("suffix", [".mp4", ".txt"])
def test_a_list_of_other_files_is_not_followed(name: str, suffix: str, tmp_path: Path) -> None:
    images = [Image.open(io.BytesIO(photo(k))) for k in range(12)]
    images[0].save(tmp_path / "secret.gif", save_all=True, append_images=images[1:])
    data, says = PLAYLISTS[name]
    path = tmp_path / f"film{suffix}"
    path.write_bytes(data)
    with pytest.raises(InputError, match=f"{says}, which only names other files"):
        load_frames(path, FramesConfig())


def test_a_gif_of_a_huge_size_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    (tmp_path / "film.gif").write_bytes(gif(65_000, 65_000))
    with pytest.raises(InputError, match=r"film\.gif"):
        load_frames(tmp_path / "film.gif", FramesConfig())


def test_pictures_of_a_huge_size_are_left_out_unread(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.jpg").write_bytes(photo(number))
    (tmp_path / "8.png").write_bytes(png(9000, 9000))
    (tmp_path / "9.png").write_bytes(png(60_000, 60_000))
    (tmp_path / "a.jpg").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n")
    folder = ImageFolder(tmp_path)
    assert [file.name for file in folder.files] == ["0.jpg", "1.jpg", "2.jpg"]
    assert folder.notes[0] == "8.png has 9000x9000 pixels, more than 64 megapixels: left out"
    assert "megapixels" in folder.notes[1]
    assert folder.notes[2] == "a.jpg is not a readable image: left out"


def test_bombs_stay_within_memory(tmp_path: Path) -> None:
    """All at once in a process of its own, which may not take 500 MB more than it has after imports."""
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number in range(3):
        (pictures / f"{number}.png").write_bytes(png(60_000, 60_000))
    (tmp_path / "film.gif").write_bytes(gif(65_000, 65_000))
    _bomb(tmp_path / "a.r3d")
    _metadata_bomb(tmp_path / "b.r3d")
    code = (
        "import resource, sys; from pathlib import Path; from reconstruction.frames import load_frames, FramesConfig\n"
        "from registry.errors import InputError\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "for name in sys.argv[1:]:\n"
        "    try: load_frames(Path(name), FramesConfig()); raise SystemExit(name)\n"
        "    except InputError: pass\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    names = [str(tmp_path / name) for name in ("pictures", "film.gif", "a.r3d", "b.r3d")]
    done = subprocess.run(
        [sys.executable, "-c", code, *names], capture_output=True, text=True, cwd=ROOT, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 500_000  # kB


def test_a_folder_of_other_things_is_refused_before_it_is_read(tmp_path: Path) -> None:
    started = time.perf_counter()
    with pytest.raises(InputError, match=r"no jpg or png image in the folder /usr"):
        reconstruct(Path("/usr"), registry_root=tmp_path / "registry")
    assert time.perf_counter() - started < 2
    assert not (tmp_path / "registry").exists()


@pytest.mark.parametrize("kind", ["pipe", "device", "nothing"])
def test_what_is_no_file_is_refused(kind: str, tmp_path: Path) -> None:
    path = {"pipe": tmp_path / "pipe", "device": Path("/dev/zero"), "nothing": tmp_path / "nothing"}[kind]
    if kind == "pipe":
        os.mkfifo(path)
    with pytest.raises(UsageError, match=r"is a device or a pipe|no such file or folder"):
        reconstruct(path, registry_root=tmp_path / "registry")


@pytest.mark.parametrize("where", ["video", "registry_root", "work_dir"])
def test_a_path_that_is_not_utf8_is_refused_at_the_start(where: str, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"caf\xe9")
    (tmp_path / "film.mp4").write_bytes(b"x")
    odd.write_bytes(b"x")
    arguments = {"video": tmp_path / "film.mp4", "registry_root": tmp_path / "r"} | {where: odd}
    with pytest.raises(UsageError, match=r"caf\\udce9: this name is not UTF-8. Rename"):
        reconstruct(arguments.pop("video"), **arguments)
    assert not (tmp_path / "r").exists()


def test_images_with_names_that_are_not_utf8_are_read(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / os.fsdecode(b"caf\xe9%d.jpg" % number)).write_bytes(photo(number))
    (tmp_path / os.fsdecode(b"caf\xe9.png")).write_bytes(b"x")
    folder = ImageFolder(tmp_path)
    assert len(folder.files) == 3
    assert folder.notes == ["caf\\udce9.png is not a readable image: left out"]
    assert len(folder.sha256()) == len(digest_input(tmp_path)) == 64


@contextmanager
def without_rights(path: Path) -> Iterator[None]:
    """Take away the right to read a file or folder, also from root."""
    path.chmod(0)
    root = os.geteuid() == 0
    if root:
        for parent in path.parents:
            if parent.stat().st_uid == 0 and parent not in (Path("/"), Path("/tmp")):
                parent.chmod(parent.stat().st_mode | 0o055)
        os.seteuid(65_534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


@pytest.mark.parametrize("kind", ["video", "images", "folder", "archive"])
def test_a_missing_permission_is_not_called_damage(kind: str, tmp_path: Path) -> None:
    from reconstruction.frames.load import check_input

    path = tmp_path / {"video": "film.mp4", "archive": "a.r3d"}.get(kind, "photos")
    if kind == "archive":
        r3d(path)
    elif kind == "video":
        path.write_bytes(b"x")
    else:
        path.mkdir()
        (path / "0.jpg").write_bytes(photo())

    def read() -> None:
        check_input(path)
        load_frames(path, FramesConfig())

    denied = path / "0.jpg" if kind == "images" else path
    with without_rights(denied), pytest.raises(EnvironmentMissing) as caught:
        read()
    assert "ermission denied" in str(caught.value)
    assert "damaged" not in str(caught.value)
