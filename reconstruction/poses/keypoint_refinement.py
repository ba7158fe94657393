"""Keypoint refinement by patch alignment: a model and its frames -> the model with exact and with more observations.

A feature is detected in each frame by itself, so the same corner is found at places that differ by half a pixel. Here
the patch around the keypoint of one frame of a track, the reference, is aligned with the track's other frames, and with
frames that should see the point but did not match it: inverse compositional Lucas-Kanade (Baker and Matthews, IJCV
2004) of a translation, free of gain and offset of the brightness. Patches are warped by the affine map that the model's
cameras give for the plane through the neighboring points, or for one that faces the reference.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numba import njit
from scipy.spatial import KDTree

from reconstruction.core.progress import Progress
from reconstruction.poses.colmap_types import Reconstruction
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.mapping import poses_of
from reconstruction.poses.observations import project
from reconstruction.poses.parallel import ordered_map
from reconstruction.poses.refine import bundle_adjust, filter_points

# The scale of the loss and the size of a patch were chosen on six films of visitors (docs/poses.md); the others are not
# fitted: usual values, tried as they are.
LOSS_SCALE_PX = 0.3
"""Of the Cauchy loss of an adjustment to refined keypoints."""
_ITERATIONS = 20  # of that adjustment
_RADIUS_PX = 10  # of a patch; its window is a normal one of half that spread
_BLUR_PX = 0.8  # of the pictures: interpolation between pixels is biased by finer detail
_STEPS = 12  # of Lucas-Kanade, at most
_LAST_STEP_PX = 0.005
_MOST_MOVED_PX = 3.0  # from the keypoint; farther away it is another corner
_LEAST_CORRELATION = 0.85
_MOST_ZOOM = 1.8  # of a patch from frame to frame
_MOST_CONDITION = 100.0  # of a patch's normal equations: on a straight edge the place along it is free
_NEIGHBORS = 12  # points that the plane of a patch is fitted to
_MOST_THICK = 0.3  # of these, across the plane, as a share of their smaller extent in it
_MOST_SLANT_DEG = 75.0  # of the plane to the ray; beyond, a patch faces the reference
# Of observations that are added:
_MOST_ADDED = 8  # for a point
_MOST_ANGLE_DEG = 40.0  # to the reference's ray
_LEAST_ADDED_CORRELATION = 0.9
_MOST_ADDED_MOVED_PX = 2.0  # from the projection of the point


@dataclass(frozen=True)
class _Patches:
    """Observations of points, one row each; those of a point stand together."""

    point: np.ndarray  # int64 (k,) number of the point
    frame: np.ndarray  # int64 (k,) number of the frame
    index: np.ndarray  # int64 (k,) of the keypoint in its image; -1: none yet
    pixel: np.ndarray  # float64 (k, 2) of the keypoint, or of the point's projection
    depth: np.ndarray  # float64 (k,) of the point in the frame

    def sorted(self) -> "_Patches":
        """Return the observations ordered by point, frame."""
        return self.taken(np.lexsort((self.frame, self.point)))

    def taken(self, rows: np.ndarray) -> "_Patches":
        """Return some of the observations."""
        return _Patches(
            self.point[rows], self.frame[rows], self.index[rows], self.pixel[rows], self.depth[rows]
        )

    def joined(self, other: "_Patches") -> "_Patches":
        """Return these and other observations, ordered."""
        both = [np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values())]
        return _Patches(*both).sorted()

    def references(self) -> np.ndarray:
        """Return the row of each observation's reference, int64 (k,): of the point's keypoints, the median depth's."""
        order = np.lexsort((self.depth, self.index < 0, self.point))
        starts, counts = _groups(self.point)
        keypoints = np.add.reduceat((self.index >= 0).astype(np.int64), starts)
        return np.repeat(order[starts + (keypoints - 1) // 2], counts)


@dataclass(frozen=True)
class _Scene:
    """Cameras, points and frames of a model."""

    model: Reconstruction
    rows: list[int]  # registered
    world_from_camera: np.ndarray  # float64 (n, 4, 4)
    camera_from_world: np.ndarray
    point_ids: list[int]
    points: np.ndarray  # float64 (m, 3)

    @classmethod
    def of(cls, model: Reconstruction) -> "_Scene":
        """Read a model."""
        poses, point_ids = poses_of(model), sorted(model.point3D_ids())
        rows = sorted(poses)
        world_from_camera = np.stack([poses[row] for row in rows])
        points = np.array([model.point3D(i).xyz for i in point_ids]).reshape(-1, 3)
        return cls(model, rows, world_from_camera, np.linalg.inv(world_from_camera), point_ids, points)

    def project(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (m, 2) of all points in a frame, NaN behind the camera, and their depth (m,)."""
        m = self.camera_from_world[frame]
        local = self.points @ m[:3, :3].T + m[:3, 3]
        return project(self.model.cameras[min(self.model.cameras)], local), local[:, 2]


def adjust_to_patches(
    model: Reconstruction, images: np.ndarray, config: PosesConfig, progress: Progress
) -> Reconstruction:
    """Refine the keypoints of a model and adjust it to them; arguments and result as of `refine_keypoints`."""
    progress.start(1, "aligning patches")
    model = refine_keypoints(model, images)
    filter_points(model, config.max_point_error_px, config.min_track_length)
    bundle_adjust(model, LOSS_SCALE_PX, _ITERATIONS)
    progress.advance()
    return model


def refine_keypoints(model: Reconstruction, images: np.ndarray) -> Reconstruction:
    """Move the keypoints of a model to where the patches of their tracks align, and add observations that align.

    Keypoints that do not align stay. Poses and points are not adjusted here.

    Args:
        model: all frames share one camera; stays unchanged.
        images: uint8 (n, h, w, 3) the frames, by row.

    Returns:
        A model with the same frames, points and ids; added keypoints stand behind those of each image.
    """
    scene = _Scene.of(model)
    keypoints = _keypoints(scene)
    patches = keypoints.joined(_unmatched(scene, keypoints, images.shape[1:3]))
    pixel, correlation = _aligned(scene, patches, images)
    moved = np.linalg.norm(pixel - patches.pixel, axis=1)
    added = patches.index < 0
    fits = np.where(
        added,
        (correlation >= _LEAST_ADDED_CORRELATION) & (moved <= _MOST_ADDED_MOVED_PX),
        (correlation >= _LEAST_CORRELATION) & (moved <= _MOST_MOVED_PX),
    )
    return _with_keypoints(scene, patches, np.where(fits[:, None], pixel, patches.pixel), ~added | fits)


def _keypoints(scene: _Scene) -> _Patches:
    """Return the observations of the model."""
    number = {row + 1: k for k, row in enumerate(scene.rows)}
    pixels = {i: np.array([p.xy for p in scene.model.image(i).points2D]).reshape(-1, 2) for i in number}
    seen = [
        (column, number[element.image_id], element.point2D_idx)
        for column, point_id in enumerate(scene.point_ids)
        for element in scene.model.point3D(point_id).track.elements
    ]
    point, frame, index = np.array(seen, np.int64).reshape(-1, 3).T
    pixel = np.array([pixels[scene.rows[f] + 1][i] for f, i in zip(frame, index)]).reshape(-1, 2)
    m = scene.camera_from_world[frame]
    depth = np.einsum("kj,kj->k", m[:, 2, :3], scene.points[point]) + m[:, 2, 3]
    return _Patches(point, frame, index, pixel, depth).sorted()


def _unmatched(scene: _Scene, keypoints: _Patches, size: tuple[int, int]) -> _Patches:
    """Return unmatched observations that frames of `size` (height, width) should have of the points, some of each."""
    height, width = size
    margin = _MOST_ZOOM * _RADIUS_PX + 2
    row_of = keypoints.references()[_groups(keypoints.point)[0]]
    reference, near = keypoints.frame[row_of], keypoints.depth[row_of]
    ray = _unit(scene.points - scene.world_from_camera[reference, :3, 3])
    matched = np.zeros((len(scene.points), len(scene.rows)), bool)
    matched[keypoints.point, keypoints.frame] = True
    found = []
    for frame, pose in enumerate(scene.world_from_camera):
        pixel, depth = scene.project(frame)
        inside = ((pixel > margin) & (pixel < np.array([width, height]) - margin)).all(axis=1)
        alike = (depth < _MOST_ZOOM * near) & (depth > near / _MOST_ZOOM)
        cosine = np.einsum("ij,ij->i", ray, _unit(scene.points - pose[:3, 3]))
        point = np.flatnonzero(
            inside & alike & ~matched[:, frame] & (cosine > np.cos(np.radians(_MOST_ANGLE_DEG)))
        )
        none = np.full(len(point), -1)
        found.append(_Patches(point, np.full(len(point), frame), none, pixel[point], depth[point]))
    whole = _Patches(*(np.concatenate(values) for values in zip(*(vars(part).values() for part in found))))
    order = np.lexsort((np.random.default_rng(0).random(len(whole.point)), whole.point))
    starts, counts = _groups(whole.point[order])
    rank = np.arange(len(order)) - np.repeat(starts, counts)
    return whole.taken(order[rank < _MOST_ADDED])


def _aligned(scene: _Scene, patches: _Patches, images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the patches align with those of their references, (k, 2), and how they correlate, (k,)."""
    reference = patches.references()
    warp = _warps(scene, patches, reference)
    zoom = np.sqrt(np.abs(np.linalg.det(warp)))
    reference = np.where((zoom < _MOST_ZOOM) & (zoom * _MOST_ZOOM > 1), reference, -1)
    pictures = np.stack([_blurred(images[row]) for row in scene.rows])
    axis = np.exp(-0.5 * (np.arange(-_RADIUS_PX, _RADIUS_PX + 1) / (0.5 * _RADIUS_PX)) ** 2)
    weight = np.outer(axis, axis) / axis.sum() ** 2
    pixel, correlation = patches.pixel.copy(), np.zeros(len(patches.point))
    starts, _ = _groups(patches.point)
    pieces = [*starts[np.linspace(0, len(starts), 33).astype(int)[:-1]], len(patches.point)]

    def align(piece: tuple[int, int]) -> None:
        _align(*piece, pictures, patches.frame, reference, patches.pixel, warp, weight, pixel, correlation)

    for _ in ordered_map(align, list(pairwise(pieces))):
        pass
    return pixel, correlation


def _warps(scene: _Scene, patches: _Patches, reference: np.ndarray) -> np.ndarray:
    """Return the affine maps (k, 2, 2) from pixels of the reference to those of each observation's frame."""
    camera = scene.model.cameras[min(scene.model.cameras)]
    to_frame = scene.camera_from_world[patches.frame] @ scene.world_from_camera[patches.frame[reference]]

    place, normal = scene.points[patches.point], _normals(scene)[patches.point]
    camera_from_world = scene.camera_from_world[patches.frame[reference]]
    place = np.einsum("kij,kj->ki", camera_from_world[:, :3, :3], place) + camera_from_world[:, :3, 3]
    normal = np.einsum("kij,kj->ki", camera_from_world[:, :3, :3], normal)
    sight = _unit(place)
    facing = np.abs(np.einsum("ki,ki->k", normal, sight)) > np.cos(np.radians(_MOST_SLANT_DEG))
    normal = np.where(facing[:, None], normal, sight)
    distance = np.einsum("ki,ki->k", normal, place)

    def shifted(by: np.ndarray) -> np.ndarray:
        rays = np.asarray(camera.cam_from_img(patches.pixel[reference] + by))
        rays = np.column_stack([rays, np.ones(len(rays))])
        points = rays * (distance / np.einsum("ki,ki->k", normal, rays))[:, None]
        return project(camera, np.einsum("kij,kj->ki", to_frame[:, :3, :3], points) + to_frame[:, :3, 3])

    columns = [(shifted(step) - shifted(-step)) / 2 for step in np.eye(2)]
    return np.nan_to_num(np.stack(columns, axis=2))


def _normals(scene: _Scene) -> np.ndarray:
    """Return the normals (m, 3) of the planes through each point's neighbors; zeros where these lie on none."""
    count = min(_NEIGHBORS, len(scene.points))
    near = scene.points[KDTree(scene.points).query(scene.points, count)[1].reshape(-1, count)]
    near = near - near.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("mki,mkj->mij", near, near))
    flat = spread[:, 0] < _MOST_THICK**2 * spread[:, 1]
    return axes[:, :, 0] * flat[:, None]


def _with_keypoints(scene: _Scene, patches: _Patches, pixel: np.ndarray, kept: np.ndarray) -> Reconstruction:
    """Return a copy of the model whose observations are the `kept` ones of `patches`, at `pixel`."""
    import pycolmap

    old, out = scene.model, pycolmap.Reconstruction()
    out.add_camera_with_trivial_rig(old.cameras[min(old.cameras)])
    index = patches.index.copy()
    for frame, row in enumerate(scene.rows):
        image = old.image(row + 1)
        places = np.array([p.xy for p in image.points2D]).reshape(-1, 2)
        own = np.flatnonzero((patches.frame == frame) & kept)
        known, new = own[index[own] >= 0], own[index[own] < 0]
        places[index[known]] = pixel[known]
        index[new] = len(places) + np.arange(len(new))
        out.add_image_with_trivial_frame(
            pycolmap.Image(image.name, np.concatenate([places, pixel[new]]), image.camera_id, row + 1),
            image.cam_from_world(),
        )
    for point_id, start, count in zip(scene.point_ids, *_groups(patches.point)):
        rows = start + np.flatnonzero(kept[start : start + count])
        elements = [pycolmap.TrackElement(scene.rows[patches.frame[k]] + 1, int(index[k])) for k in rows]
        point = old.point3D(point_id)
        out.add_point3D_with_id(
            point_id, pycolmap.Point3D(xyz=point.xyz, color=point.color, track=pycolmap.Track(elements))
        )
    return out


def _groups(point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first row of each point in sorted numbers (k,), and how many rows it has."""
    _, starts, counts = np.unique(point, return_index=True, return_counts=True)
    return starts, counts


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _blurred(image: np.ndarray) -> np.ndarray:
    gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY).astype(np.float32)
    return cv2.GaussianBlur(gray, (0, 0), _BLUR_PX)


@njit(cache=True, nogil=True)
def _read(image, x, y, warp, weight, out):  # pragma: no cover - compiled
    """Sample a patch around (x, y), mean 0 and norm 1 under `weight`; return its norm, 0 where it has none."""
    height, width = image.shape
    side, radius = len(weight), len(weight) // 2
    mean = 0.0
    for i in range(side):
        for j in range(side):
            u, v = j - radius, i - radius
            px, py = x + warp[0, 0] * u + warp[0, 1] * v, y + warp[1, 0] * u + warp[1, 1] * v
            left, top = int(np.floor(px)), int(np.floor(py))
            if left < 0 or top < 0 or left >= width - 1 or top >= height - 1:
                return 0.0
            a, b = px - left, py - top
            upper = image[top, left] * (1 - a) + image[top, left + 1] * a
            out[i, j] = upper * (1 - b) + (image[top + 1, left] * (1 - a) + image[top + 1, left + 1] * a) * b
            mean += weight[i, j] * out[i, j]
    square = 0.0
    for i in range(side):
        for j in range(side):
            out[i, j] -= mean
            square += weight[i, j] * out[i, j] ** 2
    if square < 1.0:  # gray levels: a blank patch
        return 0.0
    norm = np.sqrt(square)
    for i in range(side):
        for j in range(side):
            out[i, j] /= norm
    return norm


@njit(cache=True, nogil=True)
def _slopes(image, x, y, norm, own, weight, gx, gy):  # pragma: no cover - compiled
    """Write the derivatives of a normalized patch by x and y; return the inverse normal matrix's (xx, xy, yy).

    Zeros: the patch does not fix a place.
    """
    side = len(weight)
    level, scratch = np.eye(2), np.empty_like(own)
    for axis in range(2):
        g = gx if axis == 0 else gy
        g[:] = 0.0
        for sign in (1.0, -1.0):
            dx, dy = (sign, 0.0) if axis == 0 else (0.0, sign)
            scale = _read(image, x + dx, y + dy, level, weight, scratch)
            if scale == 0.0:
                return 0.0, 0.0, 0.0
            for i in range(side):
                for j in range(side):
                    g[i, j] += 0.5 * sign * scale * scratch[i, j] / norm
        # Gain and offset are free: changes along the patch itself and along its mean are none.
        mean, along = 0.0, 0.0
        for i in range(side):
            for j in range(side):
                mean += weight[i, j] * g[i, j]
                along += weight[i, j] * g[i, j] * own[i, j]
        for i in range(side):
            for j in range(side):
                g[i, j] -= mean + along * own[i, j]
    xx, xy, yy = 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            xx += weight[i, j] * gx[i, j] ** 2
            xy += weight[i, j] * gx[i, j] * gy[i, j]
            yy += weight[i, j] * gy[i, j] ** 2
    middle, spread = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    if middle + spread > _MOST_CONDITION * (middle - spread):
        return 0.0, 0.0, 0.0
    det = xx * yy - xy * xy
    return yy / det, -xy / det, xx / det


@njit(cache=True, nogil=True)
def _align(
    start, stop, pictures, frame, reference, pixel, warp, weight, out, correlation
):  # pragma: no cover - compiled
    """Align the observations start..stop with their references; write place and correlation.

    Nothing is written for those without a reference, and for those that leave the frame.
    """
    side = len(weight)
    patch, own, gx, gy = np.empty((4, side, side))
    level = np.eye(2)
    known, xx, xy, yy = -1, 0.0, 0.0, 0.0
    for k in range(start, stop):
        r = reference[k]
        if r < 0 or r == k:
            continue
        if r != known:
            known, xx = r, 0.0
            x, y = pixel[r, 0] - 0.5, pixel[r, 1] - 0.5
            norm = _read(pictures[frame[r]], x, y, level, weight, own)
            if norm > 0.0:
                xx, xy, yy = _slopes(pictures[frame[r]], x, y, norm, own, weight, gx, gy)
        if xx == 0.0:
            continue
        x, y = pixel[k, 0] - 0.5, pixel[k, 1] - 0.5
        fits = _read(pictures[frame[k]], x, y, warp[k], weight, patch) > 0.0
        for _ in range(_STEPS):
            if not fits:
                break
            bx, by = 0.0, 0.0
            for i in range(side):
                for j in range(side):
                    error = weight[i, j] * (patch[i, j] - own[i, j])
                    bx += gx[i, j] * error
                    by += gy[i, j] * error
            u, v = xx * bx + xy * by, xy * bx + yy * by
            dx, dy = warp[k, 0, 0] * u + warp[k, 0, 1] * v, warp[k, 1, 0] * u + warp[k, 1, 1] * v
            x, y = x - dx, y - dy
            far = np.hypot(x + 0.5 - pixel[k, 0], y + 0.5 - pixel[k, 1]) > _MOST_MOVED_PX
            fits = not far and _read(pictures[frame[k]], x, y, warp[k], weight, patch) > 0.0
            if np.hypot(dx, dy) < _LAST_STEP_PX:
                break
        if fits:
            out[k, 0], out[k, 1] = x + 0.5, y + 0.5
            for i in range(side):
                for j in range(side):
                    correlation[k] += weight[i, j] * patch[i, j] * own[i, j]
