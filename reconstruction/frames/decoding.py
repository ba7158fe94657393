"""Decode upright RGB images: videos by PyAV, folders of photographs by Pillow.

Videos are streamed: `VideoReader.frames` yields decoded frames one by one, and frames are scaled down in the color
conversion, so that memory holds only the selected images at working resolution.
"""

import contextlib
import hashlib
import os
import re
import struct
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reconstruction.frames.tone_mapping import HLG, PQ, to_standard_range
from reconstruction.phone_exports.exports import natural
from registry.errors import EnvironmentMissing, InputError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
# By content, not by name: other formats run programs (EPS), or unpack far.
_PICTURE_FORMATS = ("JPEG", "PNG", "WEBP", "GIF", "BMP")
_FOCAL_35MM_KEYS = ("com.apple.quicktime.camera.focal_length.35mm_equivalent", "focal_length_35mm")
_DIAGONAL_35MM = 43.2666  # of a 36 x 24 mm frame, mm
_MOST_PIXELS = 64_000_000  # of a video frame, or of an image that is decoded whole
_MOST_JPEG_PIXELS = 178_000_000  # JPEG is decoded at reduced size; Pillow opens no more
_PLAYLIST_HEADS = {  # by their first bytes; ffmpeg would open the files and addresses that such a file names
    b"ffconcat": "a list of videos (ffconcat)", b"#EXTM3U": "a playlist (M3U)", b"[playlist]": "a playlist (PLS)",
    b"<SMIL": "a playlist (SMIL)", b"<?xml": "an XML file", b"<MPD": "a playlist (DASH)", b"v=0": "a session (SDP)",
}  # fmt: skip
_PLAYLIST_FORMATS = ("concat", "hls", "dash", "sdp", "imf", "webm_dash_manifest")
_EXIF_IFD, _EXIF_FOCAL_35MM = 0x8769, 0xA405


def working_size(width: int, height: int, max_side_px: int) -> tuple[int, int]:
    """Scale (width, height) so that the longer side is at most `max_side_px`; never enlarges."""
    scale = min(1.0, max_side_px / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


@dataclass
class VideoReader:
    """A video file: its metadata, and its frames in the order of decoding, as often as asked.

    `damaged_packets` counts over the latest run of `frames`. The size, `quarter_turns`, `interlaced` and
    `high_dynamic_range` are known once the first frame is decoded.
    """

    path: Path
    width: int = 0  # after pixel aspect ratio and rotation
    height: int = 0
    quarter_turns: int = 0  # counter-clockwise, from decoded to upright
    focal_35mm: float = 0.0  # 35 mm equivalent, 0 where unknown
    announced_frames: int = 0  # by the container, 0 where unknown
    nominal_fps: float = 0.0
    damaged_packets: int = 0
    interlaced: bool = False
    high_dynamic_range: bool = False
    _stored_size: tuple[int, int] = field(default=(0, 0), repr=False)

    def __post_init__(self) -> None:
        """Read the headers; raise `InputError` if this is not a video."""
        if self.path.stat().st_size == 0:
            raise InputError(f"frames: {self.path} is empty (0 bytes). Copy or record the video again.")
        self._refuse_playlist()
        with self._open() as container:
            stream = self._stream(container)
            self.announced_frames = int(stream.frames or 0)
            self.nominal_fps = float(stream.average_rate or stream.guessed_rate or 0)
            for key in _FOCAL_35MM_KEYS:
                value = container.metadata.get(key) or stream.metadata.get(key)
                if value and re.fullmatch(r"\d+(\.\d+)?", value.strip()):
                    self.focal_35mm = float(value)

    def _refuse_playlist(self) -> None:
        try:
            with self.path.open("rb") as stream:
                head = stream.read(64).removeprefix(b"\xef\xbb\xbf").lstrip()
        except PermissionError:
            return  # `_open` says so
        for start, kind in _PLAYLIST_HEADS.items():
            if head.startswith(start):
                raise InputError(
                    f"frames: {self.path} is {kind}, which only names other files. Give the video itself; "
                    "ffmpeg can join several: ffmpeg -f concat -i LIST -c copy joined.mp4"
                )

    def _open(self):
        import av.error

        try:
            # A crafted playlist must not make us read from the network.
            return av.open(str(self.path), options={"protocol_whitelist": "file,crypto,data"})
        except av.error.PermissionError as error:
            raise EnvironmentMissing(
                f"frames: permission denied to read {self.path}. Make it readable (chmod u+r) and run again."
            ) from error
        except (av.error.FFmpegError, ValueError, OSError) as error:
            raise InputError(
                f"frames: {self.path} is not a video that ffmpeg can open ({_reason(error)}). "
                "If it should be one, it was cut off or damaged while it was copied: copy it again; "
                "otherwise give a video file (mp4, mov, mkv, webm …) or a folder of jpg or png images."
            ) from error

    def _stream(self, container):
        from av.stream import Disposition

        for stream in container.streams.video:
            cover = bool(stream.disposition & Disposition.attached_pic)
            if not cover and container.format.name != "tty":  # ffmpeg decodes text files as terminal art
                if container.format.name in _PLAYLIST_FORMATS:
                    raise InputError(
                        f"frames: {self.path} is a playlist ({container.format.name}), which only names other files. "
                        "Give the video itself."
                    )
                if stream.width * stream.height > _MOST_PIXELS:
                    raise InputError(
                        f"frames: {self.path} has frames of {stream.width}x{stream.height} pixels; at most "
                        f"{_MOST_PIXELS // 1_000_000} megapixels can be read. Scale it down first."
                    )
                # Frames may grow later on.
                stream.codec_context.options = {"max_pixels": str(_MOST_PIXELS)}
                # Multi-threaded by slices and frames; the order of frames stays.
                stream.thread_type = "AUTO"
                return stream
        raise InputError(
            f"frames: {self.path} has no video track. Give a video, or a folder of jpg or png images."
        )

    def frames(self) -> Iterator[tuple[int, float, bool, object]]:
        """Yield (frame number from 0, seconds from the first frame, intact, av.VideoFrame).

        Damaged packets are skipped and counted. Frames after them are not intact up to the next intra-coded frame. The
        end of the file, early or not, ends the iteration.
        """
        import av.error

        self.damaged_packets = 0
        with self._open() as container:
            stream = self._stream(container)
            number, first, last, intact = 0, None, -1.0, True
            packets = container.demux(stream)
            while True:
                try:
                    packet = next(packets, None)
                except av.error.FFmpegError:
                    self.damaged_packets += 1
                    packet = None
                if packet is None:
                    return
                try:
                    decoded = packet.decode()
                except av.error.FFmpegError:
                    self.damaged_packets += 1
                    intact = False
                    if packet.dts is None and packet.size == 0:  # the flush itself failed
                        return
                    continue
                for frame in decoded:
                    if number == 0:
                        self._learn_geometry(frame, stream)
                    time = frame.time
                    if time is None:
                        time = (first or 0.0) + number / (self.nominal_fps or 30.0)
                    first = time if first is None else first
                    last = max(time - first, last + 1e-6)  # strictly increasing, even with broken time stamps
                    intact = (intact or frame.key_frame) and not frame.is_corrupt
                    yield number, last, intact, frame
                    number += 1

    def _learn_geometry(self, frame, stream) -> None:
        """Set size, rotation and color properties from the first decoded frame."""
        turns = round((frame.rotation or 0) / 90) % 4
        aspect = stream.sample_aspect_ratio
        wide = frame.width * (float(aspect) if aspect and 0.1 < float(aspect) < 10 else 1.0)
        self._stored_size = (round(wide), frame.height)
        self.quarter_turns = turns
        self.width, self.height = self._stored_size if turns % 2 == 0 else self._stored_size[::-1]
        self.interlaced = bool(frame.interlaced_frame)
        self.high_dynamic_range = int(frame.color_trc or 0) in (PQ, HLG)

    def to_rgb(self, frame, max_side_px: int) -> np.ndarray:
        """Convert a decoded frame to upright RGB uint8 (h, w, 3), scaled down to `max_side_px`."""
        if self.high_dynamic_range:
            return to_standard_range(self._convert(frame, max_side_px, "rgb48le"), int(frame.color_trc))
        return self._convert(frame, max_side_px, "rgb24")

    def to_gray(self, frame, max_side_px: int) -> np.ndarray:
        """Convert a decoded frame to upright gray uint8 (h, w), scaled down to `max_side_px`."""
        if self.high_dynamic_range:
            return cv2.cvtColor(self.to_rgb(frame, max_side_px), cv2.COLOR_RGB2GRAY)
        return self._convert(frame, max_side_px, "gray")

    def _convert(self, frame, max_side_px: int, pixel_format: str) -> np.ndarray:
        from av.video.reformatter import Interpolation

        width, height = working_size(*self._stored_size, max_side_px)
        # Without these, swscale drops fractions: values are 1 to 2 levels too low, of 10-bit video most.
        exact = Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
        if self.interlaced:
            # One field only: the two fields of a moving camera show different instants.
            flags = Interpolation.BICUBIC | exact
            image = frame.reformat(format=pixel_format, interpolation=flags).to_ndarray()[::2]
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        else:
            shrinks = width < frame.width or height < frame.height
            flags = (Interpolation.AREA if shrinks else Interpolation.BICUBIC) | exact
            image = frame.reformat(width, height, pixel_format, interpolation=flags).to_ndarray()
        return np.ascontiguousarray(np.rot90(image, self.quarter_turns))

    def focal_prior_px(self, max_side_px: int) -> float:
        """Return the focal length in pixels at working size, 0 where unknown."""
        width, height = working_size(self.width, self.height, max_side_px)
        return self.focal_35mm / _DIAGONAL_35MM * float(np.hypot(width, height))


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).split("\n")[0]


@dataclass
class ImageFolder:
    """A folder of photographs in natural name order (img2 before img10), resized to one size when loaded."""

    path: Path
    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    width: int = 0  # upright, of the majority of images
    height: int = 0
    focal_35mm: float = 0.0

    def __post_init__(self) -> None:
        """List the images and read their headers; keep those with the aspect ratio of the most common size."""
        files = list_images(self.path)
        sizes, focals = {}, []
        for path in files:
            header = _read_header(path)
            if isinstance(header, str):
                self.notes.append(f"{printable(path.name)} {header}: left out")
                continue
            sizes[path] = header[:2]
            if header[2] > 0:
                focals.append(header[2])
        if not sizes:
            if all("permission" in note for note in self.notes):
                raise EnvironmentMissing(
                    f"frames: permission denied to read the {len(files)} images in {self.path}. Make them readable "
                    "(chmod u+r) and run again."
                )
            raise InputError(
                f"frames: none of {len(files)} images in {self.path} can be read: {self.notes[0]}. Copy them again."
            )
        counts = Counter(sizes.values())
        self.width, self.height = max(counts, key=lambda size: (counts[size], size))
        self.focal_35mm = float(np.median(focals)) if focals else 0.0
        for path, size in sizes.items():
            if abs(size[0] / size[1] - self.width / self.height) < 0.01 * self.width / self.height:
                self.files.append(path)
            else:
                shapes = f"{size[0]}x{size[1]}, most are {self.width}x{self.height}"
                self.notes.append(f"{printable(path.name)} is {shapes}: left out (another shape)")
        resized = sum(sizes[p] != (self.width, self.height) for p in self.files)
        if resized:
            self.notes.append(f"{resized} images of other sizes are resized to {self.width}x{self.height}")

    def load_rgb(self, number: int, max_side_px: int) -> np.ndarray | None:
        """Load image `number`, upright and at working size: uint8 (h, w, 3); None and a note if its data is damaged."""
        from PIL import Image, ImageOps

        size = working_size(self.width, self.height, max_side_px)
        try:
            with _without_warnings(), Image.open(self.files[number], formats=_picture_formats()) as image:
                # JPEG can be decoded at reduced resolution.
                image.draft("RGB", (2 * max(size), 2 * max(size)))
                array = np.asarray(_to_rgb(ImageOps.exif_transpose(image)))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            self.notes.append(f"{printable(self.files[number].name)} is damaged ({error}): left out")
            return None
        shrinks = size[0] < array.shape[1]
        return cv2.resize(array, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)

    def sha256(self) -> str:
        """Return the SHA-256 of the names and contents of all images used."""
        digest = hashlib.sha256()
        for path in self.files:
            digest.update(os.fsencode(path.name) + b"\0" + bytes.fromhex(file_sha256(path)))
        return digest.hexdigest()

    def focal_prior_px(self, max_side_px: int) -> float:
        """Return the focal length in pixels at working size, 0 where unknown."""
        width, height = working_size(self.width, self.height, max_side_px)
        return self.focal_35mm / _DIAGONAL_35MM * float(np.hypot(width, height))


def list_images(folder: Path) -> list[Path]:
    """Return the jpg and png files in a folder, in natural name order.

    Raises:
        InputError: there are none.
        EnvironmentMissing: the folder may not be read.
    """
    try:
        found = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")]
    except PermissionError as error:
        raise EnvironmentMissing(
            f"frames: permission denied to read the folder {folder}. Make it readable (chmod u+rx) and run again."
        ) from error
    files = [p for p in found if p.suffix.lower() in IMAGE_SUFFIXES]
    if not files:
        others = sorted({p.suffix.lower() or "(none)" for p in found})
        raise InputError(
            f"frames: no jpg or png image in the folder {folder}"
            + (f" (it holds {', '.join(others[:6])} files)" if others else " (it is empty)")
            + ". Give a folder of jpg or png images, or a video file."
        )
    return sorted(files, key=lambda p: natural(p.name))


def _to_rgb(image):
    """Convert any Pillow mode to 8-bit RGB: transparency is composited over white, 16-bit gray is rescaled."""
    from PIL import Image

    if image.mode in ("I;16", "I;16B", "I"):
        return Image.fromarray((np.asarray(image, dtype=np.float64) / 257).astype(np.uint8)).convert("RGB")
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        layer = image.convert("RGBA")
        white = Image.new("RGBA", layer.size, (255, 255, 255, 255))
        return Image.alpha_composite(white, layer).convert("RGB")
    return image.convert("RGB")


@cache
def _picture_formats() -> tuple[str, ...]:
    """Return the formats that this build of Pillow opens."""
    from PIL import Image

    Image.init()
    return tuple(name for name in _PICTURE_FORMATS if name in Image.OPEN)


def printable(name: str) -> str:
    """Return a file name with escapes in place of bytes that are not UTF-8, and of control characters."""
    text = name.encode("utf-8", "backslashreplace").decode()
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Silence Pillow's warnings: `_read_header` has checked the size of an image, and its metadata may be odd."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _read_header(path: Path) -> tuple[int, int, float] | str:
    """Return upright width, height and 35 mm equivalent focal length (0: unknown), or why the image is left out."""
    from PIL import Image

    try:
        with _without_warnings(), Image.open(path, formats=_picture_formats()) as image:
            width, height = image.size
            most = _MOST_JPEG_PIXELS if image.format in ("JPEG", "MPO") else _MOST_PIXELS
            if width * height > most:
                return f"has {width}x{height} pixels, more than {most // 1_000_000} megapixels"
            exif = image.getexif()
            return _upright_size(width, height, exif)
    except PermissionError:
        return "may not be read (permission denied)"
    except Image.DecompressionBombError:
        return f"has more than {_MOST_JPEG_PIXELS // 1_000_000} megapixels"
    except (OSError, ValueError, SyntaxError, TypeError, LookupError, ArithmeticError, struct.error):
        return "is not a readable image"


def _upright_size(width: int, height: int, exif: Any) -> tuple[int, int, float]:
    if exif.get(0x0112, 1) in (5, 6, 7, 8):  # orientations that swap width and height
        width, height = height, width
    focal = exif.get_ifd(_EXIF_IFD).get(_EXIF_FOCAL_35MM, 0) or 0
    return width, height, float(focal) if 0 < float(focal) < 1000 else 0.0
