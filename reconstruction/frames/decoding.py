"""Decode upright RGB images: videos by PyAV, folders of photographs by Pillow.

Videos are streamed: `VideoReader.frames` yields decoded frames one by one, and frames are scaled down in the color
conversion, so that memory holds only the selected images at working resolution.
"""

import hashlib
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from reconstruction.frames.tone_mapping import HLG, PQ, to_standard_range
from reconstruction.phone_exports.exports import natural
from registry.errors import EnvironmentMissing, InputError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
_FOCAL_35MM_KEYS = ("com.apple.quicktime.camera.focal_length.35mm_equivalent", "focal_length_35mm")
_DIAGONAL_35MM = 43.2666  # of a 36 x 24 mm frame, mm
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
        with self._open() as container:
            stream = self._stream(container)
            self.announced_frames = int(stream.frames or 0)
            self.nominal_fps = float(stream.average_rate or stream.guessed_rate or 0)
            for key in _FOCAL_35MM_KEYS:
                value = container.metadata.get(key) or stream.metadata.get(key)
                if value and re.fullmatch(r"\d+(\.\d+)?", value.strip()):
                    self.focal_35mm = float(value)

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
        found = [p for p in self.path.iterdir() if p.is_file() and not p.name.startswith(".")]
        files = [p for p in found if p.suffix.lower() in IMAGE_SUFFIXES]
        files.sort(key=lambda p: natural(p.name))
        if not files:
            others = sorted({p.suffix.lower() or "(none)" for p in found})
            raise InputError(
                f"frames: no jpg or png image in the folder {self.path}"
                + (f" (it holds {', '.join(others[:6])} files)" if others else " (it is empty)")
                + ". Give a folder of jpg or png images, or a video file."
            )
        sizes, focals = {}, []
        for path in files:
            header = _read_header(path)
            if header is None:
                self.notes.append(f"{path.name} is not a readable image: left out")
                continue
            sizes[path] = header[:2]
            if header[2] > 0:
                focals.append(header[2])
        if not sizes:
            raise InputError(
                f"frames: none of {len(files)} images in {self.path} can be read. Copy them again."
            )
        counts = Counter(sizes.values())
        self.width, self.height = max(counts, key=lambda size: (counts[size], size))
        self.focal_35mm = float(np.median(focals)) if focals else 0.0
        for path, size in sizes.items():
            if abs(size[0] / size[1] - self.width / self.height) < 0.01 * self.width / self.height:
                self.files.append(path)
            else:
                shapes = f"{size[0]}x{size[1]}, most are {self.width}x{self.height}"
                self.notes.append(f"{path.name} is {shapes}: left out (another shape)")
        resized = sum(sizes[p] != (self.width, self.height) for p in self.files)
        if resized:
            self.notes.append(f"{resized} images of other sizes are resized to {self.width}x{self.height}")

    def load_rgb(self, number: int, max_side_px: int) -> np.ndarray | None:
        """Load image `number`, upright and at working size: uint8 (h, w, 3); None and a note if its data is damaged."""
        from PIL import Image, ImageOps

        size = working_size(self.width, self.height, max_side_px)
        try:
            with Image.open(self.files[number]) as image:
                # JPEG can be decoded at reduced resolution.
                image.draft("RGB", (2 * max(size), 2 * max(size)))
                array = np.asarray(_to_rgb(ImageOps.exif_transpose(image)))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            self.notes.append(f"{self.files[number].name} is damaged ({error}): left out")
            return None
        shrinks = size[0] < array.shape[1]
        return cv2.resize(array, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)

    def sha256(self) -> str:
        """Return the SHA-256 of the names and contents of all images used."""
        digest = hashlib.sha256()
        for path in self.files:
            digest.update(path.name.encode() + b"\0" + bytes.fromhex(file_sha256(path)))
        return digest.hexdigest()

    def focal_prior_px(self, max_side_px: int) -> float:
        """Return the focal length in pixels at working size, 0 where unknown."""
        width, height = working_size(self.width, self.height, max_side_px)
        return self.focal_35mm / _DIAGONAL_35MM * float(np.hypot(width, height))


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


def _read_header(path: Path) -> tuple[int, int, float] | None:
    """Return upright width, height and 35 mm equivalent focal length (0: unknown); None if this is no image."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            width, height = image.size
            exif = image.getexif()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    if exif.get(0x0112, 1) in (5, 6, 7, 8):  # orientations that swap width and height
        width, height = height, width
    focal = exif.get_ifd(_EXIF_IFD).get(_EXIF_FOCAL_35MM, 0) or 0
    return width, height, float(focal) if 0 < float(focal) < 1000 else 0.0
