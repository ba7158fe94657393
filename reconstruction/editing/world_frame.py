"""Correction of the world frame by what the user says: a length, the up direction, the floor."""

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import ScaleEstimate, WorldFrame
from reconstruction.editing.addresses import Address
from reconstruction.editing.film import Film
from reconstruction.editing.scene_entries import KnownLength, KnownUp, SceneEntries
from reconstruction.world.config import WorldConfig
from reconstruction.world.frame import Known, find_world
from reconstruction.world.planes import plane_around
from reconstruction.world.samples import sample_surface
from reconstruction.world.scale import Metres, depth_at, measured_length
from registry.errors import UsageError
from registry.geometry import split_similarity, transform_points

_TAKEN_SIGMA_DEG = 1.0  # of a direction that the user gives: taken, as nothing tells how it was found
_LEAST_SIGMA_DEG = 0.15  # of level surface: what floors and tables deviate from level, as in `world.gravity`
_STEEPEST_DEG = 45.0  # surface that the cameras see steeper than this is a wall rather than level
_THINNEST = (
    0.1  # least ratio of width to length of three or more clicks: on a line they leave a rotation open
)


def corrected_world(
    plain: WorldFrame, entries: SceneEntries, film: Film, config: WorldConfig, progress: Progress
) -> WorldFrame:
    """Estimate the world frame again, with the parts that the user says taken as given.

    Args:
        plain: the frame without corrections.
        entries: what the user says.
        film: frames, cameras and depth maps in `sfm` space.
        config: settings of the world stage.
        progress: receives notes.

    Raises:
        UsageError: a click has no camera or no depth, or clicks do not determine what they should.
    """
    up, method, sigma_deg = None, "", 0.0
    if entries.up is not None:
        up, method, sigma_deg = _up(entries.up, plain, film, config)
    known = Known(
        up,
        method,
        sigma_deg,
        _point(film, entries.floor)[0] if entries.floor is not None else None,
        _metres(entries.scale, film) if entries.scale is not None else None,
    )
    return find_world(film.posed, film.depth, config, known=known, progress=progress)


def _point(film: Film, address: Address) -> tuple[np.ndarray, float]:
    """Return the point (3,) that a click shows, in the space of the film, and its standard error along the ray."""
    pose = film.camera_of(address.frame)[1]
    x, y = film.depth_pixel(address).tolist()
    found = depth_at(x, y, film.depth.camera, pose, address.frame, film.posed, film.depth)
    if found is None:
        raise UsageError(f"overrides: there is no depth at {address}; click on something textured nearby")
    z, spread = found
    return transform_points(pose, film.depth.camera.unproject(x, y, z)[None])[0], spread


def _metres(length: KnownLength, film: Film) -> Metres:
    units, sigma = measured_length(_point(film, length.start), _point(film, length.end))
    if units < 1e-9:
        raise UsageError(f"overrides: scale: {length.start} and {length.end} show the same point")
    detail = f"overrides: {length.start} and {length.end} are {length.metres:g} m apart"
    return Metres(length.metres / units, ScaleEstimate("user-distance", sigma, detail))


def _up(said: KnownUp, plain: WorldFrame, film: Film, config: WorldConfig) -> tuple[np.ndarray, str, float]:
    """Return the up direction (3,) in `sfm` space, its method and its standard deviation in degrees."""
    world_from_sfm = split_similarity(plain.world_from_sfm)[1]
    if said.normal is not None:
        sfm_from_axes = world_from_sfm.T if said.frame is None else film.camera_of(said.frame)[1][:3, :3]
        up = sfm_from_axes @ np.array(said.normal)
        return up / np.linalg.norm(up), "user-direction", _TAKEN_SIGMA_DEG
    points, spreads = zip(*(_point(film, click) for click in said.level))
    if len(points) == 1:
        plane = plane_around(sample_surface(film.posed, film.depth, config), points[0])
        if plane is None:
            raise UsageError(
                f"overrides: up: too little flat surface was seen around {said.level[0]}; click three points at "
                "the same height instead"
            )
        up, sigma_deg = plane.normal, plane.sigma_deg
    else:
        up, sigma_deg = _across(np.array(points), max(spreads), said)
    rough = world_from_sfm[2]
    up = up * np.sign(up @ rough or 1.0)
    tilt_deg = float(np.degrees(np.arccos(np.clip(up @ rough, -1, 1))))
    if tilt_deg > _STEEPEST_DEG:
        raise UsageError(
            f"overrides: up: the surface at {said.level[0]} is {tilt_deg:.0f} degrees off level by all else that was "
            "seen; click on level surface, or give `up: {normal: [x, y, z]}` if the scene really lies so"
        )
    return up, "user-level", float(np.hypot(sigma_deg, _LEAST_SIGMA_DEG))


def _across(points: np.ndarray, spread: float, said: KnownUp) -> tuple[np.ndarray, float]:
    """Return the normal (3,) of the plane through points (n, 3), and its standard deviation in degrees."""
    _, sizes, axes = np.linalg.svd(points - points.mean(axis=0))
    if sizes[1] < _THINNEST * sizes[0] or sizes[1] < 1e-9:
        clicks = ", ".join(map(str, said.level))
        raise UsageError(f"overrides: up: {clicks} lie on a line; click points that span a triangle")
    return axes[2], float(np.degrees(np.arctan2(spread, sizes[1])))
