"""The observed points of a model: where each frame shows them, to be moved and compared with their projections."""

from collections.abc import Mapping

import numpy as np

from reconstruction.poses.colmap_types import ColmapCamera, Reconstruction


def project(camera: ColmapCamera, points: np.ndarray) -> np.ndarray:
    """Project points (k, 3) of camera space to pixels (k, 2); points behind the camera become NaN."""
    return np.asarray(camera.img_from_cam(points))


def derivatives(camera: ColmapCamera, points: np.ndarray) -> np.ndarray:
    """Return the derivatives (k, 2, 8) of pixels by rotation, translation and principal point: central differences.

    `points`: (k, 3) in camera space. NaN where a difference reaches behind the camera.
    """
    far = 1e-4 * float(np.abs(points[:, 2]).mean())
    by_point = np.stack(
        [(project(camera, points + d) - project(camera, points - d)) / (2 * far) for d in far * np.eye(3)], -1
    )
    x, y, z = points.T
    none = np.zeros(len(points))
    by_turn = np.stack([none, z, -y, -z, none, x, y, -x, none], -1).reshape(-1, 3, 3)
    own = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    return np.concatenate([by_point @ by_turn, by_point, own], axis=2)


class Observations:
    """The observed points of a model, by frame row."""

    def __init__(self, model: Reconstruction) -> None:
        """Keep the pixels as observed."""
        self.model = model
        self.rows = sorted(i - 1 for i in model.reg_image_ids())
        self.camera = model.cameras[min(model.cameras)]
        self.indices, self.pixels = {}, {}
        for row in self.rows:
            points = model.image(row + 1).points2D
            self.indices[row] = [k for k, p in enumerate(points) if p.has_point3D()]
            self.pixels[row] = np.array([points[k].xy for k in self.indices[row]]).reshape(-1, 2)

    def place(self, offsets: Mapping[int, np.ndarray]) -> None:
        """Put the observed points of each frame at their pixels less an offset, (2,) or (k, 2)."""
        for row in self.rows:
            image = self.model.image(row + 1)
            for index, pixel in zip(self.indices[row], self.pixels[row] - offsets[row]):
                image.point2D(index).xy = pixel

    def points_in_camera(self, row: int, world_from_camera: np.ndarray) -> np.ndarray:
        """Return the observed points (k, 3) of a frame in its camera space."""
        image = self.model.image(row + 1)
        points = np.array(
            [self.model.point3D(image.point2D(k).point3D_id).xyz for k in self.indices[row]]
        ).reshape(-1, 3)
        return (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
