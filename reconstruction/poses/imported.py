"""Build a model from known poses, exact or approximate: triangulate our own matches, refine the cameras."""

import shutil
from pathlib import Path

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import FrameSet
from reconstruction.poses import diagnose, importers, mapping
from reconstruction.poses.colmap_types import Reconstruction
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features
from reconstruction.poses.importers import ImportedPoses
from reconstruction.poses.matching import matched_database
from reconstruction.poses.pairs import VerifiedPair
from reconstruction.poses.refine import bundle_adjust, filter_points, refine_model
from registry.errors import UsageError
from registry.geometry import split_similarity, umeyama

_JUDGED_PAIRS = 60  # sampled for the epipolar error of each roll
_MIN_ROLL_GAIN = 2.0  # least ratio of epipolar errors at which the roll is changed
# Tolerances of the rounds of refinement: ray angle in degrees, reprojection error and loss scale in pixels.
_ROUGH_STEPS = ((8.0, 40.0, 8.0), (4.0, 16.0, 3.0), (2.0, 6.0, 1.0))


def use_imported(
    imported: ImportedPoses,
    frames: FrameSet,
    features: list[Features],
    config: PosesConfig,
    work_dir: Path,
    progress: Progress,
) -> tuple[Reconstruction, dict[int, np.ndarray]]:
    """Triangulate into the imported cameras: the model in their space, and the unrefined poses by video frame.

    Raises:
        UsageError: the poses do not fit the images.
    """
    database = work_dir / "database.db"
    pairs = matched_database(frames, features, imported.camera, config, database, progress)
    if imported.roll_unknown:
        imported = _with_best_roll(imported, frames, features, pairs, progress)
    refine = config.refine_imported == "always" or (config.refine_imported == "auto" and imported.metric)
    model = importers.model_from_poses(imported, frames, features, database)
    if refine:
        model = refine_rough(model, database, work_dir, config)
        _keep_place(model, imported, frames)
    else:
        model = _triangulate(model, database, work_dir, config, 2.0, 4.0)
    importers.check_consistency(model, config)
    registered = [i - 1 for i in model.reg_image_ids()]
    for note in diagnose.missing_notes(frames, registered, np.zeros(len(frames.images), int)):
        progress.note(note)
    return model, {} if refine else imported.world_from_camera


def refine_rough(
    model: Reconstruction, database: Path, work_dir: Path, config: PosesConfig
) -> Reconstruction:
    """Alternate triangulation and bundle adjustment with shrinking tolerances; initial errors may be 3 deg, 10 cm."""
    for angle_deg, error_px, loss_px in _ROUGH_STEPS:
        model = _triangulate(model, database, work_dir, config, angle_deg, error_px)
        if model.num_points3D() < 50:
            raise UsageError(
                f"poses: only {model.num_points3D()} points agree with the given cameras; they do not fit these "
                "frames (wrong video, wrong frame numbers, or another axis convention)"
            )
        bundle_adjust(model, loss_px)
    model = _triangulate(model, database, work_dir, config, 2.0, 4.0)
    return refine_model(model, config)


def _triangulate(
    model: Reconstruction,
    database: Path,
    work_dir: Path,
    config: PosesConfig,
    angle_deg: float,
    error_px: float,
) -> Reconstruction:
    """Triangulate all points anew from the matches, with fixed cameras."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = mapping.MAPPER_THREADS
    options.random_seed = config.seed
    options.extract_colors = False
    options.min_num_matches = config.min_inliers
    options.mapper.filter_max_reproj_error = error_px
    options.triangulation.create_max_angle_error = angle_deg
    options.triangulation.continue_max_angle_error = angle_deg
    options.triangulation.merge_max_reproj_error = error_px
    options.triangulation.complete_max_reproj_error = error_px
    output = work_dir / "triangulated"
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    model = pycolmap.triangulate_points(model, database, work_dir, output, True, options)
    filter_points(model, error_px, 2)
    return model


def _keep_place(model: Reconstruction, imported: ImportedPoses, frames: FrameSet) -> None:
    """Align the refined model in place to the imported camera centers by a similarity; their scale is trusted."""
    import pycolmap

    poses = mapping.poses_of(model)
    ours = np.stack([pose[:3, 3] for pose in poses.values()])
    given = np.stack([imported.world_from_camera[int(frames.indices[row])][:3, 3] for row in poses])
    scale, rotation, shift = split_similarity(umeyama(ours, given))
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), shift))


def _with_best_roll(
    imported: ImportedPoses,
    frames: FrameSet,
    features: list[Features],
    pairs: list[VerifiedPair],
    progress: Progress,
) -> ImportedPoses:
    """Turn all cameras about their optical axes by the multiple of 90 degrees with the least epipolar error."""
    quarters = [importers.turned_camera(k) for k in range(4)]
    errors = [_epipolar_error(imported, turn, frames, features, pairs) for turn in quarters]
    best = int(np.argmin(errors))
    if best == 0 or errors[0] < _MIN_ROLL_GAIN * errors[best]:
        return imported
    progress.note(
        f"poses: cameras turned by {90 * best} degrees about their optical axes, to fit the matches"
    )
    turned = {number: pose @ quarters[best] for number, pose in imported.world_from_camera.items()}
    return ImportedPoses(imported.camera, turned, imported.metric, False, imported.notes)


def _epipolar_error(
    imported: ImportedPoses,
    turn: np.ndarray,
    frames: FrameSet,
    features: list[Features],
    pairs: list[VerifiedPair],
) -> float:
    """Return the median distance of matches to their epipolar lines, in normalized image coordinates."""
    errors = []
    poses = imported.world_from_camera
    known = [pair for pair in pairs if all(int(frames.indices[row]) in poses for row in pair.rows)]
    for pair in known[:: max(1, len(known) // _JUDGED_PAIRS)]:
        a, b = (poses[int(frames.indices[row])] @ turn for row in pair.rows)
        b_from_a = np.linalg.inv(b) @ a
        pixels = [features[row].keypoints[k].astype(np.float64) for row, k in zip(pair.rows, pair.matches.T)]
        rays = (np.asarray(imported.camera.cam_from_img(p)) for p in pixels)
        x, y = (np.column_stack([r, np.ones(len(r))]) for r in rays)
        lines = np.cross(b_from_a[:3, 3], x @ b_from_a[:3, :3].T)
        errors.append(np.median(np.abs((y * lines).sum(1)) / np.maximum(np.hypot(*lines.T[:2]), 1e-12)))
    return float(np.median(errors)) if errors else 0.0
