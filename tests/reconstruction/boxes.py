"""Small analytic assets: boxes, trays and balls whose relations and rest poses are known."""

import numpy as np

from reconstruction.assembly.base import convex_part
from reconstruction.core.types import (
    AssetProvenance,
    AssetSet,
    BaseAsset,
    ConvexPart,
    ObjectAsset,
    PhysicalAttributes,
    PhysicalRanges,
    TexturedMesh,
)
from registry.geometry import rigid

TEXTURE = np.zeros((2, 2, 3), np.uint8)


def box_part(size, center=(0, 0, 0)) -> ConvexPart:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return convex_part(corners * size + np.asarray(center, float))


def ball_part(radius: float) -> ConvexPart:
    i = np.arange(120) + 0.5
    polar, turn = np.arccos(1 - 2 * i / 120), np.pi * (1 + 5**0.5) * i
    points = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    return convex_part(radius * points + [0, 0, radius])


def mesh_of(parts) -> TexturedMesh:
    starts = np.cumsum([0] + [len(p.vertices) for p in parts])
    vertices = np.concatenate([p.vertices for p in parts])
    faces = np.concatenate([p.faces + s for p, s in zip(parts, starts)]).astype(np.int32)
    return TexturedMesh(vertices, faces, np.zeros((len(vertices), 2), np.float32), TEXTURE)


def thing(number: int, parts, position, *, label="box", turn=None, mass=0.4, hint=0) -> ObjectAsset:
    parts = tuple(parts)
    points = np.concatenate([p.vertices for p in parts]).astype(float)
    center, size = 0.5 * (points.min(0) + points.max(0)), np.ptp(points, axis=0)
    square = size**2
    inertia = np.diag(mass / 12 * (square.sum() - square))
    ranges = PhysicalRanges((mass, mass), (0.5, 0.5), (0.1, 0.1))
    physics = PhysicalAttributes("wood", 500.0, mass, center, inertia, 0.5, 0.1, ranges)
    return ObjectAsset(
        number,
        label,
        0.5,
        rigid(turn, np.asarray(position, float)),
        mesh_of(parts),
        parts,
        physics,
        AssetProvenance("test", "test", "test", 1.0),
        np.zeros(0, np.int32),
        hint,
        False,
    )


def box(number: int, size, position, **options) -> ObjectAsset:
    """A box whose bottom center lies at `position`."""
    return thing(number, [box_part(size, (0, 0, size[2] / 2))], position, **options)


def tray(number: int, position, size=(0.4, 0.3, 0.08), thickness=0.012) -> ObjectAsset:
    """An open box: a floor and four walls."""
    x, y, z = size
    t = thickness
    parts = [box_part((x, y, t), (0, 0, t / 2))]
    for sign in (-1, 1):
        parts.append(box_part((t, y, z), (sign * (x - t) / 2, 0, z / 2)))
        parts.append(box_part((x, t, z), (0, sign * (y - t) / 2, z / 2)))
    return thing(number, parts, position, label="tray")


def floor(number: int = 1) -> BaseAsset:
    visual = mesh_of([box_part((4, 4, 0.001), (0, 0, -0.0005))])
    return BaseAsset(number, "floor", np.array([0, 0, 1.0, 0]), visual, True)


def wall(number: int = 2, y: float = 1.0) -> BaseAsset:
    """A wall at `y` that faces towards -y."""
    visual = mesh_of([box_part((4, 0.001, 2.5), (0, y + 0.0005, 1.25))])
    return BaseAsset(number, "wall", np.array([0, -1.0, 0, y]), visual, True)


def room(*objects: ObjectAsset) -> AssetSet:
    return AssetSet((floor(), wall()), tuple(objects))


def tilt(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
