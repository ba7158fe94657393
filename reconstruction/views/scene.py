"""What all targets of a scene share, prepared once; and what a target is."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.types import Camera, InstanceSet, SpaceGrid, Surface
from reconstruction.gaussians.model import Gaussians
from reconstruction.views.clearance import Clearance, measure_clearance
from reconstruction.views.config import AvoConfig
from registry.errors import UsageError

_INPUTS = 40  # input cameras that are looked at, evenly spread over the film
_CURVE_CELL_M = 0.01
_OUTER_SHARE = 0.98  # of the target's Gaussians lie in its sphere: strays do not push the camera away


@dataclass(frozen=True)
class ViewScene:
    """The scene as viewpoints see it. World space, metres, floor at z = 0."""

    gaussians: Gaussians
    packed: np.ndarray  # float32 (g, 13)
    instance: np.ndarray  # int32 (g,) id of the thing that each Gaussian belongs to; 0 = none
    points: np.ndarray  # float64 (v, 3) of the surface
    point_instance: np.ndarray  # int32 (v,) alike
    base: tuple[int, ...]  # ids of floor, walls and ceiling
    clearance: Clearance
    space: SpaceGrid  # what is known of space, where things are closed
    camera: Camera  # of the input frames
    inputs: np.ndarray  # float64 (n, 4, 4) world_from_camera of input frames, evenly spread
    frames: np.ndarray  # int (n,) their rows among the keyframes


@dataclass(frozen=True)
class Target:
    """One thing, or a region: several things that are looked at together."""

    ids: tuple[int, ...]
    rows: np.ndarray  # int64 (m,) of its Gaussians, ascending
    center: np.ndarray  # float64 (3,)
    radius_m: float  # of a sphere that holds (nearly) all of it
    distance_m: float  # d_target: at which that sphere fills the wanted share of the field of view


def prepare_scene(
    gaussians: Gaussians, surface: Surface, instances: InstanceSet, camera: Camera
) -> ViewScene:
    """Prepare a scene for any number of targets.

    Args:
        gaussians: in world space (`GaussianScene.in_world`), with the input cameras.
        surface: with its free space.
        instances: what belongs to which thing.
        camera: of the input frames.

    Raises:
        UsageError: the Gaussians carry no cameras.
    """
    from reconstruction.instances.gaussian_ids import gaussian_instances

    poses = np.asarray(gaussians.world_from_camera, np.float64)
    if not len(poses):
        raise UsageError(
            "views: the Gaussians carry no input cameras, so nothing is known of where one may stand"
        )
    rows = np.unique(np.linspace(0, len(poses) - 1, _INPUTS).round().astype(int))
    return ViewScene(
        gaussians=gaussians,
        packed=gaussians.packed(),
        instance=gaussian_instances(gaussians.means, surface.vertices, instances.vertex_instance),
        points=np.asarray(surface.vertices, np.float64),
        point_instance=np.asarray(instances.vertex_instance, np.int32),
        base=tuple(b.id for b in instances.base),
        clearance=measure_clearance(surface.space, poses[:, :3, 3]),
        space=surface.space,
        camera=camera,
        inputs=poses[rows],
        frames=rows,
    )


def make_target(scene: ViewScene, ids: Sequence[int] | int, config: AvoConfig) -> Target | None:
    """Return the target of an id, or of a region of ids; None where no Gaussian belongs to it."""
    wanted = (int(ids),) if np.isscalar(ids) else tuple(sorted({int(i) for i in ids}))
    rows = np.flatnonzero(np.isin(scene.instance, wanted))
    if not len(rows):
        return None
    means = scene.packed[rows, :3].astype(np.float64)
    low, high = np.percentile(means, [1, 99], axis=0)
    center = 0.5 * (low + high)
    away = np.linalg.norm(means - center, axis=1)
    radius = max(float(np.quantile(away, _OUTER_SHARE)), 0.02)
    half = math.radians(0.5 * config.fov_deg)
    distance = max(radius / math.sin(config.fill * half), config.min_distance_m)
    return Target(wanted, rows, center, radius, distance)


def thinned(scene: ViewScene, target: Target, most: int) -> tuple[ViewScene, Target]:
    """Return the scene and a target with at most `most` Gaussians, for pictures that show it coarsely.

    Of the target, and of everything else, the same share of the Gaussians stays, evenly spread and so much larger that
    they cover the same area. Only `packed` and `instance` of the scene and `rows` of the target are thinned.
    """
    share = most / len(target.rows)
    if share >= 1.0:
        return scene, target
    own = np.zeros(len(scene.packed), bool)
    own[target.rows] = True
    kept = [
        rows[np.linspace(0, len(rows) - 1, max(int(share * len(rows)), 1)).round().astype(int)]
        for rows in (_along_curve(scene.packed, np.flatnonzero(mine)) for mine in (own, ~own))
        if len(rows)
    ]
    rows = np.sort(np.concatenate(kept))
    packed = scene.packed[rows]
    packed[:, 7:9] -= 0.5 * math.log(share)
    left = replace(scene, packed=packed, instance=scene.instance[rows])
    return left, replace(target, rows=np.flatnonzero(own[rows]))


def _along_curve(packed: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return rows of Gaussians along a curve that fills space (Morton's): neighbors on it lie close together."""
    if not len(rows):
        return rows
    means = packed[rows, :3].astype(np.float64)
    cells = ((means - means.min(axis=0)) / _CURVE_CELL_M).astype(np.uint64)
    code = np.zeros(len(rows), np.uint64)
    for bit in range(16):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return rows[np.argsort(code, kind="stable")]


def reach_of(packed: np.ndarray, sigma_cutoff: float) -> np.ndarray:
    """Return how far each Gaussian (n, 13) reaches from its center, (n,) metres."""
    return (sigma_cutoff * np.exp(packed[:, 7:9].max(axis=1))).astype(packed.dtype)
