"""A model from poses that are known already, exactly or roughly: points from our own matches, cameras adjusted."""

import shutil
from pathlib import Path

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import FrameSet
from reconstruction.poses import diagnose, importers, mapping
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features
from reconstruction.poses.importers import ImportedPoses
from reconstruction.poses.matching import matched_database
from reconstruction.poses.pairs import VerifiedPair
from reconstruction.poses.refine import bundle_adjust, filter_points, refine_model
from registry.errors import UsageError
from registry.geometry import split_similarity, umeyama

_JUDGED_PAIRS = 60
_MIN_ROLL_GAIN = 2.0  # another roll must fit this many times better
# How far cameras may be off, step by step: angle of rays in degrees, pixels, scale of the robust loss in pixels.
_ROUGH_STEPS = ((8.0, 40.0, 8.0), (4.0, 16.0, 3.0), (2.0, 6.0, 1.0))


def use_imported(
    imported: ImportedPoses,
    frames: FrameSet,
    features: list[Features],
    config: PosesConfig,
    work_dir: Path,
    progress: Progress,
) -> tuple[object, dict[int, np.ndarray]]:
    """Return a model in the space of the imported cameras, and the cameras that stay as they were, by video frame.

    Raises:
        UsageError: the poses do not fit the pictures.
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


def refine_rough(model: object, database: Path, work_dir: Path, config: PosesConfig) -> object:
    """Triangulate and adjust in turns, ever more strictly: cameras may be off by 3 degrees and 10 cm at first."""
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
    model: object, database: Path, work_dir: Path, config: PosesConfig, angle_deg: float, error_px: float
) -> object:
    """Return the model with all points made anew from the matches, its cameras fixed."""
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


def _keep_place(model: object, imported: ImportedPoses, frames: FrameSet) -> None:
    """Move the adjusted model back onto the imported camera centers: their scale is the truth."""
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
    """Turn all cameras about their optical axis by the quarter that fits the matches best."""
    quarters = [importers.turned_camera(k) for k in range(4)]
    errors = [_epipolar_error(imported, turn, frames, features, pairs) for turn in quarters]
    best = int(np.argmin(errors))
    if best == 0 or errors[0] < _MIN_ROLL_GAIN * errors[best]:
        return imported
    progress.note(f"poses: cameras turned by {90 * best} degrees about their axis, as the pictures ask for")
    turned = {number: pose @ quarters[best] for number, pose in imported.world_from_camera.items()}
    return ImportedPoses(imported.camera, turned, imported.metric, False, imported.notes)


def _epipolar_error(
    imported: ImportedPoses,
    turn: np.ndarray,
    frames: FrameSet,
    features: list[Features],
    pairs: list[VerifiedPair],
) -> float:
    """Return the median distance of matches from their epipolar lines, in focal lengths."""
    errors = []
    known = [
        p for p in pairs if all(int(frames.indices[row]) in imported.world_from_camera for row in p.rows)
    ]
    for pair in known[:: max(1, len(known) // _JUDGED_PAIRS)]:
        a, b = (imported.world_from_camera[int(frames.indices[row])] @ turn for row in pair.rows)
        b_from_a = np.linalg.inv(b) @ a
        x, y = (
            np.column_stack(
                [imported.camera.cam_from_img(features[row].keypoints[k].astype(np.float64)), np.ones(len(k))]
            )
            for row, k in zip(pair.rows, pair.matches.T)
        )
        lines = np.cross(b_from_a[:3, 3], x @ b_from_a[:3, :3].T)
        errors.append(np.median(np.abs((y * lines).sum(1)) / np.maximum(np.hypot(*lines.T[:2]), 1e-12)))
    return float(np.median(errors)) if errors else 0.0
