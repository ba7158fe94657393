"""The ladder of metric scale: the first rung that holds gives metres per sfm unit, with its 1-sigma.

marker of known size -> what the user says -> imported poses in metres -> metric depth backend -> how people
hold cameras.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, ScaleEstimate
from reconstruction.world.config import WorldConfig
from reconstruction.world.floor import Floor
from reconstruction.world.markers import detect_markers, measure_markers
from reconstruction.world.metric_depth import load_backend, metres_per_unit
from reconstruction.world.request import ScaleRequest, parse_scale
from reconstruction.world.samples import SurfaceSamples, choose_frames
from registry.errors import InputError, UsageError
from registry.geometry import invert_rigid

_USER_HEIGHT_SIGMA = 0.04
_USER_DISTANCE_SIGMA = 0.015
_TABLE_SIGMA = 0.30
_SUBJECT_SIGMA = 0.5
_MARKER_SIGMA = 0.003  # of the print, and of reading half a millimetre on a ruler
_IMPORTED_SIGMA = 0.03  # visual-inertial tracking of a phone over a room
_NEIGHBOURS = 6
_SEARCH_PX = 3.0


@dataclass(frozen=True)
class Metres:
    """Metres per sfm unit and where they come from."""

    per_unit: float
    estimate: ScaleEstimate


def find_scale(
    posed: PosedFrames,
    depth: DepthMaps,
    samples: SurfaceSamples,
    floor: Floor,
    config: WorldConfig,
    progress: Progress,
) -> Metres:
    """Climb the ladder; `samples` are upright. A rung that was asked for and does not hold is noted."""
    request = parse_scale(config.scale) if config.scale else None
    eye_height = float(np.median(camera_heights(samples))) - floor.height
    found = _by_marker(posed, config, progress)
    if found is None and request is not None:
        found = _by_user(request, posed, depth, eye_height, floor, progress)
    if found is None and posed.metric:
        detail = "the imported poses are in metres, as the phone's motion tracking measured them"
        found = Metres(1.0, ScaleEstimate("imported-poses", _IMPORTED_SIGMA, detail))
    if found is None:
        backend = load_backend(config)
        if backend is not None:
            per_unit, sigma = metres_per_unit(backend, posed, depth)
            detail = f"median ratio of {backend.name} metric depth to the measured depth"
            found = Metres(per_unit, ScaleEstimate("metric-depth", sigma, detail))
    return found or _by_habit(samples, eye_height, floor, config)


def camera_heights(samples: SurfaceSamples) -> np.ndarray:
    """Return the heights of the sampled cameras, one each (the samples carry them upright)."""
    _, first = np.unique(samples.frames, return_index=True)
    return samples.eyes[first, 2]


def _by_marker(posed: PosedFrames, config: WorldConfig, progress: Progress) -> Metres | None:
    if config.marker_size_m <= 0:
        rows = choose_frames(len(posed.images), 8)
        seen = detect_markers(posed, config.marker_dictionaries[:1], rows)
        sure = sorted(marker_id for (_, marker_id), views in seen.items() if len(views) >= 2)
        if sure:
            progress.note(
                f"world: AprilTag {', '.join(map(str, sure[:5]))} is in view, but its size is not known, "
                "so it gives no scale; say the side of its black square with --marker-size METRES"
            )
        return None
    sides = measure_markers(posed, config.marker_dictionaries)
    if not sides:
        progress.note(
            f"world: no marker of {config.marker_size_m:g} m was found in two or more frames "
            f"(looked for {', '.join(config.marker_dictionaries)}); metres come from the next best source"
        )
        return None
    weights = np.array([1 / s.relative_sigma**2 for s in sides])
    logs = np.log([s.side for s in sides])
    centre = logs[np.argsort(logs)][np.searchsorted(np.cumsum(weights[np.argsort(logs)]), weights.sum() / 2)]
    agree = np.abs(logs - centre) < 0.05
    if not agree.all():
        others = ", ".join(str(s.id) for s, good in zip(sides, agree) if not good)
        progress.note(f"world: markers {others} have another size than the rest and are left out")
    mean = float((weights * logs)[agree].sum() / weights[agree].sum())
    sigma = float(np.sqrt(1 / weights[agree].sum() + _MARKER_SIGMA**2))
    ids = ", ".join(f"{s.dictionary.removeprefix('DICT_')} {s.id}" for s, good in zip(sides, agree) if good)
    detail = f"marker {ids} of {config.marker_size_m:g} m, seen in up to {max(s.views for s in sides)} frames"
    return Metres(config.marker_size_m / float(np.exp(mean)), ScaleEstimate("marker", sigma, detail))


def _by_user(
    request: ScaleRequest,
    posed: PosedFrames,
    depth: DepthMaps,
    eye_height: float,
    floor: Floor,
    progress: Progress,
) -> Metres | None:
    if request.kind == "camera-height":
        if not floor.observed:
            progress.note(
                "world: --scale camera-height needs the floor in view; it is not, so metres are a guess"
            )
            return None
        detail = f"you said that the camera was {request.value_m:g} m above the floor"
        estimate = ScaleEstimate("user-camera-height", _USER_HEIGHT_SIGMA, detail)
        return Metres(request.value_m / eye_height, estimate)
    if request.kind == "distance":
        length, sigma = distance_between_pixels(request, posed, depth)
        detail = f"you said that two points of frame {request.frame} are {request.value_m:g} m apart"
        return Metres(request.value_m / length, ScaleEstimate("user-distance", sigma, detail))
    return None


def _by_habit(samples: SurfaceSamples, eye_height: float, floor: Floor, config: WorldConfig) -> Metres:
    if floor.observed:
        detail = (
            f"people hold a camera about {config.camera_height_prior_m:g} m above the floor; "
            "a marker or --scale makes it sure"
        )
        estimate = ScaleEstimate("camera-height-prior", config.camera_height_sigma, detail)
        return Metres(config.camera_height_prior_m / eye_height, estimate)
    if floor.table:
        above_m = config.camera_height_prior_m - config.table_height_prior_m
        detail = f"no floor in view: the camera is taken to be {above_m:.2f} m above a table top"
        return Metres(above_m / eye_height, ScaleEstimate("camera-height-prior", _TABLE_SIGMA, detail))
    distance = float(np.median(samples.depths))
    detail = (
        f"nothing level in view: things are taken to be filmed from {config.subject_distance_prior_m:g} m"
    )
    estimate = ScaleEstimate("subject-distance-prior", _SUBJECT_SIGMA, detail)
    return Metres(config.subject_distance_prior_m / distance, estimate)


def distance_between_pixels(
    request: ScaleRequest, posed: PosedFrames, depth: DepthMaps
) -> tuple[float, float]:
    """Return the distance in sfm units of two pixels of a video frame, and its relative 1-sigma.

    The frame must be a keyframe or a held-out one; depth comes from the keyframes around it.

    Raises:
        UsageError: no camera is known for the frame, or a pixel lies outside the picture.
        InputError: there is no depth at a pixel.
    """
    indices = np.concatenate([posed.indices, posed.held_out_indices])
    poses = np.concatenate([posed.world_from_camera, posed.held_out_world_from_camera.reshape(-1, 4, 4)])
    hit = np.flatnonzero(indices == request.frame)
    if len(hit) == 0:
        near = sorted(indices[np.argsort(np.abs(indices - request.frame), kind="stable")[:4]].tolist())
        raise UsageError(
            f"--scale distance: frame {request.frame} has no camera (not every frame is used); the nearest "
            f"ones that have are {', '.join(map(str, near))}: read the pixels off one of these"
        )
    width, height = posed.source.width, posed.source.height
    if (width > height) != (posed.camera.width > posed.camera.height):
        width, height = height, width  # the picture as people see it, upright
    view = posed.camera.resized(width, height)
    ends = []
    for x, y in (request.pixels[:2], request.pixels[2:]):
        if not (0 <= x <= width and 0 <= y <= height):
            raise UsageError(
                f"--scale distance: pixel ({x:g}, {y:g}) lies outside the video, which is {width} x {height}"
            )
        z, spread = _depth_at(x, y, view, poses[hit[0]], request.frame, posed, depth)
        point = np.array([(x - view.cx) / view.fx * z, (y - view.cy) / view.fy * z, z])
        ends.append((point, spread))
    length = float(np.linalg.norm(ends[0][0] - ends[1][0]))
    noise = np.hypot(ends[0][1], ends[1][1]) / max(length, 1e-12)
    return length, float(np.hypot(_USER_DISTANCE_SIGMA, noise))


def _depth_at(
    x: float,
    y: float,
    view: Camera,
    world_from_view: np.ndarray,
    frame: int,
    posed: PosedFrames,
    depth: DepthMaps,
) -> tuple[float, float]:
    """Return the z-depth at a pixel and its standard error, from the keyframes around it."""
    view_from_world = invert_rigid(world_from_view)
    rows = np.argsort(np.abs(posed.indices - frame), kind="stable")[:_NEIGHBOURS]
    radius = _SEARCH_PX * max(view.width / depth.camera.width, 1.0)
    found = []
    v, u = np.mgrid[0 : depth.camera.height, 0 : depth.camera.width] + 0.5
    for row in rows:
        z = np.asarray(depth.depth[row], np.float64)
        good = z > 0
        rays = np.stack(
            [(u - depth.camera.cx) / depth.camera.fx, (v - depth.camera.cy) / depth.camera.fy], -1
        )[good]
        points = np.column_stack([rays * z[good][:, None], z[good]])
        view_from_row = view_from_world @ posed.world_from_camera[row]
        points = points @ view_from_row[:3, :3].T + view_from_row[:3, 3]
        points = points[points[:, 2] > 1e-9]
        px = points[:, 0] / points[:, 2] * view.fx + view.cx
        py = points[:, 1] / points[:, 2] * view.fy + view.cy
        found.append(points[np.hypot(px - x, py - y) < radius, 2])
        if posed.indices[row] == frame and len(found[-1]) >= 3:
            found = [found[-1]]  # the frame's own depth is the answer
            break
    near = np.concatenate(found)
    if len(near) == 0:
        raise InputError(
            f"--scale distance: there is no depth at pixel ({x:g}, {y:g}) of frame {frame}; "
            "choose a textured point"
        )
    # The nearest surface hides what is behind it.
    front = near[near < 1.05 * np.quantile(near, 0.1)]
    z = float(np.median(front))
    return z, float(1.4826 * np.median(np.abs(front - z)) / np.sqrt(len(front)) + 0.003 * z)
