"""Sample the surfaces of assets in world space, to measure relations on."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import AssetSet, BaseAsset, ObjectAsset, StructureAsset
from registry.labels import STRUCTURE

_SPACING_M = 0.005  # target distance of samples
_MIN_SAMPLES, _MAX_SAMPLES = 2_000, 25_000  # per object
_UP_FACING = 0.5  # least z of the normal of a surface that can support something (60 degrees)
_BOTTOM_PERCENTILE = 0.5  # of the coordinates, that bounds the box


@dataclass(frozen=True)
class SampledObject:
    """Surface samples of an object, and its underside as a height map."""

    id: int
    name: str
    points: np.ndarray  # (n, 3) world, uniform over the surface
    up: np.ndarray  # (m, 3) world, the upward-facing ones
    spacing_m: float  # between neighboring points
    low: np.ndarray  # (3,) world box, by percentiles
    high: np.ndarray  # (3,)
    center: np.ndarray  # (3,) mean of the points
    footprint_m2: float
    underside: np.ndarray  # (k, 3) cell centers (x, y) of the lowest part of the object, and their heights
    support_hint: int
    attached_hint: bool


@dataclass(frozen=True)
class SampledBase:
    """A floor, wall or ceiling as its plane and the box of its mesh."""

    id: int
    label: str
    normal: np.ndarray  # (3,) unit, into the room
    offset: float
    low: np.ndarray  # (3,) world box
    high: np.ndarray

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (n,) of points (n, 3) to the plane, positive in the room."""
        return points @ self.normal + self.offset


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, *, closed: bool = True
) -> tuple[np.ndarray, np.ndarray, float]:
    """Sample a mesh uniformly and deterministically: points (n, 3), unit normals (n, 3), spacing."""
    corners = vertices[faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Outward for a closed mesh: flip all normals if the enclosed volume is negative.
    if closed and np.einsum("ij,ij->", corners[:, 0] - corners[:, 0].mean(0), cross) < 0:
        cross = -cross
    double_area = np.linalg.norm(cross, axis=1)
    total = 0.5 * double_area.sum()
    if not total > 0:
        return np.zeros((0, 3)), np.zeros((0, 3)), _SPACING_M
    count = int(np.clip(total / _SPACING_M**2, _MIN_SAMPLES, _MAX_SAMPLES))
    cumulative = np.cumsum(double_area)
    position = (np.arange(count) + 0.5) / count * cumulative[-1]
    face = np.minimum(np.searchsorted(cumulative, position), len(faces) - 1)
    # The R2 sequence (Roberts 2018) covers the unit square uniformly; folding maps it to the triangle.
    u = (np.arange(count) * 0.7548776662466927) % 1.0
    v = (np.arange(count) * 0.5698402909980532) % 1.0
    fold = u + v > 1
    u[fold], v[fold] = 1 - u[fold], 1 - v[fold]
    a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return points, cross[face] / double_area[face, None], float(np.sqrt(total / count))


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return tuple(np.percentile(points, [_BOTTOM_PERCENTILE, 100 - _BOTTOM_PERCENTILE], axis=0))


def sample_object(asset: ObjectAsset, world_from_object: np.ndarray | None = None) -> SampledObject:
    """Sample an object at its reconstructed pose, or at `world_from_object`."""
    m = asset.world_from_object if world_from_object is None else world_from_object
    mesh = asset.visual
    points, normals, spacing = sample_surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    points, normals = points @ m[:3, :3].T + m[:3, 3], normals @ m[:3, :3].T
    if len(points) == 0:
        raise ValueError(f"scene graph: object {asset.id} ({asset.label}) has a mesh without area")
    low, high = _box(points)
    cell = float(np.clip((high - low)[:2].max() / 24, 0.006, 0.03))
    index = np.floor((points[:, :2] - low[:2]) / cell).astype(np.int64)
    _, where = np.unique(index[:, 0] * 100_003 + index[:, 1], return_inverse=True)
    heights = np.full(where.max() + 1, np.inf)
    np.minimum.at(heights, where, points[:, 2])
    cells = np.zeros((len(heights), 2))
    cells[where] = (index + 0.5) * cell + low[:2]
    # Only the lowest band can be supported: legs, feet, a rim. Noise and tilt widen it.
    band = low[2] + np.clip(0.15 * (high[2] - low[2]), 0.010, 0.025)
    lowest = heights <= band
    return SampledObject(
        id=asset.id,
        name=f"{asset.label} {asset.id}",
        points=points,
        up=points[normals[:, 2] > _UP_FACING],
        spacing_m=spacing,
        low=low,
        high=high,
        center=points.mean(axis=0),
        footprint_m2=len(heights) * cell**2,
        underside=np.column_stack([cells[lowest], heights[lowest]]),
        support_hint=asset.support_hint,
        attached_hint=asset.attached_hint,
    )


def sample_structure(asset: StructureAsset) -> SampledObject:
    """Sample the structure, an open surface, as an object without underside: it carries, and stands on nothing."""
    mesh = asset.visual
    points, normals, spacing = sample_surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), closed=False)
    low, high = _box(points)
    return SampledObject(
        id=asset.id,
        name=f"{STRUCTURE} {asset.id}",
        points=points,
        up=points[normals[:, 2] > _UP_FACING],
        spacing_m=spacing,
        low=low,
        high=high,
        center=points.mean(axis=0),
        footprint_m2=float(np.prod((high - low)[:2])),
        underside=np.zeros((0, 3)),
        support_hint=0,
        attached_hint=False,
    )


def sample_base(asset: BaseAsset) -> SampledBase:
    """Return the plane and box of a floor, wall or ceiling."""
    normal = np.asarray(asset.plane[:3], np.float64)
    length = np.linalg.norm(normal)
    vertices = np.asarray(asset.visual.vertices, np.float64)
    low, high, offset = vertices.min(0), vertices.max(0), float(asset.plane[3]) / length
    return SampledBase(asset.id, asset.label, normal / length, offset, low, high)


def sample_assets(assets: AssetSet) -> tuple[dict[int, SampledBase], dict[int, SampledObject]]:
    """Sample all assets, by id."""
    return {b.id: sample_base(b) for b in assets.base}, {o.id: sample_object(o) for o in assets.objects}
