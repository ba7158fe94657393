"""The world stage: compose gravity, yaw, floor and scale into one similarity transform."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import DepthMaps, PosedFrames, ScaleEstimate, WorldFrame
from reconstruction.world.config import WorldConfig
from reconstruction.world.floor import Floor, find_floor, lowest_height
from reconstruction.world.gravity import Gravity, find_gravity
from reconstruction.world.mirrors import find_mirrors
from reconstruction.world.planes import FittedPlane, fit_planes
from reconstruction.world.request import parse_scale
from reconstruction.world.samples import SurfaceSamples, sample_surface
from reconstruction.world.scale import Metres, camera_heights, find_scale
from reconstruction.world.yaw import find_yaw, level_rotation, turn_about_z
from registry.errors import UsageError
from registry.geometry import split_similarity

_USER_OBJECT_SIGMA = 0.03  # relative standard deviation of a scale from `--scale object`
_CLEARANCE_M = 0.05  # an unseen floor is assumed at least this far below all seen surface


@dataclass(frozen=True)
class Known:
    """Parts of the world frame that the user said, in `sfm` space; None: they are estimated."""

    up: np.ndarray | None = None  # float64 (3,) unit
    up_method: str = ""  # as `WorldFrame.gravity_method`
    up_sigma_deg: float = 0.0  # standard deviation
    floor: np.ndarray | None = None  # float64 (3,), a point of the floor
    metres: Metres | None = None


NOTHING_KNOWN = Known()


def find_world(
    posed: PosedFrames, depth: DepthMaps, config: WorldConfig, *, known: Known = NOTHING_KNOWN,
    progress: Progress = NO_PROGRESS,
) -> WorldFrame:  # fmt: skip
    """Estimate the similarity from `sfm` to `world`: metres, +z up, walls along x and y, floor at z = 0.

    Args:
        posed: keyframes with cameras in `sfm` space.
        depth: their depth maps in `sfm` units.
        config: settings.
        known: parts of the result that are taken as given.
        progress: receives steps, decisions and fallbacks.

    Raises:
        InputError: there is too little depth.
        UsageError: `config.scale` names a frame or pixel that does not exist.
    """
    progress.start(4, "world frame")
    samples = sample_surface(posed, depth, config)
    progress.advance()
    gravity = find_gravity(posed, samples) if known.up is None else _given_gravity(known, known.up, samples)
    progress.advance()
    rotation = level_rotation(gravity.up)
    upright = rotate_samples(samples, rotation)
    walls = tuple(replace(p, normal=rotation @ p.normal) for p in gravity.planes if not p.level)
    yaw_rad, snapped = find_yaw(upright, posed.world_from_camera[:, :3, 2] @ rotation.T, walls)
    turn = turn_about_z(yaw_rad)
    upright, rotation = rotate_samples(upright, turn), turn @ rotation
    floor = (
        find_floor(upright) if known.floor is None else Floor(float(rotation[2] @ known.floor), True, False)
    )
    progress.advance()
    metres = known.metres or find_scale(posed, depth, upright, floor, config, progress)
    world_from_sfm = np.eye(4)
    world_from_sfm[:3, :3] = metres.per_unit * rotation
    middle = np.median(upright.points[:, :2], axis=0)
    height = floor_height(upright, floor, metres, config)
    world_from_sfm[:3, 3] = -metres.per_unit * np.array([middle[0], middle[1], height])
    if not floor.observed:
        why = "there is surface below the level surface" if floor.table else "no level surface was found"
        below_m = metres.per_unit * (float(np.median(camera_heights(upright))) - height)
        progress.note(f"world: no floor is in view ({why}); one is assumed {below_m:.2f} m below the camera")
    if not snapped:
        progress.note(
            "world: no walls or upright faces were found; x and y follow the viewing direction instead"
        )
    world = WorldFrame(
        world_from_sfm,
        metres.estimate,
        gravity.method,
        gravity.sigma_deg,
        floor.observed,
        yaw_snapped=snapped,
    )
    world = _with_mirrors(world, posed, depth, gravity.planes, progress)
    progress.advance()
    return _apply_object_request(world, config, progress)


def _with_mirrors(
    world: WorldFrame, posed: PosedFrames, depth: DepthMaps, planes: Sequence[FittedPlane], progress: Progress
) -> WorldFrame:
    """Return the world with the mirrors on the upright planes (`sfm` space)."""
    scale, rotation, shift = split_similarity(world.world_from_sfm)
    moved = [(n := rotation @ plane.normal, scale * plane.offset + float(n @ shift)) for plane in planes]
    placed = world.apply_to(posed)
    found = find_mirrors(placed, world.depth_in_world(depth, placed), moved)
    for glass in found:
        wide, high = (np.linalg.norm(glass.polygon[k] - glass.polygon[0]) for k in (1, 3))
        progress.note(
            f"world: a mirror of {wide:.1f} x {high:.1f} m: what seems to be behind it is the reflected room, and gets "
            "the depth of its glass"
        )
    sfm_from_world = np.linalg.inv(world.world_from_sfm)
    return replace(world, mirrors=tuple(glass.moved(sfm_from_world) for glass in found))


def _given_gravity(known: Known, up: np.ndarray, samples: SurfaceSamples) -> Gravity:
    """Return gravity as the user said it, with the planes that are level and plumb under it."""
    return Gravity(up, known.up_method, known.up_sigma_deg, fit_planes(samples, up))


def floor_height(upright: SurfaceSamples, floor: Floor, metres: Metres, config: WorldConfig) -> float:
    """Return the floor's height in upright `sfm` units: as observed, or assumed below all seen surface."""
    if floor.observed:
        return floor.height
    clearance = _CLEARANCE_M / metres.per_unit
    known = parse_scale(config.scale) if config.scale else None
    height_m = config.camera_height_prior_m
    if known is not None and known.kind == "camera-height":
        height_m = known.value_m
    expected = float(np.median(camera_heights(upright))) - height_m / metres.per_unit
    if floor.table:
        expected = floor.height - config.table_height_prior_m / metres.per_unit
    return min(expected, lowest_height(upright) - clearance)


def rescale_for_object(world: WorldFrame, measured_height_m: float, wanted_height_m: float) -> WorldFrame:
    """Return the world rescaled so that an object of height `measured_height_m` gets height `wanted_height_m`.

    The floor stays at z = 0, and the origin in place.

    Raises:
        UsageError: a height is not a positive number.
    """
    for name, value in (("measured", measured_height_m), ("wanted", wanted_height_m)):
        if not np.isfinite(value) or value <= 0:
            raise UsageError(f"--scale object: the {name} height is {value:g} m; it must be positive")
    factor = wanted_height_m / measured_height_m
    world_from_sfm = world.world_from_sfm.copy()
    world_from_sfm[:3] *= factor
    detail = f"--scale: an object is {wanted_height_m:g} m high; at the former scale it was {measured_height_m:.3f} m"
    estimate = ScaleEstimate("user-object", _USER_OBJECT_SIGMA, detail)
    return replace(world, world_from_sfm=world_from_sfm, scale=estimate)


def rotate_samples(samples: SurfaceSamples, rotation: np.ndarray) -> SurfaceSamples:
    """Return the samples in space b, for `rotation` (3, 3) = b_from_a."""
    return replace(
        samples,
        points=samples.points @ rotation.T,
        normals=samples.normals @ rotation.T,
        eyes=samples.eyes @ rotation.T,
    )


def _apply_object_request(world: WorldFrame, config: WorldConfig, progress: Progress) -> WorldFrame:
    """Apply `--scale object` once the object's height is known; a marker takes precedence."""
    request = parse_scale(config.scale) if config.scale else None
    if request is None or request.kind != "object" or world.scale.method == "marker":
        return world
    if config.object_measured_height_m <= 0:
        progress.note(
            f"world: the scale is provisional ({world.scale.method}) until object {request.object_id} is found"
        )
        return world
    return rescale_for_object(world, config.object_measured_height_m, request.value_m)
