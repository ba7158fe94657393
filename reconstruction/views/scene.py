"""The scene as viewpoint optimization uses it, prepared once for all targets; and the targets."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.types import Camera, InstanceSet, SpaceGrid, Surface
from reconstruction.gaussians.model import Gaussians
from reconstruction.views.clearance import Clearance, measure_clearance
from reconstruction.views.config import AvoConfig
from registry.errors import UsageError

_INPUTS = 40  # number of input cameras to use, evenly spaced in time
_CURVE_CELL_M = 0.01  # cell of the Morton curve
_OUTER_SHARE = 0.98  # share of the target's Gaussians inside of its bounding sphere; the rest are outliers


@dataclass(frozen=True)
class ViewScene:
    """Gaussians, surface, instances, free space and input cameras; world space, metres, floor at z = 0."""

    gaussians: Gaussians
    packed: np.ndarray  # float32 (g, 13) parameters of the Gaussians
    instance: np.ndarray  # int32 (g,) instance id of each Gaussian, 0 = none
    points: np.ndarray  # float64 (v, 3) vertices of the surface
    point_instance: np.ndarray  # int32 (v,) instance id of each vertex, 0 = none
    base: tuple[int, ...]  # ids of floor, walls and ceiling
    clearance: Clearance
    space: SpaceGrid  # occupancy; closed shapes exclude its free voxels
    camera: Camera  # of the input frames
    inputs: np.ndarray  # float64 (n, 4, 4) world_from_camera of input frames, evenly spaced in time
    frames: np.ndarray  # int64 (n,) their rows among the keyframes


@dataclass(frozen=True)
class Target:
    """An object, or a region: several objects viewed as one."""

    ids: tuple[int, ...]
    rows: np.ndarray  # int64 (m,) rows of its Gaussians, ascending
    center: np.ndarray  # float64 (3,) of its bounding sphere, world space
    radius_m: float  # of its bounding sphere, without outliers
    distance_m: float  # target distance d: the sphere fills the share `AvoConfig.fill` of the field of view


def prepare_scene(
    gaussians: Gaussians, surface: Surface, instances: InstanceSet, camera: Camera
) -> ViewScene:
    """Prepare a scene for any number of targets.

    Args:
        gaussians: in world space (`GaussianScene.in_world`), with the input cameras.
        surface: of the same scene, with its occupancy grid.
        instances: of the same scene.
        camera: of the input frames.

    Raises:
        UsageError: the Gaussians carry no cameras.
    """
    from reconstruction.instances.gaussian_ids import gaussian_instances

    poses = np.asarray(gaussians.world_from_camera, np.float64)
    if not len(poses):
        raise UsageError(
            "views: the Gaussians have no input cameras, which are needed as start poses; fit them to frames anew"
        )
    rows = np.unique(np.linspace(0, len(poses) - 1, _INPUTS).round().astype(int))
    return ViewScene(
        gaussians=gaussians,
        packed=gaussians.packed(),
        instance=gaussian_instances(gaussians.means, surface.vertices, instances.vertex_instance),
        points=np.asarray(surface.vertices, np.float64),
        point_instance=np.asarray(instances.vertex_instance, np.int32),
        base=instances.static_ids,
        clearance=measure_clearance(surface.space, poses[:, :3, 3]),
        space=surface.space,
        camera=camera,
        inputs=poses[rows],
        frames=rows,
    )


def ids_of(ids: Sequence[int] | int) -> tuple[int, ...]:
    """Return an id, or the ids of a region, as a sorted tuple without repetitions."""
    return (int(ids),) if isinstance(ids, int | np.integer) else tuple(sorted({int(i) for i in ids}))


def make_target(scene: ViewScene, ids: Sequence[int] | int, config: AvoConfig) -> Target | None:
    """Return the target of an id, or of the ids of a region; None if no Gaussian belongs to it."""
    wanted = ids_of(ids)
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
    """Subsample a scene such that the target keeps at most `most` Gaussians, for coarse images.

    The same share of the target's and of the other Gaussians is kept, evenly spread along a space-filling curve and
    enlarged to cover the same area. Only `packed` and `instance` of the scene and `rows` of the target change.
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
    """Return `rows` of Gaussians in the order of a Morton curve, which keeps spatial neighbors together."""
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
    """Return the radius (n,) at which each Gaussian (n, 13) ends, in the units of the scene."""
    return (sigma_cutoff * np.exp(packed[:, 7:9].max(axis=1))).astype(packed.dtype)
