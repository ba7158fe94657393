"""Localize held-out frames against the finished model: absolute pose from 2D-3D matches."""

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.poses.colmap_types import ColmapCamera, Reconstruction
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features, match
from reconstruction.poses.parallel import ordered_map
from reconstruction.poses.resection import resect

_NEIGHBORS = 8  # keyframes that each query is matched to
_MAX_ERROR_PX = 3.0  # inlier threshold of RANSAC
_ROUGH_ERROR_PX = 12.0  # the same with a principal point interpolated in time


def locate_frames(
    queries: list[Features],
    candidates: list[list[int]],
    features: list[Features],
    model: Reconstruction,
    config: PosesConfig,
    progress: Progress,
    offsets: np.ndarray | None = None,
) -> list[tuple[np.ndarray, np.ndarray] | None]:
    """Return the pose world_from_camera (4, 4) of each query frame, and its principal point's offset (2,) in pixels.

    None stands where inliers are too few.

    Args:
        queries: features of the frames to localize.
        candidates: for each query, rows of registered keyframes that probably overlap it, best first.
        features: features of all keyframes, in the order of the model's first 2D points.
        model: stays unchanged.
        config: seed and thresholds.
        progress: advanced by one per query.
        offsets: (queries, 2) of the principal points, roughly; None: they do not move.
    """
    tracked = {
        row: _tracked_features(model, row, len(features[row].keypoints))
        for row in sorted({r for rows in candidates for r in rows})
    }
    positions = {i: model.point3D(i).xyz for i in sorted(model.point3D_ids())}
    camera = model.cameras[min(model.cameras)]

    def locate(number: int) -> tuple[np.ndarray, np.ndarray] | None:
        query, rows = queries[number], candidates[number]
        votes: dict[tuple[int, int], int] = {}
        for row in rows[:_NEIGHBORS]:
            feature_rows, point_ids = tracked[row]
            for a, b in match(query.descriptors, features[row].descriptors[feature_rows]):
                key = (int(a), int(point_ids[b]))
                votes[key] = votes.get(key, 0) + 1
        points_2d, points_3d = _correspondences(query, votes, positions)
        if len(points_2d) < config.min_held_out_inliers:
            return None
        offset = np.zeros(2)
        if offsets is not None:
            offset = _offset(points_2d, points_3d, camera, config, offsets[number])
        pose, inliers = _absolute_pose(points_2d - offset, points_3d, camera, config, _MAX_ERROR_PX)
        return None if pose is None or inliers.sum() < config.min_held_out_inliers else (pose, offset)

    out = []
    for pose in ordered_map(locate, list(range(len(queries)))):
        out.append(pose)
        progress.advance()
    return out


def candidates_in_time(times_s: np.ndarray, registered: list[int], query_time_s: float) -> list[int]:
    """Return the registered rows nearest in time, nearest first."""
    gaps = np.abs(np.asarray(times_s)[registered] - query_time_s)
    return [registered[i] for i in np.argsort(gaps, kind="stable")[:_NEIGHBORS]]


def _tracked_features(model: Reconstruction, row: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which of the `count` features of a keyframe have a 3D point, int64 (k,), and the point ids (k,)."""
    points = model.image(row + 1).points2D[:count]  # behind these, keypoints without a feature
    found = [(i, p.point3D_id) for i, p in enumerate(points) if p.has_point3D()]
    return np.array([f[0] for f in found], np.int64), np.array([f[1] for f in found], np.int64)


def _correspondences(
    query: Features, votes: dict[tuple[int, int], int], positions: dict[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (k, 2) and 3D points (k, 3): each feature matched to the point with most votes."""
    best: dict[int, tuple[int, int]] = {}
    for (feature, point), count in sorted(votes.items()):
        if feature not in best or count > best[feature][0]:
            best[feature] = (count, point)
    points = np.array([positions[point] for _, point in best.values()]).reshape(-1, 3)
    return query.keypoints[list(best)].astype(np.float64).reshape(-1, 2), points


def _offset(
    pixels: np.ndarray, points: np.ndarray, camera: ColmapCamera, config: PosesConfig, offset: np.ndarray
) -> np.ndarray:
    """Estimate the principal point's offset (2,) of a frame, from a rough one."""
    pose, inliers = _absolute_pose(pixels - offset, points, camera, config, _ROUGH_ERROR_PX)
    if pose is None or inliers.sum() < config.min_held_out_inliers:
        return offset
    local = (points[inliers] - pose[:3, 3]) @ pose[:3, :3]
    return resect(camera, local, pixels[inliers], offset)


def _absolute_pose(
    pixels: np.ndarray, points: np.ndarray, camera: ColmapCamera, config: PosesConfig, max_error_px: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """Estimate world_from_camera (4, 4) by RANSAC from 2D-3D correspondences; return it and the inliers, bool (k,)."""
    import pycolmap

    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = max_error_px
    estimation.ransac.random_seed = config.seed
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.loss_function_scale = 0.5
    answer = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, estimation, refinement)
    if answer is None:
        return None, np.zeros(len(pixels), bool)
    camera_from_world = np.eye(4)
    camera_from_world[:3] = answer["cam_from_world"].matrix()
    return np.linalg.inv(camera_from_world), np.asarray(answer["inlier_mask"], bool)
