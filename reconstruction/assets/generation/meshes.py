"""Generated meshes: reading, checks, decimation, and sampling of the surface with normals and colors."""

import io
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reconstruction.assets.generation.base import GenerationError
from reconstruction.assets.loaded import colors_of, load_mesh, picture_of, upright
from reconstruction.assets.solid import decimate

_MOST_FACES = 60_000  # decimated to this many: finer detail is beyond what the video saw
_SAMPLES = 120_000


@dataclass(frozen=True)
class GeneratedMesh:
    """A generated mesh, +z up, in its own units or moved."""

    vertices: np.ndarray  # float64 (v, 3)
    faces: np.ndarray  # int32 (f, 3)
    points: np.ndarray  # float64 (n, 3) evenly on the surface
    normals: np.ndarray  # float64 (n, 3) of the triangles there
    colors: np.ndarray | None  # uint8 (n, 3) RGB there; None where it has none

    @property
    def extents(self) -> np.ndarray:
        """Return the size of the axis-aligned box (3,)."""
        return np.ptp(self.vertices, axis=0)

    def moved(self, scale: float, rotation: np.ndarray, translation: np.ndarray) -> "GeneratedMesh":
        """Return the mesh under x -> scale * rotation @ x + translation."""
        return replace(
            self,
            vertices=scale * self.vertices @ rotation.T + translation,
            points=scale * self.points @ rotation.T + translation,
            normals=self.normals @ rotation.T,
        )


def read_generated(data: bytes, seed: int = 0) -> GeneratedMesh:
    """Read the .glb of a generator.

    Raises:
        GenerationError: it holds no usable mesh.
    """
    try:
        loaded = load_mesh(io.BytesIO(data), "glb")
    except ValueError as error:
        raise GenerationError(f"its mesh is of no use: {error}") from error
    vertices, faces = upright(loaded.vertices, gltf=True), np.asarray(loaded.faces, np.int64)
    corner = vertices[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    size = np.ptp(vertices[faces.ravel()], axis=0)
    if not area.sum() > 0 or not size.max() > 0 or size.min() < 1e-4 * size.max():
        raise GenerationError("its mesh is of no use: it is flat or a point")
    chosen, weight = _spread(area, _SAMPLES, seed)
    points = np.einsum("nk,nkc->nc", weight, corner[chosen])
    normals = cross[chosen] / np.maximum(2 * area[chosen, None], 1e-30)
    colors = _colors(loaded, faces[chosen], weight)
    faces = faces[area > 0].astype(np.int32)
    if len(faces) > _MOST_FACES:
        vertices, faces = _lighter(vertices, faces)
    return GeneratedMesh(vertices, faces, points, normals, colors)


def _spread(area: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (n,) and barycentric weights (n, 3) of points by stratified sampling of the surface."""
    rng = np.random.default_rng(seed)
    edges = np.cumsum(area)
    # One point in each of n equal parts of the area leaves no holes.
    place = (np.arange(count) + rng.random(count)) * (edges[-1] / count)
    chosen = np.minimum(np.searchsorted(edges, place, side="right"), len(area) - 1)
    u, v = rng.random((2, count))
    root = np.sqrt(u)
    return chosen, np.stack([1 - root, root * (1 - v), root * v], -1)


def _colors(loaded: Any, corners: np.ndarray, weight: np.ndarray) -> np.ndarray | None:
    """Return the colors uint8 (n, 3) at points with these triangle corners (n, 3) and barycentric weights."""
    drawn = picture_of(loaded)
    if drawn is not None:
        uv, picture = drawn
        place = np.einsum("nk,nkc->nc", weight, uv[corners]) % 1.0
        rows, columns = picture.shape[:2]
        x = np.clip((place[:, 0] * columns).astype(np.int64), 0, columns - 1)
        y = np.clip(((1.0 - place[:, 1]) * rows).astype(np.int64), 0, rows - 1)
        return picture[y, x]
    colors = colors_of(loaded)
    if colors is None or (colors == colors[0]).all():  # the default gray of readers
        return None
    mixed = np.einsum("nk,nkc->nc", weight, colors[corners].astype(np.float64))
    return np.clip(np.round(mixed), 0, 255).astype(np.uint8)


def _lighter(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decimate to `_MOST_FACES` by quadric error."""
    # Merge the vertices that readers split at texture seams, or the seams would open.
    place, index = np.unique(
        np.round(vertices / np.ptp(vertices, axis=0).max(), 7), axis=0, return_inverse=True
    )
    joined = np.zeros_like(place)
    joined[index.ravel()] = vertices
    return decimate(joined, index.ravel()[faces], _MOST_FACES, 3)
