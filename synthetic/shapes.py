"""Closed procedural solids made of textured grid patches: boxes, turned bodies (lathe), bent tubes.

Solids are built twice: finely for drawing (light is stored per vertex, so the grid must follow shadows) and
coarsely for the true mesh. Local space: +z up, metres, origin at the bottom centre. Texture coordinates are
metres.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

COARSE = 1e9  # grid step that leaves every flat patch undivided


@dataclass(frozen=True)
class Patch:
    """A textured piece of a surface."""

    vertices: np.ndarray  # float64 (v, 3)
    normals: np.ndarray  # float64 (v, 3) unit, outwards
    uvs_m: np.ndarray  # float64 (v, 2) metres in its texture
    faces: np.ndarray  # int32 (f, 3) counter-clockwise seen from outside
    texture: str


Solid = tuple[Patch, ...]  # patches that close a volume


def grid_patch(points: np.ndarray, uvs_m: np.ndarray, texture: str) -> Patch:
    """Make a patch from a grid of points (r, c, 3); rows x columns points outwards."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices = points.reshape(-1, 3)
    edge = vertices[faces]
    areas = np.cross(edge[:, 1] - edge[:, 0], edge[:, 2] - edge[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], areas)
    # A seam (first and last column in the same place) must not show in the shading.
    seam = normals.reshape(rows, columns, 3)
    if columns > 2 and np.allclose(points[:, 0], points[:, -1], atol=1e-9):
        seam[:, 0] = seam[:, -1] = seam[:, 0] + seam[:, -1]
    # Rows that shrink to a point (poles) share one normal; their zero-area triangles are dropped.
    for row in (0, rows - 1):
        if np.ptp(points[row], axis=0).max() < 1e-9:
            seam[row] = seam[row].sum(0)
    faces = faces[np.linalg.norm(areas, axis=1) > 1e-14]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Patch(vertices, normals / np.maximum(length, 1e-30), uvs_m.reshape(-1, 2), faces, texture)


def _rectangle(
    origin: np.ndarray,
    along_u: np.ndarray,
    along_v: np.ndarray,
    uv: tuple[float, float],
    step: float,
    texture: str,
) -> Patch:
    width, height = np.linalg.norm(along_u), np.linalg.norm(along_v)
    s = np.linspace(0, 1, int(np.ceil(width / step)) + 1)
    t = np.linspace(0, 1, int(np.ceil(height / step)) + 1)
    points = origin + s[:, None, None] * along_u + t[None, :, None] * along_v
    uvs = np.stack(np.broadcast_arrays(uv[0] + s[:, None] * width, uv[1] + t[None] * height), -1)
    return grid_patch(points, uvs, texture)


def box(
    size: tuple[float, float, float], textures: str | Mapping[str, str], step: float,
    uv_offset: tuple[float, float] = (0.0, 0.0), upright: bool = True,
) -> Solid:  # fmt: skip
    """A box on its bottom centre. Faces are named +x -x +y -y +z -z; "side" and "*" stand for the rest.

    `upright` lets v rise with z on the sides; otherwise u does (grain along the height).
    """
    half_x, half_y, height = size[0] / 2, size[1] / 2, size[2]
    lo, hi = np.array([-half_x, -half_y, 0.0]), np.array([half_x, half_y, height])
    x, y, z = np.diag([size[0], size[1], size[2]])
    corners = {
        "+x": (np.array([hi[0], lo[1], 0]), y, z),
        "-x": (np.array([lo[0], hi[1], 0]), -y, z),
        "+y": (np.array([hi[0], hi[1], 0]), -x, z),
        "-y": (np.array([lo[0], lo[1], 0]), x, z),
        "+z": (np.array([lo[0], lo[1], height]), x, y),
        "-z": (np.array([lo[0], hi[1], 0]), x, -y),
    }
    patches = []
    for number, (name, (origin, along_u, along_v)) in enumerate(corners.items()):
        texture = textures if isinstance(textures, str) else textures.get(name)
        if texture is None:
            fallback = textures["*"]
            texture = textures.get("side", fallback) if name[1] != "z" else fallback
        own_print = not isinstance(textures, str) and (name in textures)
        # Unprinted faces look at different parts of their material, so that no two look the same.
        uv = (0.0, 0.0) if own_print else (uv_offset[0] + 0.37 * number, uv_offset[1] + 0.23 * number)
        patch = _rectangle(origin, along_u, along_v, uv, step, texture)
        if not upright and name[1] != "z":
            patch = replace(patch, uvs_m=patch.uvs_m[:, ::-1])
        patches.append(patch)
    return tuple(patches)


def _resample(points: np.ndarray, step: float) -> np.ndarray:
    """Divide a polyline (k, 2) into pieces no longer than `step`."""
    out = [points[:1]]
    for a, b in pairwise(points):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / step)))
        out.append(a + np.linspace(0, 1, count + 1)[1:, None] * (b - a))
    return np.concatenate(out)


def lathe(profile: list[tuple[np.ndarray, str]], step: float, segments: int = 48) -> Solid:
    """Turn a profile around z. Pieces (k, 2) of (radius, height) join at sharp edges, each has its texture.

    The profile runs counter-clockwise seen in the (radius, height) plane: along the bottom outwards, up the
    outside, back inwards to the axis.
    """
    turn = np.linspace(2 * np.pi, 0, segments + 1)  # backwards, so that patches face outwards
    angles = turn.copy()
    angles[0] = 0.0  # the seam closes exactly
    patches = []
    for piece, texture in profile:
        points2 = _resample(np.asarray(piece, float), step)
        radius, height = points2[:, :1], points2[:, 1:]
        points = np.stack(np.broadcast_arrays(radius * np.cos(angles), radius * np.sin(angles), height), -1)
        arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points2, axis=0), axis=1))])
        if np.ptp(height) < 1e-9:  # flat rings and discs are seen from above: map them flat
            uvs = points[..., :2] + radius.max()
        else:
            uvs = np.stack(np.broadcast_arrays(turn[None] * radius.max(), arc[:, None]), -1)
        patches.append(grid_patch(points, uvs, texture))
    return tuple(patches)


def tube(path: np.ndarray, radius: tuple[float, float], texture: str, sides: int = 12) -> Solid:
    """Sweep an ellipse (radius along y, in the xz plane) along a path (k, 3) in the xz plane; cap it."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.array([0.0, 1.0, 0.0])
    outward = np.cross(tangent, across)
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    angles[-1] = 0.0
    ring = (
        radius[0] * np.cos(angles)[None, :, None] * across
        + radius[1] * np.sin(angles)[None, :, None] * outward[:, None]
    )
    points = path[:, None] + ring
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    uvs = np.stack(
        np.broadcast_arrays(arc[:, None], np.linspace(0, 2 * np.pi, sides + 1)[None] * max(radius)), -1
    )
    wall = grid_patch(points, uvs, texture)
    caps = []
    for end, order in ((0, slice(None)), (-1, slice(None, None, -1))):
        rim = points[end][order]
        disc = np.stack([np.repeat(path[end][None], sides + 1, 0), rim])
        caps.append(grid_patch(disc, np.zeros((2, sides + 1, 2)), texture))
    solid = (wall, *caps)
    return solid if signed_volume(solid) > 0 else tuple(flipped(p) for p in solid)


def flipped(patch: Patch) -> Patch:
    """Turn a patch inside out."""
    return replace(patch, faces=patch.faces[:, ::-1].copy(), normals=-patch.normals)


def signed_volume(solid: Solid) -> float:
    """Return the enclosed volume in cubic metres, positive where all patches face outwards."""
    corners = [patch.vertices[patch.faces] for patch in solid]
    return float(sum(np.einsum("ij,ij->", c[:, 0], np.cross(c[:, 1], c[:, 2])) for c in corners) / 6)


def moved(solid: Solid, b_from_a: np.ndarray) -> Solid:
    """Apply a rigid 4x4."""
    rotation, translation = b_from_a[:3, :3], b_from_a[:3, 3]
    return tuple(
        replace(p, vertices=p.vertices @ rotation.T + translation, normals=p.normals @ rotation.T)
        for p in solid
    )


def shifted(solid: Solid, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Solid:
    """Move without turning."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return moved(solid, pose)
