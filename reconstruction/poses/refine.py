"""The last word on a model: outliers out, a robust bundle adjustment, weak frames out."""

import numpy as np

from reconstruction.poses.config import PosesConfig
from reconstruction.poses.mapping import MAPPER_THREADS

_LOSS_SCALE_PX = 0.5  # Cauchy: SIFT in compressed video has heavy tails (measured: halves the camera error)
_MIN_OBSERVATIONS = 15  # a frame that sees fewer points has no trustworthy pose
_RICH_MODEL_FROM_FRAMES = 30  # with fewer frames a second distortion term is fitted to noise


def refine_model(model: object, config: PosesConfig) -> object:
    """Filter, adjust and filter again, in place; return the model."""
    if config.camera_model == "auto" and model.num_reg_images() >= _RICH_MODEL_FROM_FRAMES:
        _change_camera_model(model, "RADIAL")
    filter_points(model, 1.5 * config.max_point_error_px, 2)
    bundle_adjust(model)
    filter_points(model, config.max_point_error_px, 2)
    drop_weak_frames(model)
    bundle_adjust(model)
    filter_points(model, config.max_point_error_px, config.min_track_length)
    drop_weak_frames(model)
    return model


def bundle_adjust(model: object, loss_scale_px: float = _LOSS_SCALE_PX) -> None:
    """Adjust cameras, points and intrinsics under a Cauchy loss."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False  # weakly observed in a room; measured to turn the cameras
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale_px
    options.ceres.solver_options.max_num_iterations = 40
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = MAPPER_THREADS
    problem = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        problem.add_image(image_id)
    problem.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # `pycolmap.bundle_adjustment` would do the same, but logs to the terminal whatever the log settings are.
    pycolmap.create_default_bundle_adjuster(options, problem, model).solve()


def filter_points(model: object, max_error_px: float, min_track_length: int) -> None:
    """Delete points with a large mean error or a short track."""
    model.update_point_3d_errors()
    bad = [
        i
        for i in sorted(model.point3D_ids())
        if not model.point3D(i).error <= max_error_px or model.point3D(i).track.length() < min_track_length
    ]
    for point_id in bad:
        model.delete_point3D(point_id)


def drop_weak_frames(model: object) -> None:
    """Deregister frames whose pose hangs on too few points."""
    for image_id in sorted(model.reg_image_ids()):
        if model.image(image_id).num_points3D < _MIN_OBSERVATIONS:
            model.deregister_frame(model.image(image_id).frame_id)


def _change_camera_model(model: object, name: str) -> None:
    """Go from SIMPLE_RADIAL (f, cx, cy, k) to RADIAL (f, cx, cy, k1, k2)."""
    import pycolmap

    for camera in model.cameras.values():
        if camera.model_name == "SIMPLE_RADIAL":
            params = [*np.asarray(camera.params), 0.0]
            camera.model = getattr(pycolmap.CameraModelId, name)
            camera.params = params
