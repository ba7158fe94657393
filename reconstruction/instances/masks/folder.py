"""Masks from a folder with one id image per frame, made by any tool."""

import re
from pathlib import Path

import cv2
import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import Camera, DepthMaps, PosedFrames
from reconstruction.frames.decoding import ImageFolder
from reconstruction.instances.masks.base import FrameMasks
from registry.errors import UsageError

_ASPECT_TOLERANCE = 0.01  # relative
_MAX_COLORS = 2000  # more colors are a photograph, or masks blended at their borders
_OPTION = "instances.masks_path"


class FolderMasks:
    """A `MaskBackend` that reads id images, matched to frames by file name."""

    name = "folder"

    def __init__(self, folder: Path) -> None:
        """List the id images.

        Raises:
            UsageError: there is no such folder, or no PNG in it.
        """
        self.folder = folder
        self._files = _id_images(folder)

    def frame_masks(self, posed: PosedFrames, depth: DepthMaps, *, progress: Progress) -> FrameMasks:
        """Return the masks of all frames with a known camera and an id image, held-out frames too.

        An id image covers its whole frame, at any resolution. It is named `<video frame number>.png`, or like the image
        that it belongs to where the input is a folder of images.

        Raises:
            UsageError: no id image matches a frame, or a file is not an id image.
        """
        files = self._files
        indices = np.concatenate([posed.indices, posed.held_out_indices]).astype(np.int32)
        poses = np.concatenate([posed.world_from_camera, posed.held_out_world_from_camera.reshape(-1, 4, 4)])
        matched = _matched(files, indices, posed)
        if not matched:
            raise UsageError(_nothing_matched(self.folder, files, indices))
        progress.start(len(matched), "reading masks")
        rows, images = [], []
        for row in np.argsort(indices, kind="stable"):
            if int(indices[row]) in matched:
                rows.append(row)
                images.append(_read(matched[int(indices[row])], posed.camera))
                progress.advance()
        size = max((image.shape for image in images), key=lambda shape: shape[0] * shape[1])
        ids = np.stack([_resized(image, size) for image in images])
        progress.note(
            f"masks of {len(rows)} of {len(indices)} frames with known cameras, from {len(files)} images in "
            f"{self.folder}"
        )
        camera = posed.camera.resized(size[1], size[0])
        return FrameMasks(camera, indices[rows], poses[rows], ids)


def _id_images(folder: Path) -> list[Path]:
    if folder == Path():
        raise UsageError(
            f"instances.masks=folder needs {_OPTION}, a folder with one id image (PNG) per frame"
        )
    if not folder.is_dir():
        raise UsageError(f"{_OPTION}={folder}: no such folder; it must contain one id image (PNG) per frame")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".png")
    if not files:
        raise UsageError(f"{_OPTION}={folder}: no PNG in this folder; it must contain one id image per frame")
    return files


def _matched(files: list[Path], indices: np.ndarray, posed: PosedFrames) -> dict[int, Path]:
    """Return the id images of frames, by frame number."""
    source = Path(posed.source.file)
    wanted = {int(i) for i in indices}
    out: dict[int, Path] = {}
    if source.is_dir():
        number_of = {path.stem.lower(): i for i, path in enumerate(ImageFolder(source).files)}
        out = {number_of[p.stem.lower()]: p for p in files if number_of.get(p.stem.lower(), -1) in wanted}
    if not out:
        for path in files:
            digits = re.fullmatch(r"\D*?(\d+)", path.stem)
            frame = int(digits[1]) if digits else -1
            if frame in out:
                raise UsageError(
                    f"{_OPTION}: {out[frame].name} and {path.name} both name frame {frame}; "
                    "keep one id image per frame"
                )
            if frame in wanted:
                out[frame] = path
    return out


def _nothing_matched(folder: Path, files: list[Path], indices: np.ndarray) -> str:
    used = sorted(int(i) for i in indices)
    shown = ", ".join(map(str, used[:6])) + (", …" if len(used) > 6 else "")
    return (
        f"{_OPTION}={folder}: none of its {len(files)} images ({files[0].name}, …) belongs to a frame with a known "
        f"camera. Name them by video frame number (000{used[0]:02d}.png) or like the images of the input; the frames "
        f"with a known camera are {shown}"
    )


def _read(path: Path, camera: Camera) -> np.ndarray:
    """Read one id image, uint16 (h, w)."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise UsageError(f"{_OPTION}: {path} cannot be read as a PNG")
    if image.ndim == 3:
        image = _from_colors(image, path)
    if image.dtype not in (np.uint8, np.uint16):
        raise UsageError(f"{_OPTION}: {path} has {image.dtype} pixels; id images are 8 or 16 bit")
    height, width = image.shape
    if abs(width / height - camera.width / camera.height) > _ASPECT_TOLERANCE * camera.width / camera.height:
        raise UsageError(
            f"{_OPTION}: {path} is {width}x{height}, but frames are {camera.width}x{camera.height}. An id image "
            "must show its whole frame, upright, with the same aspect ratio; any resolution will do"
        )
    return image.astype(np.uint16)


def _from_colors(image: np.ndarray, path: Path) -> np.ndarray:
    """Return the numbers of the colors of a color-coded image; 0 for black and for fully transparent pixels."""
    channels = image[..., :3].astype(np.int64)
    keys = (channels[..., 0] * 65536 + channels[..., 1]) * 65536 + channels[..., 2]
    if image.shape[2] == 4:
        keys = np.where(image[..., 3] == 0, 0, keys)
    colors, numbers = np.unique(keys, return_inverse=True)
    if len(colors) > _MAX_COLORS:
        raise UsageError(
            f"{_OPTION}: {path} has {len(colors)} colors; an id image has one flat color or number per mask, without "
            "blending at borders"
        )
    numbers = numbers.reshape(keys.shape) + (colors[0] != 0)
    return numbers.astype(np.uint16)


def _resized(ids: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if ids.shape == size:
        return ids
    return cv2.resize(ids, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
