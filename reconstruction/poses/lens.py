"""Map pixels between the video as recorded and its undistorted frames."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import Camera, DistortedCamera, PosedFrames


@dataclass(frozen=True)
class Lens:
    """The map between pixels of the frames as recorded and of the undistorted frames, at working size."""

    camera: Camera  # of the undistorted frames
    distorted: DistortedCamera | None = None  # of the frames as recorded; None: they are the undistorted ones

    @classmethod
    def of(cls, posed: PosedFrames) -> "Lens":
        """Return the map that the poses stage undistorted the frames by."""
        return cls(posed.camera, posed.distorted)

    def straightened(self, pixels: np.ndarray) -> np.ndarray:
        """Map pixels (n, 2) of a frame as recorded to the undistorted frame; both at working size.

        Pixels beyond the range of the distortion model become (-1, -1), outside of the frame.
        """
        pixels = np.asarray(pixels, np.float64)
        if self.distorted is None:
            return pixels
        import pycolmap

        d = self.distorted
        recording = pycolmap.Camera(model=d.model, width=d.width, height=d.height, params=d.params)
        rays = np.asarray(recording.cam_from_img(pixels))
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
