"""Addresses that last for clicks in the page: pixels of video frames (docs/overrides.md)."""

from collections.abc import Iterable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from reconstruction.poses.lens import Lens
from registry import SceneBundle
from registry.errors import UsageError
from registry.geometry import invert_rigid

if TYPE_CHECKING:
    from reconstruction.core.types import DistortedCamera, PosedFrames
    from reconstruction.measure.stage_results import StageResults

_NEAR_M, _NEAR_SHARE = 0.01, 0.01  # a point is seen where its depth differs by less: noise of the depth maps
_PX_PER_M = 200.0  # a depth that is off by 5 mm counts as much as a margin that is narrower by a pixel
_ENOUGH_PX = 12.0  # from here on a wider margin around the pixel is no better
_LEAST_PX = 3.0  # a click may miss by 2 pixels of the id maps (docs/overrides.md), and one is rounding


class Anchors:
    """Makes addresses for one revision of a scene."""

    def __init__(self, bundle: SceneBundle, results: "StageResults") -> None:
        """Read the anchors of the bundle; the stage results give pixels for any point.

        Args:
            bundle: the revision shown.
            results: its stage results; missing ones leave the anchors of the bundle, and points in metres.
        """
        self._bundle, self._results = bundle, results
        scene = bundle.scene
        self._items = {item["id"]: item for item in scene["objects"]}
        self._size = scene["source"]["width"], scene["source"]["height"]

    def thing(self, object_id: int) -> dict[str, Any]:
        """Return the address of an object: its anchor pixel, else its id with its place."""
        anchor = self._items[object_id].get("anchor")
        if anchor is None:
            center = np.asarray(self._items[object_id]["world_from_object"])[:3, 3]
            return {"id": object_id, "near": _rounded(center, 2)}
        return {"pixel": {key: anchor[key] for key in ("frame", "x", "y")}}

    def knows(self, number: int) -> bool:
        """Return whether an id is an object's."""
        return number in self._items

    def place(self, point: np.ndarray, owner: int) -> dict[str, Any]:
        """Return the address of a point on the surface of an object or base entity.

        Args:
            point: (3,) world metres, where the film shows it.
            owner: its id.

        Returns:
            The pixel, of all keyframes that see the point, with the widest margin of the same owner around it; the
            point in metres (`at`) if none sees it.
        """
        best = max(self._sightings(np.asarray(point, np.float64), owner), default=None)
        if best is None:
            return {"at": _rounded(point, 3)}
        _, frame, x, y = best
        return self.click(frame, (x, y))

    def click(self, frame: int, pixel: tuple[float, float]) -> dict[str, Any]:
        """Return the address of a pixel of the undistorted photograph, counted in the bundle's cameras."""
        x, y = self.filmed([pixel], frame)[0]
        return {"pixel": {"frame": int(frame), "x": x, "y": y}}

    def filmed(self, pixels: Iterable[tuple[float, float]], frame: int) -> list[list[float]]:
        """Map pixels of an undistorted frame (bundle's cameras) to pixels of the video as filmed.

        Raises:
            UsageError: one lies outside of the video's frame.
        """
        cameras = self._bundle.cameras
        distorted = None if self._posed is None else Lens.of(self._posed).at(frame).distorted
        at = np.asarray(list(pixels), np.float64)
        if distorted is not None:
            rays = np.column_stack([_rays(at, cameras.params), np.ones(len(at))])
            at, counted = _distorted(rays, distorted)
        else:
            counted = (cameras.width, cameras.height)
        scale = np.array(self._size) / counted
        out = np.round(at * scale, 1)
        if not ((out >= 0) & (out <= self._size)).all():
            raise UsageError("this place lies outside of the frame; click inside the photograph")
        return out.tolist()

    @property
    def exact(self) -> bool:
        """Whether the stage results are at hand, so that any clicked point becomes a pixel."""
        return self._posed is not None and self._results.get("instances") is not None

    @property
    def _posed(self) -> "PosedFrames | None":
        return self._results.get("poses")

    def _sightings(self, point: np.ndarray, owner: int) -> Iterable[tuple[float, int, float, float]]:
        """Yield (margin in pixels, frame, x, y) of the keyframes that see a point of an owner."""
        found, posed, cameras = self._results.get("instances"), self._posed, self._bundle.cameras
        if found is None or posed is None or not len(found.id_maps):
            return
        depth, unit_m = self._depth or (None, 1.0)
        row_of = {int(index): row for row, index in enumerate(posed.indices)}
        height, width = found.id_maps.shape[1:]
        scale = np.array([width / cameras.width, height / cameras.height])
        for index, pose in zip(cameras.indices, cameras.world_from_camera):
            row = row_of.get(int(index))
            local = invert_rigid(pose) @ np.append(point, 1.0)
            if row is None or local[2] <= 0.05:
                continue
            fx, fy, cx, cy = cameras.params[:4]
            pixel = np.array([fx * local[0] / local[2] + cx, fy * local[1] / local[2] + cy])
            column, line = (pixel * scale).astype(int)
            if not (0 <= column < width and 0 <= line < height) or found.id_maps[row][line, column] != owner:
                continue
            gap = 0.0
            if depth is not None:
                seen = unit_m * depth[row][line * depth.shape[1] // height, column * depth.shape[2] // width]
                gap = abs(float(seen - local[2]))
                if gap > _NEAR_M + _NEAR_SHARE * local[2]:
                    continue
            mine = np.pad((np.asarray(found.id_maps[row]) == owner).astype(np.uint8), 1)
            margin = float(cv2.distanceTransform(mine, cv2.DIST_L2, 5)[line + 1, column + 1])
            if margin >= _LEAST_PX:
                # Of frames with the same margin the one nearest to the point shows it best.
                score = min(margin, _ENOUGH_PX) - _PX_PER_M * gap - 0.1 * float(local[2])
                yield score, int(index), float(pixel[0]), float(pixel[1])

    @cached_property
    def _depth(self) -> tuple[np.ndarray, float] | None:
        """Return the refined depth maps (n, h, w) of the keyframes and their unit in metres; None if missing."""
        world, gaussians = self._results.get("world"), self._results.get("gaussians")
        if world is None or gaussians is None:
            return None
        return gaussians.depth.depth, float(np.cbrt(np.linalg.det(world.world_from_sfm[:3, :3])))


def _rays(pixels: np.ndarray, params: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = params[:4]
    return np.column_stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy])


def _distorted(rays: np.ndarray, camera: "DistortedCamera") -> tuple[np.ndarray, tuple[int, int]]:
    """Project rays (n, 3) into a camera with distortion; return pixels (n, 2) and the camera's size."""
    import pycolmap

    lens = pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=camera.params)
    return np.asarray(lens.img_from_cam(rays), np.float64), (camera.width, camera.height)


def _rounded(point: np.ndarray, digits: int) -> list[float]:
    return [round(float(x), digits) for x in point]
