"""What depth maps are worth against the truth: known, right, right on things, and glued to things at their rims.

Truth is drawn at every keyframe: from true meshes at the true camera, or from a depth camera's nearest picture (a
surface between its pixels, cut at jumps) at the aligned camera. Depths are metres of the true world.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, DepthMaps, PosedFrames
from reconstruction.measure.alignment import Alignment, align
from reconstruction.measure.ground_truth import GroundTruth
from reconstruction.measure.scene import joined
from reconstruction.measure.stages import sensor_surface
from registry.geometry import transform_points, umeyama

FAR_M = 5.0
OFF = 0.05  # relative error from which a pixel is off
ON_THING = 0.02  # relative error up to which a pixel of a thing is right
RING_SIDE_PX = 320  # longer side at which rings around things are drawn
RING_PX = 4.0
BEHIND = 1.03  # ratio of depths from which what lies beside a thing is background
_SENSOR_STEP_PX, _SENSOR_JUMP = 2, 0.03
_FEWEST_RING_THING_PX = 20  # in one frame
_FEWEST_THING_PX = 1000  # in all frames: of a sliver, one frame decides
_SURE_POINT_PX, _SENSOR_VOXEL_M, _FEWEST_POINTS = 1.0, 0.02, 100
_ROUNDS, _FIRST_REACH_M, _LAST_REACH_M, _SHRINK = 150, 0.2, 0.03, 0.93
_PICTURE_ERROR = 0.10


@dataclass(frozen=True)
class TrueView:
    """What is true at one keyframe."""

    row: int  # of the keyframe
    depth: np.ndarray  # float32 (h, w) metres, 0 = unknown
    ids: np.ndarray | None  # int32 (h, w) entities, 0 = none; None where the truth has no entities


def similarity(posed: PosedFrames, truth: GroundTruth) -> Alignment:
    """Return what takes the poses' space to the true world, by the camera centers of all frames.

    A depth camera is another camera than the one that films, and paths are short: there, the sparse points of the
    poses, which no depth setting changes, are then laid onto what the depth camera measured.
    """
    indices = [*posed.indices, *posed.held_out_indices]
    poses = [*posed.world_from_camera, *posed.held_out_world_from_camera]
    by_centers = align({int(i): p for i, p in zip(indices, poses)}, truth.world_from_camera, truth.up)
    if truth.entities or not truth.indices("depth"):
        return by_centers
    sure = np.asarray(posed.points)[np.asarray(posed.point_errors_px) < _SURE_POINT_PX]
    surface = sensor_surface(truth, _SENSOR_VOXEL_M).points
    return replace(by_centers, true_from_estimated=laid_onto(sure, surface, by_centers.true_from_estimated))


def laid_onto(points: np.ndarray, surface: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the similarity (4, 4) that lays points (n, 3) onto a surface's points (m, 3), from a first guess.

    In every round each point is drawn to the nearest of the surface, if it is within 20 cm at first, 3 cm at last.
    """
    from scipy.spatial import cKDTree

    tree, matrix = cKDTree(surface), start
    for k in range(_ROUNDS):
        far, nearest = tree.query(transform_points(matrix, points))
        near = far < max(_LAST_REACH_M, _FIRST_REACH_M * _SHRINK**k)
        if near.sum() < _FEWEST_POINTS:
            return start
        matrix = umeyama(points[near], surface[nearest[near]])
    return matrix


def true_views(
    posed: PosedFrames, camera: Camera, truth: GroundTruth, alignment: Alignment
) -> Iterable[TrueView]:
    """Draw the truth at every keyframe, as large as the depth maps.

    Args:
        posed: keyframes in any space.
        camera: of the depth maps.
        truth: with entities, or with a depth camera's pictures; nothing is drawn where it has neither.
        alignment: of `similarity`.
    """
    if truth.entities:
        yield from _drawn_meshes(posed, camera, truth, alignment)
    elif truth.indices("depth"):
        yield from _drawn_sensor(posed, camera, truth, alignment)


def _drawn_meshes(posed, camera: Camera, truth: GroundTruth, alignment: Alignment) -> Iterable[TrueView]:
    vertices, faces = joined([e.mesh for e in truth.entities])
    owner = np.concatenate([np.full(len(e.mesh.faces), e.id, np.int32) for e in truth.entities])
    true_camera = truth.camera.resized(camera.width, camera.height)
    for row, index in enumerate(posed.indices):
        pose = truth.world_from_camera.get(int(index))
        if pose is None:
            seen = rasterize_mesh(
                vertices, faces, camera, alignment.pose_to_true(posed.world_from_camera[row])
            )
        else:
            seen = rasterize_mesh(vertices, faces, true_camera, pose)
        ids = np.where(seen.face >= 0, owner[np.maximum(seen.face, 0)], 0).astype(np.int32)
        yield TrueView(row, seen.depth, ids)


def _drawn_sensor(posed, camera: Camera, truth: GroundTruth, alignment: Alignment) -> Iterable[TrueView]:
    measured = np.array([i for i in truth.indices("depth") if i in truth.world_from_camera])
    surfaces: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for row, index in enumerate(posed.indices):
        nearest = int(measured[np.abs(measured - int(index)).argmin()])
        if nearest not in surfaces:
            surfaces = {nearest: sensor_mesh(truth, nearest)}  # keyframes come in order
        pose = alignment.pose_to_true(posed.world_from_camera[row])
        yield TrueView(row, rasterize_mesh(*surfaces[nearest], camera, pose).depth, None)


def sensor_mesh(truth: GroundTruth, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what a depth camera saw as a surface: vertices (v, 3) in the true world and faces, cut at jumps."""
    depth = truth.depth(index)
    small = truth.camera.resized(depth.shape[1], depth.shape[0])
    z = depth[::_SENSOR_STEP_PX, ::_SENSOR_STEP_PX].astype(np.float64)
    v, u = np.mgrid[0 : depth.shape[0] : _SENSOR_STEP_PX, 0 : depth.shape[1] : _SENSOR_STEP_PX] + 0.5
    points = np.stack([(u - small.cx) / small.fx * z, (v - small.cy) / small.fy * z, z], axis=-1)
    number = np.arange(z.size).reshape(z.shape)
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    faces = np.concatenate(
        [np.stack([corners[i] for i in three], axis=-1).reshape(-1, 3) for three in ((0, 1, 2), (0, 2, 3))]
    )
    at = z.ravel()[faces]
    whole = (at.min(1) > 0) & (at.max(1) < (1 + _SENSOR_JUMP) * at.min(1))
    return transform_points(truth.world_from_camera[index], points.reshape(-1, 3)), faces[whole]


def depth_figures(
    depth: DepthMaps,
    scale: float,
    views: Sequence[TrueView],
    names: Mapping[int, str],
    reference: DepthMaps | None = None,
) -> dict[str, Any]:
    """Measure depth maps.

    Args:
        depth: one map per keyframe.
        scale: metres per unit of the maps.
        views: the truth; where there is none, only the known share is measured.
        names: of the things (entities but for floor and walls) by id.
        reference: maps of another run; what only `depth` knows is measured by itself as `new`.

    Returns:
        Shares of pixels, relative errors, and `things`, one record each.
    """
    if not views:
        confidence = np.asarray(depth.confidence)
        out = {"known": float((np.asarray(depth.depth) > 0).mean())}
        for name, value in (("measured", 2), ("completed", 1)):
            out[name] = float((confidence == value).mean())
        if reference is not None:
            new = (np.asarray(depth.depth) > 0) & ~(np.asarray(reference.depth) > 0)
            out["new"] = float(new.mean())
        return out
    asked, ring = 0, np.zeros(2, np.int64)
    errors, levels, fresh = [], [], []
    things = {i: np.zeros(3, np.int64) for i in names}
    for view in views:
        estimated = np.asarray(depth.depth[view.row]) * np.float32(scale)
        inside = (view.depth > 0) & (view.depth < FAR_M)
        both = inside & (estimated > 0)
        asked += int(inside.sum())
        errors.append(np.abs(estimated[both] / view.depth[both] - 1))
        levels.append(np.asarray(depth.confidence[view.row])[both])
        if reference is not None:
            fresh.append(np.asarray(reference.depth[view.row])[both] == 0)
        if view.ids is not None:
            right = both & (np.abs(estimated - view.depth) < ON_THING * view.depth)
            for i, count in things.items():
                own = inside & (view.ids == i)
                if own.any():
                    count += [int(own.sum()), int((own & both).sum()), int((own & right).sum())]
            ring += ring_counts(estimated, view.depth, view.ids, list(names))
    error, level = np.concatenate(errors), np.concatenate(levels)
    out = {"known": len(error) / max(asked, 1), **_errors(error, "")}
    for name, value in (("measured", 2), ("completed", 1)):
        of = level == value
        out |= {name: float(of.sum()) / max(asked, 1), **_errors(error[of], f"{name}_")}
    if reference is not None:
        new = np.concatenate(fresh)
        out |= {"new": float(new.sum()) / max(asked, 1), **_errors(error[new], "new_")}
    seen = {i: count for i, count in things.items() if count[0]}
    if seen:
        total = np.sum(list(seen.values()), axis=0)
        out["on_things"] = float(total[2] / total[0])
        each = [c[2] / c[0] for c in seen.values() if c[0] >= _FEWEST_THING_PX]
        out["on_things_each"] = float(np.mean(each)) if each else None
        out["ring"], out["ring_px"] = float(ring[1] / max(ring[0], 1)), int(ring[0])
        out["things"] = {
            names[i]: {"pixels": int(c[0]), "known": float(c[1] / c[0]), "right": float(c[2] / c[0])}
            for i, c in seen.items()
        }
    out["pixels"] = asked
    return out


def _errors(error: np.ndarray, prefix: str) -> dict[str, float | None]:
    if not len(error):
        return {f"{prefix}median_rel": None, f"{prefix}off": None}
    return {f"{prefix}median_rel": float(np.median(error)), f"{prefix}off": float((error > OFF).mean())}


def ring_counts(
    estimated: np.ndarray, true: np.ndarray, ids: np.ndarray, things: Sequence[int]
) -> np.ndarray:
    """Count the background pixels around things that have depth, and those of them glued to the thing.

    Args:
        estimated: float (h, w) metres, 0 = unknown.
        true: float (h, w) metres, 0 = nothing.
        ids: int (h, w) entities.
        things: the entities to look around.

    Returns:
        int64 (2,): pixels at most 4 px off a thing, at 320 px, whose true depth is more than 3 % farther than that of
        the thing's nearest pixel; how many of them are estimated nearer to the thing than to their true depth.
    """
    from scipy.ndimage import distance_transform_edt, find_objects

    estimated, true, ids = (_small(image) for image in (estimated, true, ids))
    reach, out = int(np.ceil(RING_PX)), np.zeros(2, np.int64)
    boxes = find_objects(ids)
    for thing in things:
        box = boxes[thing - 1] if thing <= len(boxes) else None
        if box is None:
            continue
        wide = tuple(slice(max(0, s.start - reach), s.stop + reach) for s in box)
        own, z, found = ids[wide] == thing, true[wide], estimated[wide]
        if own.sum() < _FEWEST_RING_THING_PX:
            continue
        far, (r, c) = distance_transform_edt(~own, return_indices=True)
        of_thing = z[r, c]
        counted = (far > 0) & (far <= RING_PX) & (found > 0) & (z > BEHIND * of_thing)
        counted &= (z < FAR_M) & (of_thing > 0)
        glued = counted & (np.abs(found - of_thing) < np.abs(found - z))
        out += [int(counted.sum()), int(glued.sum())]
    return out


def _small(image: np.ndarray) -> np.ndarray:
    """Return every pixel's nearest at a longer side of 320 px."""
    height, width = image.shape
    scale = min(1.0, RING_SIDE_PX / max(height, width))
    rows, columns = (
        ((np.arange(round(n * scale)) + 0.5) * (n / round(n * scale))).astype(int) for n in (height, width)
    )
    return image[rows[:, None], columns[None, :]]


def draw_views(
    posed: PosedFrames, depth: DepthMaps, scale: float, views: Sequence[TrueView], place: Path, count: int = 3
) -> list[Path]:
    """Write a picture each of some keyframes: color, depth, true depth, error (0 to 10 %); unknown is black."""
    import cv2

    place.parent.mkdir(parents=True, exist_ok=True)
    by_row, written = {view.row: view for view in views}, []
    size = (depth.camera.width, depth.camera.height)
    for row in np.linspace(0, len(posed.images) - 1, count + 2).round().astype(int)[1:-1]:
        found = np.asarray(depth.depth[row]) * np.float32(scale)
        true = by_row[row].depth if row in by_row else None
        shown = found if true is None or not true.any() else true
        near, far = np.percentile(shown[shown > 0], (1, 99)) if (shown > 0).any() else (0.0, 1.0)
        tiles = [cv2.resize(np.ascontiguousarray(posed.images[row][..., ::-1]), size)]
        tiles.append(_turbo((found - near) / max(far - near, 1e-9), found > 0))
        if true is not None:
            both = (true > 0) & (found > 0)
            error = np.abs(found / np.where(both, true, 1) - 1)
            tiles += [_turbo((true - near) / max(far - near, 1e-9), true > 0)]
            tiles += [_turbo(error / _PICTURE_ERROR, both)]
        path = place.with_name(f"{place.name}_{int(posed.indices[row]):05d}.png")
        cv2.imwrite(str(path), np.concatenate(tiles, axis=1))
        written.append(path)
    return written


def _turbo(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    import cv2

    out = cv2.applyColorMap((np.clip(values, 0, 1) * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    out[~known] = 0
    return out
