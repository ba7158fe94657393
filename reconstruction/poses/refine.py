"""Refine a model: filter outlier points, robust bundle adjustment, deregister weakly constrained frames."""

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from reconstruction.poses.colmap_types import Reconstruction
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.mapping import MAPPER_THREADS

# of the Cauchy loss: SIFT errors in compressed video have heavy tails (measured: halves the camera error)
LOSS_SCALE_PX = 0.5
_MIN_OBSERVATIONS = 15  # points that a frame must observe for a reliable pose
_MIN_SHARED = 30  # points that two frames share to be linked; COLMAP asks as many to register a frame
_ITERATIONS = 40
_TOLERANCE = 1e-5  # of the cost; 1e-6 moves cameras by up to .006 % of their path, their error by 3 %
_ROUGH_ITERATIONS = 8  # before points with a large error are deleted
_RICH_MODEL_FROM_FRAMES = 30  # with fewer frames a second distortion term overfits


def refine_model(model: Reconstruction, config: PosesConfig) -> Reconstruction:
    """Alternate filtering and bundle adjustment, in place; return the model."""
    if config.camera_model == "auto" and model.num_reg_images() >= _RICH_MODEL_FROM_FRAMES:
        _change_camera_model(model, "RADIAL")
    filter_points(model, 1.5 * config.max_point_error_px, 2)
    bundle_adjust(model, iterations=_ROUGH_ITERATIONS)
    filter_points(model, config.max_point_error_px, 2)
    drop_weak_frames(model)
    bundle_adjust(model)
    filter_points(model, config.max_point_error_px, config.min_track_length)
    drop_weak_frames(model)
    return model


def bundle_adjust(
    model: Reconstruction, loss_scale_px: float = LOSS_SCALE_PX, iterations: int = _ITERATIONS
) -> None:
    """Adjust poses, points and intrinsics (without the principal point) under a Cauchy loss, in place."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False  # weakly observable in a room (measured: cameras turn)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale_px
    options.ceres.solver_options.max_num_iterations = iterations
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    options.ceres.solver_options.num_threads = MAPPER_THREADS
    problem = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        problem.add_image(image_id)
    problem.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # `pycolmap.bundle_adjustment` does the same, but logs to the terminal in spite of the log settings.
    pycolmap.create_default_bundle_adjuster(options, problem, model).solve()


def filter_points(model: Reconstruction, max_error_px: float, min_track_length: int) -> None:
    """Delete points with a large mean reprojection error or a short track."""
    model.update_point_3d_errors()
    for point_id in sorted(model.point3D_ids()):
        point = model.point3D(point_id)
        if not point.error <= max_error_px or point.track.length() < min_track_length:
            model.delete_point3D(point_id)


def drop_weak_frames(model: Reconstruction) -> None:
    """Deregister frames that observe too few points."""
    for image_id in sorted(model.reg_image_ids()):
        if model.image(image_id).num_points3D < _MIN_OBSERVATIONS:
            model.deregister_frame(model.image(image_id).frame_id)


def keep_largest_part(model: Reconstruction) -> Reconstruction:
    """Deregister parts of a model that share too few points with the largest part, in place; return the model.

    A handful of points does not fix how parts of a film lie to each other. The global mapper joins parts so, and the
    search for moving things may leave no more between them.
    """
    ids = sorted(model.reg_image_ids())
    row_of = {image_id: row for row, image_id in enumerate(ids)}
    seen = [
        (row_of[element.image_id], column)
        for column, point_id in enumerate(sorted(model.point3D_ids()))
        for element in model.point3D(point_id).track.elements
    ]
    if seen:
        rows, columns = np.unique(np.array(seen), axis=0).T
        sees = coo_array((np.ones(len(rows), np.int32), (rows, columns)), (len(ids), columns.max() + 1))
        for row in np.flatnonzero(~largest_linked_part(sees.tocsr())):
            model.deregister_frame(model.image(ids[row]).frame_id)
    return model


def largest_linked_part(sees: csr_array) -> np.ndarray:
    """Return which frames, bool (n,), are in the largest part whose frames are linked by enough common points.

    Args:
        sees: int32 (n, p), 1 where a frame observes a point.
    """
    _, parts = connected_components((sees @ sees.T) >= _MIN_SHARED, directed=False)
    return parts == np.bincount(parts).argmax()


def _change_camera_model(model: Reconstruction, name: str) -> None:
    """Convert cameras from SIMPLE_RADIAL (f, cx, cy, k) to RADIAL (f, cx, cy, k1, k2)."""
    import pycolmap

    for camera in model.cameras.values():
        if camera.model_name == "SIMPLE_RADIAL":
            params = [*np.asarray(camera.params), 0.0]
            camera.model = getattr(pycolmap.CameraModelId, name)
            camera.params = params
