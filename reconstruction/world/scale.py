"""Estimate metres per `sfm` unit from the first available source, in this order.

Marker of known size, length given by the user, imported metric poses, metric depth backend, priors on how people film
(and, if asked for, on furniture and rooms).
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, ScaleEstimate
from reconstruction.world.config import WorldConfig
from reconstruction.world.floor import Floor
from reconstruction.world.markers import detect_markers, measure_markers
from reconstruction.world.metric_depth import load_backend, metres_per_unit
from reconstruction.world.posterior import infer_scale
from reconstruction.world.request import ScaleRequest, parse_scale
from reconstruction.world.samples import SurfaceSamples, choose_frames
from reconstruction.world.supports import highest_point, measure_supports
from registry.errors import InputError, UsageError
from registry.geometry import invert_rigid

# Relative standard deviations of the sources.
_USER_HEIGHT_SIGMA = 0.04
_USER_DISTANCE_SIGMA = 0.015
CAMERA_SIGMA = 0.2  # of the camera height beside other evidence; chosen like the constants of `posterior`
_TABLE_SIGMA = 0.30
_SUBJECT_SIGMA = 0.5
_MARKER_SIGMA = 0.003  # of the print, and of reading half a millimetre on a ruler
_IMPORTED_SIGMA = 0.03  # visual-inertial tracking of a phone over a room
_NEIGHBOURS = 6  # keyframes that give depth at a pixel
_SEARCH_PX = 3.0  # search radius around a pixel, at depth resolution


@dataclass(frozen=True)
class Metres:
    """Metres per `sfm` unit, and the source of that scale."""

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
    """Estimate the scale; `samples` and `floor` are upright. Requested sources that fail are noted."""
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
    return found or _by_prior(samples, eye_height, floor, config, progress)


def camera_heights(samples: SurfaceSamples) -> np.ndarray:
    """Return the height (k,) of each sampled camera; `samples` are upright."""
    _, first = np.unique(samples.frames, return_index=True)
    return samples.eyes[first, 2]


def _by_marker(posed: PosedFrames, config: WorldConfig, progress: Progress) -> Metres | None:
    """Return the scale from markers, None if there are none; notes a marker in view whose size is not given."""
    if config.marker_size_m <= 0:
        rows = choose_frames(len(posed.images), 8)
        seen = detect_markers(posed.images, config.marker_dictionaries[:1], rows)
        sure = sorted(marker_id for (_, marker_id), views in seen.items() if len(views) >= 2)
        if sure:
            progress.note(
                f"world: AprilTag {', '.join(map(str, sure[:5]))} is in view, but its size is not known; "
                "to use it for the scale, give the side of its black square with --marker-size METRES"
            )
        return None
    sides = measure_markers(posed, config.marker_dictionaries)
    if not sides:
        progress.note(
            f"world: no marker was found in two or more frames "
            f"(looked for {', '.join(config.marker_dictionaries)}); the scale comes from the next best source"
        )
        return None
    weights = np.array([1 / s.relative_sigma**2 for s in sides])
    logs = np.log([s.side for s in sides])
    centre = np.quantile(logs, 0.5, weights=weights, method="inverted_cdf")
    agree = np.abs(logs - centre) < 0.05
    if not agree.all():
        others = ", ".join(str(s.id) for s, good in zip(sides, agree) if not good)
        progress.note(f"world: markers {others} differ in size from the others and are ignored")
    mean = float((weights * logs)[agree].sum() / weights[agree].sum())
    sigma = float(np.sqrt(1 / weights[agree].sum() + _MARKER_SIGMA**2))
    ids = ", ".join(f"{s.dictionary.removeprefix('DICT_')} {s.id}" for s, good in zip(sides, agree) if good)
    detail = f"marker {ids} of {config.marker_size_m:g} m, seen in up to {max(s.views for s in sides)} frames"
    return Metres(config.marker_size_m / float(np.exp(mean)), ScaleEstimate("marker", sigma, detail))


def _by_user(
    request: ScaleRequest, posed: PosedFrames, depth: DepthMaps, eye_height: float, floor: Floor, progress: Progress
) -> Metres | None:  # fmt: skip
    """Return the scale from `--scale`; None for an object, whose height is not known yet, or without a floor."""
    if request.kind == "camera-height":
        if not floor.observed:
            progress.note(
                "world: --scale camera-height needs the floor in view, but no floor was found; the scale comes from "
                "the next best source"
            )
            return None
        detail = f"--scale: the camera was {request.value_m:g} m above the floor"
        estimate = ScaleEstimate("user-camera-height", _USER_HEIGHT_SIGMA, detail)
        return Metres(request.value_m / eye_height, estimate)
    if request.kind == "distance":
        length, sigma = distance_between_pixels(request, posed, depth)
        detail = f"--scale: two points of frame {request.frame} are {request.value_m:g} m apart"
        return Metres(request.value_m / length, ScaleEstimate("user-distance", sigma, detail))
    return None


def _by_prior(
    samples: SurfaceSamples, eye_height: float, floor: Floor, config: WorldConfig, progress: Progress
) -> Metres:
    """Return the scale from priors: usual sizes if asked for, or camera height over floor or table, or distance."""
    if floor.observed and config.usual_sizes:
        return _by_furniture(samples, eye_height, floor, config, progress)
    if floor.observed:
        detail = (
            f"the camera is assumed {config.camera_height_prior_m:g} m above the floor; "
            "a marker or --scale gives a certain scale"
        )
        estimate = ScaleEstimate("camera-height-prior", config.camera_height_sigma, detail)
        return Metres(config.camera_height_prior_m / eye_height, estimate)
    if floor.table:
        above_m = config.camera_height_prior_m - config.table_height_prior_m
        detail = f"no floor in view: the camera is assumed {above_m:.2f} m above a table top"
        return Metres(above_m / eye_height, ScaleEstimate("camera-height-prior", _TABLE_SIGMA, detail))
    distance = float(np.median(samples.depths))
    detail = (
        f"no level surface in view: the filmed surface is assumed {config.subject_distance_prior_m:g} m away"
    )
    estimate = ScaleEstimate("subject-distance-prior", _SUBJECT_SIGMA, detail)
    return Metres(config.subject_distance_prior_m / distance, estimate)


def _by_furniture(
    samples: SurfaceSamples, eye_height: float, floor: Floor, config: WorldConfig, progress: Progress
) -> Metres:
    """Return the scale from the posterior of `infer_scale`; notes the part of every surface in it."""
    supports = measure_supports(samples, floor.height, eye_height)
    found = infer_scale(
        eye_height,
        supports,
        highest_point(samples, floor.height),
        camera_height_m=config.camera_height_prior_m,
        camera_sigma=CAMERA_SIGMA,
    )
    seen = [
        f"{found.per_unit * surface.height:.2f} m high: {name} ({100 * share:.0f} %)"
        for surface, (name, share) in zip(supports, found.parts)
    ]
    progress.note(
        f"world: the scale is a guess between {100 * (found.low / found.per_unit - 1):+.0f} and "
        f"{100 * (found.high / found.per_unit - 1):+.0f} % (68 % interval), from the camera's height, "
        f"{found.per_unit * eye_height:.2f} m"
        + ("; level surfaces " + "; ".join(seen) if seen else "; no level surface above the floor")
        + ("; the highest seen point, which should lie below a ceiling" if found.ceiling_counts else "")
    )
    detail = "camera, furniture and room are taken for usual; a marker or --scale gives a certain scale"
    return Metres(found.per_unit, ScaleEstimate("usual-sizes", found.sigma, detail))


def distance_between_pixels(
    request: ScaleRequest, posed: PosedFrames, depth: DepthMaps
) -> tuple[float, float]:
    """Return the distance in `sfm` units between two pixels of a frame, and its relative standard deviation.

    The frame must be a keyframe or a held-out frame; depth comes from the nearest keyframes in time.

    Raises:
        UsageError: no camera is known for the frame, or a pixel is outside of the image.
        InputError: there is no depth at a pixel.
    """
    indices = np.concatenate([posed.indices, posed.held_out_indices])
    poses = np.concatenate([posed.world_from_camera, posed.held_out_world_from_camera.reshape(-1, 4, 4)])
    hit = np.flatnonzero(indices == request.frame)
    if len(hit) == 0:
        near = sorted(indices[np.argsort(np.abs(indices - request.frame), kind="stable")[:4]].tolist())
        raise UsageError(
            f"--scale distance: frame {request.frame} has no camera (not every frame is used); the nearest "
            f"ones that have are {', '.join(map(str, near))}: take the pixels from one of these"
        )
    width, height = posed.source.width, posed.source.height
    if (width > height) != (posed.camera.width > posed.camera.height):
        width, height = height, width  # pixels refer to the upright image
    view = posed.camera.resized(width, height)
    ends = []
    for x, y in (request.pixels[:2], request.pixels[2:]):
        if not (0 <= x <= width and 0 <= y <= height):
            raise UsageError(
                f"--scale distance: pixel ({x:g}, {y:g}) lies outside the video, which is {width} x {height}"
            )
        found = depth_at(x, y, view, poses[hit[0]], request.frame, posed, depth)
        if found is None:
            raise InputError(
                f"--scale distance: there is no depth at pixel ({x:g}, {y:g}) of frame {request.frame}; "
                "choose a textured point"
            )
        ends.append((view.unproject(x, y, found[0]), found[1]))
    return measured_length(*ends)


def measured_length(a: tuple[np.ndarray, float], b: tuple[np.ndarray, float]) -> tuple[float, float]:
    """Return the distance of two measured points (3,), given with standard errors, and its relative sigma."""
    length = float(np.linalg.norm(a[0] - b[0]))
    noise = np.hypot(a[1], b[1]) / max(length, 1e-12)
    return length, float(np.hypot(_USER_DISTANCE_SIGMA, noise))


def depth_at(
    x: float, y: float, view: Camera, world_from_view: np.ndarray, frame: int, posed: PosedFrames, depth: DepthMaps
) -> tuple[float, float] | None:  # fmt: skip
    """Return the z-depth at a pixel of `view` and its standard error, from points of nearby keyframes reprojected.

    None: there is no depth near this pixel.
    """
    view_from_world = invert_rigid(world_from_view)
    rows = np.argsort(np.abs(posed.indices - frame), kind="stable")[:_NEIGHBOURS]
    radius = _SEARCH_PX * max(view.width / depth.camera.width, 1.0)
    found = []
    v, u = np.mgrid[0 : depth.camera.height, 0 : depth.camera.width] + 0.5
    for row in rows:
        z = np.asarray(depth.depth[row], np.float64)
        points = depth.camera.unproject(u, v, z)[z > 0]
        view_from_row = view_from_world @ posed.world_from_camera[row]
        points = points @ view_from_row[:3, :3].T + view_from_row[:3, 3]
        points = points[points[:, 2] > 1e-9]
        px = points[:, 0] / points[:, 2] * view.fx + view.cx
        py = points[:, 1] / points[:, 2] * view.fy + view.cy
        found.append(points[np.hypot(px - x, py - y) < radius, 2])
        if posed.indices[row] == frame and len(found[-1]) >= 3:
            found = [found[-1]]  # the frame's own depth takes precedence
            break
    near = np.concatenate(found)
    if len(near) == 0:
        return None
    # Points behind the nearest surface are occluded.
    front = near[near < 1.05 * np.quantile(near, 0.1)]
    z = float(np.median(front))
    return z, float(1.4826 * np.median(np.abs(front - z)) / np.sqrt(len(front)) + 0.003 * z)
