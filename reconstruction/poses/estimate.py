"""Stage 2: estimate the camera of each frame by structure from motion, in `sfm` space.

SIFT features, matching of likely pairs, COLMAP's incremental mapper (the global one as the second try), robust bundle
adjustment. Held-out frames are localized against the finished model and never enter it.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import FrameSet, PosedFrames
from reconstruction.poses import diagnose, importers, mapping
from reconstruction.poses.backends import PoseBackend, load_pose_backend
from reconstruction.poses.best_model import best_model
from reconstruction.poses.colmap_types import ColmapCamera, Reconstruction
from reconstruction.poses.components import label_parts
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features, extract_features, match
from reconstruction.poses.focal_length import PLAUSIBLE_FOCAL, estimate_focal_length
from reconstruction.poses.held_out import candidates_in_time, locate_frames
from reconstruction.poses.imported import use_imported
from reconstruction.poses.keypoint_refinement import adjust_to_patches
from reconstruction.poses.matching import consistent_pairs
from reconstruction.poses.pairs import VerifiedPair
from reconstruction.poses.phone_camera import PhoneCamera, find_phone_camera
from reconstruction.poses.refine import filter_points
from reconstruction.poses.undistort import undistort
from reconstruction.poses.zoom import cut_to_part, search_zoom

_DATABASE = "database.db"  # of the mapper, in the work folder
_DEFAULT_FOCAL_SHARE = 1.0  # of the longer image side, where neither metadata nor matches tell


def estimate_poses(
    frames: FrameSet,
    config: PosesConfig,
    *,
    work_dir: Path,
    backend: PoseBackend | None = None,
    progress: Progress = NO_PROGRESS,
) -> PosedFrames:
    """Estimate one camera per frame.

    Args:
        frames: keyframes and held-out frames.
        config: settings; equal settings and frames give equal bits on one machine.
        work_dir: folder for COLMAP's database, models and logs; created, may be deleted afterwards.
        backend: predicts initial cameras; None: the one that `config.backend` names.
        progress: receives steps and notes.

    Returns:
        The registered frames, undistorted, with cameras and sparse points in `sfm` space.

    Raises:
        InputError: the frames cannot be reconstructed; the message says why and what to do.
        UsageError: `config.import_path` cannot be read or does not fit the frames.
    """
    work_dir.mkdir(parents=True, exist_ok=True)
    with mapping.colmap_log(work_dir):
        progress.start(len(frames.images), "features")
        features = extract_features(frames.images, config.max_features, config.contrast_threshold, progress)
        diagnose.check_features(features, frames.indices)
        known: dict[int, np.ndarray] = {}
        metric = False
        export = importers.find_export(Path(frames.source.file))
        poses_from = config.import_path or (frames.source.file if export else "")
        if poses_from:
            imported = importers.read_poses(Path(poses_from), frames)
            for note in imported.notes:
                progress.note(note)
            metric = imported.metric
            model, known = use_imported(imported, frames, features, config, work_dir, progress)
        elif (backend := backend or load_pose_backend(config.backend)) is not None:
            predicted = _predict(backend, frames, progress)
            always = replace(config, refine_imported="always")
            model, known = use_imported(predicted, frames, features, always, work_dir, progress)
        else:
            frames, features, model = _reconstruct(frames, features, config, work_dir, progress)
        phone = PhoneCamera(model)
        if not known and frames.ordered:
            phone = find_phone_camera(model, frames, config, progress)
            filter_points(phone.model, config.max_point_error_px, config.min_track_length)
            diagnose.check_model(phone.model, len(frames.images), frames.indices, config.min_registered_share)
        elif not known:
            phone = PhoneCamera(adjust_to_patches(model, frames.images, config, progress))
        registered = sorted(i - 1 for i in phone.model.reg_image_ids())
        held_out = _locate_held_out(frames, features, phone, registered, known, config, progress)
    matched = [len(of_frame.keypoints) for of_frame in features]
    return replace(_package(frames, phone, registered, held_out, matched), metric=metric)


def _predict(backend: PoseBackend, frames: FrameSet, progress: Progress) -> importers.ImportedPoses:
    """Return the backend's cameras as imported poses; the camera model has a distortion term, initially 0."""
    import pycolmap

    progress.note(f"poses: first cameras are predicted by {backend.name}, then adjusted to our own matches")
    predicted = backend.predict(frames.images)
    height, width = frames.images.shape[1:3]
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", predicted.focal_px, width, height)
    poses = {int(index): pose for index, pose in zip(frames.indices, predicted.world_from_camera)}
    return importers.ImportedPoses(camera, poses)


def initial_camera(frames: FrameSet, config: PosesConfig) -> ColmapCamera:
    """Return the camera that all frames share, its focal length from metadata or the default."""
    import pycolmap

    height, width = frames.images.shape[1:3]
    low, high = (share * max(width, height) for share in PLAUSIBLE_FOCAL)
    known = low <= frames.focal_prior_px <= high
    focal = frames.focal_prior_px if known else _DEFAULT_FOCAL_SHARE * max(width, height)
    name = "SIMPLE_RADIAL" if config.camera_model == "auto" else config.camera_model
    camera = pycolmap.Camera.create_from_model_name(1, name, focal, width, height)
    camera.has_prior_focal_length = known
    return camera


def _reconstruct(
    frames: FrameSet, features: list[Features], config: PosesConfig, work_dir: Path, progress: Progress
) -> tuple[FrameSet, list[Features], Reconstruction]:
    """Run structure from motion; return the frames with one focal length, their features, and the refined model."""
    camera = initial_camera(frames, config)
    pairs = consistent_pairs(frames, features, camera, config, progress)
    diagnose.check_motion(features, pairs, (camera.width, camera.height))
    if not camera.has_prior_focal_length:
        camera.focal_length = estimate_focal_length(pairs, camera.width, camera.height) or camera.focal_length
    with ThreadPoolExecutor(1) as beside:  # the mapper uses one core
        search = beside.submit(search_zoom, frames, features, pairs, camera, config, work_dir)
        models = _map(features, pairs, camera, config, work_dir, progress)
    if (part := search.result()) is not None:
        frames, features, pairs = cut_to_part(part, frames, features, pairs, progress)
        models = _map(features, pairs, camera, config, work_dir, progress)
    chosen = len(frames.images)
    parts = label_parts(chosen, pairs)
    connected = int((parts == 0).sum())
    model = best_model(models, features, pairs, camera, connected, config, work_dir / _DATABASE, progress)
    diagnose.check_model(model, chosen, frames.indices, config.min_registered_share)
    assert model is not None
    for note in diagnose.missing_notes(frames, [i - 1 for i in model.reg_image_ids()], parts):
        progress.note(note)
    return frames, features, model


def _map(
    features: list[Features], pairs: list[VerifiedPair], camera: ColmapCamera, config: PosesConfig, work_dir: Path,
    progress: Progress,
) -> list[Reconstruction]:  # fmt: skip
    """Return the models of the incremental mapper, largest first; the database of the frames stays in `work_dir`."""
    database = work_dir / _DATABASE
    database.unlink(missing_ok=True)
    mapping.write_database(database, camera, features, pairs)
    progress.start(len(features), "mapping")
    return mapping.incremental_models(database, features, pairs, camera, config, progress)


def _locate_held_out(
    frames: FrameSet,
    features: list[Features],
    phone: PhoneCamera,
    registered: list[int],
    known: dict[int, np.ndarray],
    config: PosesConfig,
    progress: Progress,
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Localize held-out frames whose pose is not `known`.

    Returns:
        Held-out row, world_from_camera (4, 4) and the principal point's offset (2,) of all with a pose.
    """
    total = len(frames.held_out_images)
    rows = [row for row in range(total) if int(frames.held_out_indices[row]) not in known]
    progress.start(len(rows), "held-out frames")
    images = frames.held_out_images[rows]
    queries = extract_features(images, config.max_features, config.contrast_threshold, NO_PROGRESS)
    rough = None
    if frames.ordered:
        times_s = frames.held_out_times_s[rows]
        if phone.offsets is not None:
            rows_of = sorted(phone.offsets)
            known_s, at = frames.times_s[rows_of], np.array([phone.offsets[row] for row in rows_of])
            rough = np.stack([np.interp(times_s, known_s, axis) for axis in at.T], axis=1)
        candidates = [candidates_in_time(frames.times_s, registered, time_s) for time_s in times_s]
    else:
        candidates = [_most_alike(query, features, registered) for query in queries]
    located = dict(
        zip(rows, locate_frames(queries, candidates, features, phone.model, config, progress, rough))
    )
    for row in set(range(total)) - set(rows):
        located[row] = known[int(frames.held_out_indices[row])], np.zeros(2)
    failed = [row for row in range(total) if located[row] is None]
    if failed:
        progress.note(
            f"poses: {len(failed)} of {total} held-out frames could not be located and are not evaluated: "
            f"frames {diagnose.describe_frames(frames.held_out_indices[failed])}"
        )
    return [(row, *found) for row in range(total) if (found := located[row]) is not None]


def _most_alike(query: Features, features: list[Features], registered: list[int]) -> list[int]:
    """Rank registered rows by the number of mutual matches of strong features with the query."""
    strong = query.descriptors[:512]
    counts = np.array([len(match(strong, features[row].descriptors[:512])) for row in registered])
    return [registered[i] for i in np.argsort(-counts, kind="stable")]


def _package(
    frames: FrameSet,
    phone: PhoneCamera,
    registered: list[int],
    held_out: list[tuple[int, np.ndarray, np.ndarray]],
    matched: list[int],
) -> PosedFrames:
    """Undo rolling shutter, moving crop and distortion of the images; collect poses, points and observations.

    Of each row's keypoints the first `matched` are features. Observations of others, which aligned patches added, are
    left out: later stages choose frames by what these share, and not every frame was asked.
    """
    model, offsets, shutter = phone.model, phone.offsets, phone.shutter
    poses = mapping.poses_of(model)
    point_ids = sorted(model.point3D_ids())
    frame_row = {row + 1: new for new, row in enumerate(registered)}
    observations = [
        (frame_row[element.image_id], point_row)
        for point_row, point_id in enumerate(point_ids)
        for element in model.point3D(point_id).track.elements
        if element.image_id in frame_row and element.point2D_idx < matched[element.image_id - 1]
    ]
    observations = np.array(sorted(set(observations)), np.int32).reshape(-1, 2)
    points = np.array([model.point3D(i).xyz for i in point_ids], np.float64).reshape(-1, 3)
    errors = np.array([model.point3D(i).error for i in point_ids], np.float32)
    colors = _point_colors(model, point_ids, frames.images)
    held_rows = [row for row, _, _ in held_out]
    recorded = [frames.images[registered], frames.held_out_images[held_rows]]
    if shutter is not None:
        times = frames.times_s[registered], frames.held_out_times_s[held_rows]
        recorded = [shutter.straightened(images, at) for images, at in zip(recorded, times)]
    moved = None
    if offsets is not None:
        moved = [np.stack([offsets[row] for row in registered])]
        moved.append(np.array([offset for _, _, offset in held_out]).reshape(-1, 2))
    camera, (images, held_out_images), distorted = undistort(
        model.cameras[min(model.cameras)], recorded, moved
    )
    return PosedFrames(
        source=frames.source,
        camera=camera,
        images=images,
        indices=frames.indices[registered],
        times_s=frames.times_s[registered],
        world_from_camera=np.stack([poses[row] for row in registered]),
        sharpness=frames.sharpness[registered],
        held_out_images=held_out_images,
        held_out_indices=frames.held_out_indices[held_rows],
        held_out_times_s=frames.held_out_times_s[held_rows],
        held_out_world_from_camera=np.array([pose for _, pose, _ in held_out], np.float64).reshape(-1, 4, 4),
        points=points,
        point_colors=colors,
        point_errors_px=errors,
        observations=observations,
        chosen_frames=len(frames.images),
        ordered=frames.ordered,
        reprojection_error_px=float(model.compute_mean_reprojection_error()),
        distorted=distorted,
        principal_offsets=None if moved is None else np.concatenate(moved),
    )


def _point_colors(model: Reconstruction, point_ids: list[int], images: np.ndarray) -> np.ndarray:
    """Return the mean color uint8 (p, 3) of each point over its observations."""
    height, width = images.shape[1:3]
    out = np.zeros((len(point_ids), 3), np.uint8)
    keypoints = {i: np.array([p.xy for p in model.image(i).points2D]) for i in model.reg_image_ids()}
    for row, point_id in enumerate(point_ids):
        colors = []
        for element in model.point3D(point_id).track.elements:
            x, y = keypoints[element.image_id][element.point2D_idx]
            colors.append(images[element.image_id - 1, min(int(y), height - 1), min(int(x), width - 1)])
        out[row] = np.mean(colors, axis=0).round()
    return out
