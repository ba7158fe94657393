"""Map pixels between the video as recorded and its undistorted frames."""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.types import Camera, DistortedCamera, PosedFrames
from reconstruction.poses.colmap_types import ColmapCamera


@dataclass(frozen=True)
class Lens:
    """The map between pixels of the frames as recorded and of the undistorted frames, at working size."""

    camera: Camera  # of the undistorted frames
    distorted: DistortedCamera | None = None  # of the frames as recorded; None: they are the undistorted ones
    # int (n,) numbers of video frames, and (n, 2) pixels: offset of the principal point of each; None: there are none
    offsets: tuple[np.ndarray, np.ndarray] | None = None

    @classmethod
    def of(cls, posed: PosedFrames) -> "Lens":
        """Return the map that the poses stage undistorted the frames by."""
        if posed.principal_offsets is None:
            return cls(posed.camera, posed.distorted)
        numbers = np.concatenate([posed.indices, posed.held_out_indices])
        return cls(posed.camera, posed.distorted, (numbers, np.asarray(posed.principal_offsets)))

    def at(self, frame: int) -> "Lens":
        """Return the map of one video frame; of the nearest with a camera if it has none."""
        if self.offsets is None or self.distorted is None:
            return self
        numbers, offsets = self.offsets
        offset = offsets[np.argmin(np.abs(numbers - frame))]
        d = self.distorted
        recording = _colmap_camera(d)
        params = np.array(d.params)
        params[list(recording.principal_point_idxs())] += offset
        return Lens(self.camera, replace(d, params=params))

    def straightened(self, pixels: np.ndarray) -> np.ndarray:
        """Map pixels (n, 2) of a frame as recorded to the undistorted frame; both at working size.

        Pixels beyond the range of the distortion model become (-1, -1), outside of the frame.
        """
        pixels = np.asarray(pixels, np.float64)
        if self.distorted is None:
            return pixels
        rays = np.asarray(_colmap_camera(self.distorted).cam_from_img(pixels))
        points = np.column_stack([rays, np.ones(len(rays))])
        return np.nan_to_num(np.stack(self.camera.project(points), axis=1), nan=-1.0)

    def as_filmed(self, picture: np.ndarray) -> np.ndarray:
        """Resample an id image (h, w) of an undistorted frame, of any size, to the frame as recorded; 0 outside."""
        if self.distorted is None:
            return np.asarray(picture)
        height, width = picture.shape
        scale = np.array([self.camera.width / width, self.camera.height / height])
        grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        source = self.straightened(grid.reshape(-1, 2) * scale) / scale
        column, row = np.floor(source).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        out = np.zeros(width * height, picture.dtype)
        out[inside] = np.asarray(picture)[row[inside], column[inside]]
        return out.reshape(height, width)


def _colmap_camera(d: DistortedCamera) -> ColmapCamera:
    import pycolmap

    return pycolmap.Camera(model=d.model, width=d.width, height=d.height, params=d.params)
