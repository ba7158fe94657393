"""Detect inputs that structure from motion cannot reconstruct, and say why and what to film instead."""

import numpy as np

from reconstruction.core.types import FrameSet
from reconstruction.poses.colmap_types import Reconstruction
from reconstruction.poses.features import Features
from reconstruction.poses.mapping import poses_of
from reconstruction.poses.observations import Observations
from reconstruction.poses.pairs import VerifiedPair, fit_homography
from registry.errors import InputError

MIN_FRAMES = 8
_MIN_FEATURES = 60  # in the median frame
_STILL_SHARE = 0.01  # of the image diagonal; largest image motion of a camera at rest
_ROTATION_EXPLAINED = 0.95  # inlier share of the homography under pure rotation
_EXPLAINED_PX = 2.0  # error of a match to its epipolar line under which the model explains it
_MIN_TRIANGULATION_DEG = 2.0  # median triangulation angle
_FAR_BELOW_DEG = 1.5  # triangulation angle of points that only tell how a camera turns
_MOST_DEPTH_RATIO = 200.0  # of the points in one frame: 10 cm to 20 m; a collapsed one has 1e3 and more
_DEPTH_QUANTILES = (0.1, 0.9)
_MOST_COLLAPSED_SHARE = 0.1  # of the frames

_HOW_TO_FILM = (
    "Film again: walk slowly around the objects for 10-60 s, in good light, seeing all from several places."
)


def check_features(features: list[Features], indices: np.ndarray) -> None:
    """Raise `InputError` where frames or features are too few to match."""
    if len(features) < MIN_FRAMES:
        raise InputError(
            f"poses: {len(features)} usable frames, at least {MIN_FRAMES} are needed. {_HOW_TO_FILM}"
        )
    counts = np.array([len(f.keypoints) for f in features])
    if np.median(counts) < _MIN_FEATURES:
        raise InputError(
            f"poses: the frames show almost no texture (median {int(np.median(counts))} features per frame, "
            f"{_MIN_FEATURES} are needed; frames {describe_frames(indices[counts < _MIN_FEATURES])}). A blank wall, "
            "darkness or heavy blur cannot be reconstructed. Film something with texture, with more light, "
            "moving more slowly."
        )


def check_motion(features: list[Features], pairs: list[VerifiedPair], image_size: tuple[int, int]) -> None:
    """Raise `InputError` where frames do not overlap, the camera is at rest, or its motion is a pure rotation."""
    if not pairs:
        raise InputError(
            f"poses: no two of the {len(features)} frames could be matched: they show different things, "
            f"are blurred, or repeat one pattern. {_HOW_TO_FILM}"
        )
    moved, explained, modulus = zip(*(_pair_motion(features, pair) for pair in pairs))
    diagonal = float(np.hypot(*image_size))
    if np.quantile(moved, 0.95) < _STILL_SHARE * diagonal:
        raise InputError(
            f"poses: the camera stood still (image motion {np.quantile(moved, 0.95):.1f} px over the whole video). "
            f"Depth needs a camera that moves. {_HOW_TO_FILM}"
        )
    explained, modulus = np.array(explained), np.array(modulus)
    # Under pure rotation all frames are related by homographies K R K^-1, whose eigenvalues have modulus 1 for
    # any K. A camera that moves past a plane gives homographies too, but with other eigenvalues.
    far = np.array(moved) > np.median(moved)
    if not far.any():
        far[:] = True
    # Pairs with the largest motion may all be from a turn, in a film that has parallax elsewhere.
    turned = min(np.quantile(explained[far], 0.1), np.quantile(explained, 0.1)) > _ROTATION_EXPLAINED
    if turned and np.median(modulus[far]) < 0.02:
        raise InputError(
            "poses: the camera only turned on the spot: one rotation explains "
            f"{100 * np.median(explained[far]):.0f} % of the matches, so there is no parallax and no depth. "
            f"{_HOW_TO_FILM}"
        )


def is_collapsed(model: Reconstruction) -> bool:
    """Return whether a part of the camera path shrank to a point: its frames see points at depths that no room has.

    Where two parts of a film share few points, the mapper may lose the scale of one of them.
    """
    observations, poses, collapsed = Observations(model), poses_of(model), 0
    for row in observations.rows:
        depth = observations.points_in_camera(row, poses[row])[:, 2]
        if len(depth):
            low, high = np.quantile(np.maximum(depth, 0.0), _DEPTH_QUANTILES)
            collapsed += bool(high > _MOST_DEPTH_RATIO * low)
    return collapsed > _MOST_COLLAPSED_SHARE * len(observations.rows)


def check_model(model: Reconstruction | None, chosen: int, indices: np.ndarray, min_share: float) -> None:
    """Raise `InputError` where too few frames are registered, a part collapsed or angles of triangulation are small."""
    registered = [] if model is None else sorted(i - 1 for i in model.reg_image_ids())
    least = max(MIN_FRAMES, int(np.ceil(min_share * chosen)))
    if len(registered) < least:
        missing = np.delete(np.asarray(indices), registered)
        found = (
            "no pair of frames with enough parallax to start from was found"
            if not registered
            else (
                f"{len(registered)} of {chosen} frames could be registered "
                f"({100 * len(registered) / chosen:.0f} %), {least} are needed"
            )
        )
        part = ""
        if len(registered) >= MIN_FRAMES:
            there = describe_frames(np.asarray(indices)[registered])
            part = f" Frames {there} fit each other: a video of these alone may do."
        raise InputError(
            f"poses: {found}; not registered: frames {describe_frames(missing)}. They are blurred, show too little "
            f"texture, or share too little with the others.{part} {_HOW_TO_FILM}"
        )
    assert model is not None
    if is_collapsed(model):
        raise InputError(
            "poses: parts of the film share too few points to have one scale: one of them shrank to a point. Film "
            "again without fast turns, so that each thing stays in view for a while; or give each part as a video of "
            "its own."
        )
    angle = _median_triangulation_deg(model)
    if angle < _MIN_TRIANGULATION_DEG:
        raise InputError(
            f"poses: the camera hardly moved: points are seen under {angle:.1f} degrees of parallax, "
            f"{_MIN_TRIANGULATION_DEG:.0f} are needed. {_HOW_TO_FILM}"
        )


def explained_share(model: Reconstruction, features: list[Features], pairs: list[VerifiedPair]) -> float:
    """Return the share of the verified matches of registered frames whose Sampson error is at most `_EXPLAINED_PX`.

    A wrong model fits the points that it kept, but not the matches that it dropped.
    """
    import pycolmap

    camera, registered = model.cameras[min(model.cameras)], set(model.reg_image_ids())
    focal, near, total = camera.focal_length, 0, 0
    for pair in pairs:
        i, j = (row + 1 for row in pair.rows)
        if i not in registered or j not in registered:
            continue
        a, b = (
            np.asarray(camera.cam_from_img(features[row].keypoints[own].astype(np.float64)))
            for row, own in zip(pair.rows, pair.matches.T)
        )
        second_from_first = model.image(j).cam_from_world() * model.image(i).cam_from_world().inverse()
        essential = pycolmap.essential_matrix_from_pose(second_from_first)
        error_px = focal * np.sqrt(pycolmap.compute_squared_sampson_error(a, b, essential))
        near, total = near + int((error_px <= _EXPLAINED_PX).sum()), total + len(error_px)
    return near / max(total, 1)


def missing_notes(frames: FrameSet, registered: list[int], parts: np.ndarray) -> list[str]:
    """Describe the keyframes without a pose: one note per reason, with what to do.

    Args:
        frames: all keyframes.
        registered: rows of the registered ones.
        parts: int (n,) connected components of the match graph, from `label_parts`.
    """
    missing = np.setdiff1d(np.arange(len(frames.indices)), registered)
    main = np.bincount(parts[registered]).argmax()
    apart, weak = missing[parts[missing] != main], missing[parts[missing] == main]
    notes = []
    for rows, reason in (
        (
            apart,
            "they share no picture with the rest (a cut, another room, a blocked view). To have all in one "
            "scene, film the way between them too; or give each part as a video of its own",
        ),
        (weak, "they are blurred, show little texture, or too little of what the others show"),
    ):
        if len(rows):
            when = f" ({_times(frames.times_s, rows)})" if frames.ordered else ""
            notes.append(
                f"poses: {len(rows)} of {len(frames.indices)} keyframes were not registered and are dropped: frames "
                f"{describe_frames(frames.indices[rows])}{when}: {reason}"
            )
    return notes


def _times(times_s: np.ndarray, rows: np.ndarray, most: int = 6) -> str:
    """Format the time ranges of runs of rows."""
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 2) + 1)
    text = ", ".join(f"{times_s[run[0]]:.1f}-{times_s[run[-1]]:.1f} s" for run in runs[:most])
    return text + (f" and {len(runs) - most} more" if len(runs) > most else "")


def _pair_motion(features: list[Features], pair: VerifiedPair) -> tuple[float, float, float]:
    """Fit a homography: the median motion in pixels, the inlier share, the largest | |eigenvalue| - 1 |."""
    i, j = pair.rows
    a, b = features[i].keypoints[pair.matches[:, 0]], features[j].keypoints[pair.matches[:, 1]]
    moved = float(np.median(np.linalg.norm(a - b, axis=1)))
    matrix, inliers = fit_homography(features, pair)
    if matrix is None:
        return moved, 0.0, np.inf
    matrix = matrix / np.cbrt(np.linalg.det(matrix))
    return moved, float(inliers.mean()), float(np.abs(np.abs(np.linalg.eigvals(matrix)) - 1).max())


def _median_triangulation_deg(model: Reconstruction) -> float:
    """Return the median over (sampled) points of the largest triangulation angle, degrees; far points do not count."""
    centers = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    angles = []
    for point_id in sorted(model.point3D_ids())[:: max(1, model.num_points3D() // 2000)]:
        point = model.point3D(point_id)
        rays = np.stack([centers[e.image_id] for e in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles.append(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))
    angles = np.degrees(angles)
    near = angles[angles >= _FAR_BELOW_DEG]
    return float(np.median(near)) if len(near) else 0.0


def describe_frames(indices: np.ndarray, most: int = 6) -> str:
    """Format sorted frame numbers (n,) as at most `most` ranges; small gaps do not end a range."""
    numbers = [int(x) for x in indices]
    if not numbers:
        return "none"
    step = max(2, int(np.median(np.diff(numbers))) * 2) if len(numbers) > 1 else 2
    runs = [[numbers[0], numbers[0]]]
    for x in numbers[1:]:
        if x - runs[-1][1] <= step:
            runs[-1][1] = x
        else:
            runs.append([x, x])
    text = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs[:most])
    return text + (f" and {len(runs) - most} more ranges" if len(runs) > most else "")
