"""Structure from motion by COLMAP: a database of verified pairs in, models out."""

import contextlib
import copy
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.poses import first_pair
from reconstruction.poses.colmap_types import ColmapCamera, Reconstruction
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features
from reconstruction.poses.pairs import VerifiedPair
from reconstruction.poses.parallel import ordered_map

# With more threads, Ceres sums in an order that changes from run to run, and so do the last bits of poses.
MAPPER_THREADS = 1

# Triangulation angle that a point needs. Points with small angles fix the rotation of a camera that hardly moves while
# it turns; with COLMAP's default of 1.5 degrees the model ends where such a turn begins.
_MIN_ANGLE_DEG = 0.5
_MOST_TRIES = 8  # pairs to start from, of all models together


@contextlib.contextmanager
def colmap_log(folder: Path) -> Iterator[None]:
    """Redirect COLMAP's log from the terminal to files in `folder` while the block runs."""
    import pycolmap

    # Importing pycolmap installs a SIGTERM handler that prints a stack trace; killing a run is no crash.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    log = pycolmap.logging
    names = ("alsologtostderr", "logtostderr", "logtostdout", "stderrthreshold")
    before = {name: getattr(log, name) for name in names}
    log.alsologtostderr = log.logtostderr = log.logtostdout = False
    log.stderrthreshold = int(log.Level.FATAL)
    for level in (log.Level.INFO, log.Level.WARNING, log.Level.ERROR):
        log.set_log_destination(level, folder / f"colmap_{level.name.lower()}_")
    try:
        yield
    finally:
        for level in (log.Level.INFO, log.Level.WARNING, log.Level.ERROR):
            log.set_log_destination(level, "")  # the folder may be deleted from here on
        for name, value in before.items():
            setattr(log, name, value)


def frame_name(row: int) -> str:
    """Return the name of a keyframe inside COLMAP; names sort by row."""
    return f"{row:05d}.png"


def write_database(
    path: Path,
    camera: ColmapCamera,
    features: list[Features],
    pairs: list[VerifiedPair],
    *,
    own_cameras: bool = False,
) -> None:
    """Write the database that the mapper reads; image and frame ids are row + 1.

    `own_cameras`: each image has a pinhole camera of its own with the size and focal length of `camera`.
    """
    import pycolmap

    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for row, feature in enumerate(features):
            if own_cameras:
                camera = pycolmap.Camera.create_from_model_name(
                    row + 1, "SIMPLE_PINHOLE", camera.focal_length, camera.width, camera.height
                )
            if own_cameras or row == 0:
                camera.camera_id = database.write_camera(camera)
                rig = pycolmap.Rig()
                rig.add_ref_sensor(camera.sensor_id)
                rig.rig_id = database.write_rig(rig)
            image = pycolmap.Image(name=frame_name(row), camera_id=camera.camera_id, image_id=row + 1)
            image.image_id = database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame()
            frame.frame_id = row + 1
            frame.rig_id = rig.rig_id
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(row + 1, feature.keypoints)
        for pair in pairs:
            i, j = pair.rows
            database.write_matches(i + 1, j + 1, pair.matches)
            geometry = copy.copy(pair.geometry)  # two databases of the same pairs may be written at once
            geometry.inlier_matches = pair.matches
            database.write_two_view_geometry(i + 1, j + 1, geometry)


def incremental_models(
    database: Path, features: list[Features], pairs: list[VerifiedPair], camera: ColmapCamera, config: PosesConfig,
    progress: Progress,
) -> list[Reconstruction]:  # fmt: skip
    """Run the incremental mapper; return its models, largest first.

    Each model starts from a pair of frames whose relative pose is sure (`rank_starts`). The next one starts among the
    frames left, if they are more than the largest model has.

    Args:
        database: of these features and pairs; models are written beside it.
        features: of the frames.
        pairs: of the frames, verified.
        camera: with a first focal length.
        config: seed and number of inliers.
        progress: receives a step for each frame.
    """
    output = database.parent / "incremental"
    output.mkdir(parents=True, exist_ok=True)
    total, models, done, tries = len(features), [], 0, 0
    left, starts = set(range(total)), first_pair.rank_starts(features, pairs, camera, config.seed)
    while starts and tries < _MOST_TRIES and len(left) > max((m.num_reg_images() for m in models), default=0):
        start, tries = starts[0], tries + 1
        model = _incremental_model(database, output, config, start, lambda: progress.advance())
        if model is None:
            starts = starts[1:]
            continue
        models.append(model)
        done += model.num_reg_images()
        left -= {i - 1 for i in model.reg_image_ids()}
        pairs = [pair for pair in pairs if left.issuperset(pair.rows)]
        starts = first_pair.rank_starts(features, pairs, camera, config.seed)
    progress.advance(max(total - done, 0))
    return _by_size(models)


def models_along_film(
    database: Path, features: list[Features], pairs: list[VerifiedPair], camera: ColmapCamera, config: PosesConfig,
    progress: Progress,
) -> list[Reconstruction]:  # fmt: skip
    """Run the incremental mapper from pairs all along the film, each time among all frames; return one model a start.

    Arguments as of `incremental_models`; `progress` receives a step for each start.
    """
    starts = first_pair.starts_along_film(features, pairs, camera, config.seed)

    def model_of(start: tuple[int, int]) -> Reconstruction | None:
        output = database.parent / f"from_{start[0]}_{start[1]}"
        output.mkdir(parents=True, exist_ok=True)
        own = shutil.copy(database, output)  # one that others open at the same time may not open
        return _incremental_model(Path(own), output, config, start, lambda: None)

    progress.start(len(starts), "mapping from other starts")
    models = []
    for model in ordered_map(model_of, starts):
        models += [] if model is None else [model]
        progress.advance()
    return models


def _incremental_model(
    database: Path,
    output: Path,
    config: PosesConfig,
    start: tuple[int, int],
    one_more: Callable[[], None],
) -> Reconstruction | None:
    """Run the incremental mapper from a pair of frames; return its model, None where the pair does not start one."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = MAPPER_THREADS
    options.random_seed = config.seed
    options.min_num_matches = config.min_inliers
    options.extract_colors = False
    options.multiple_models = False
    options.min_model_size = 5
    options.init_image_id1, options.init_image_id2 = start[0] + 1, start[1] + 1
    options.mapper.init_min_num_inliers = first_pair.MIN_INLIERS
    options.mapper.init_min_tri_angle = first_pair.MIN_ANGLE_DEG
    options.mapper.filter_min_tri_angle = options.triangulation.min_angle = _MIN_ANGLE_DEG
    # Coarse bundle adjustment while the model grows: `refine_model` follows (measured: same cameras, half the time).
    options.ba_global_frames_ratio = 2.0
    options.ba_global_points_ratio = 2.0
    options.ba_global_max_num_iterations = 12
    options.ba_global_max_refinements = 1
    options.ba_local_max_num_iterations = 8
    options.ba_local_max_refinements = 1
    options.mapper.abs_pose_max_error = 8.0

    def first_two() -> None:
        one_more()
        one_more()

    callbacks: Any = {"initial_image_pair_callback": first_two, "next_image_callback": one_more}
    models = _by_size(
        list(pycolmap.incremental_mapping(database, database.parent, output, options, **callbacks).values())
    )
    return models[0] if models else None


def global_models(database: Path, config: PosesConfig) -> list[Reconstruction]:
    """Run the global mapper; return its models, largest first."""
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = MAPPER_THREADS
    options.random_seed = config.seed
    options.min_num_matches = config.min_inliers
    output = database.parent / "global"
    output.mkdir(parents=True, exist_ok=True)
    return _by_size(list(pycolmap.global_mapping(database, database.parent, output, options).values()))


def _by_size(models: list[Reconstruction]) -> list[Reconstruction]:
    return sorted(models, key=lambda m: (-m.num_reg_images(), -m.num_points3D()))


def poses_of(model: Reconstruction) -> dict[int, np.ndarray]:
    """Return world_from_camera float64 (4, 4) of the registered images, by frame row."""
    out = {}
    for image_id in sorted(model.reg_image_ids()):
        camera_from_world = np.eye(4)
        camera_from_world[:3] = model.image(image_id).cam_from_world().matrix()
        out[image_id - 1] = np.linalg.inv(camera_from_world)
    return out
