"""The vertex graph of the surface mesh: adjacency, areas, smoothed normals and colors, connected components."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from reconstruction.core.types import Surface


@dataclass(frozen=True)
class MeshGraph:
    """Vertices of the surface with their attributes, and the edges between them."""

    points: np.ndarray  # float64 (v, 3) world space, metres
    normals: np.ndarray  # float64 (v, 3) unit, smoothed
    lab: np.ndarray  # float32 (v, 3) CIELAB, smoothed
    areas: np.ndarray  # float64 (v,) m^2, a third of the area of adjacent triangles
    edges: np.ndarray  # int32 (e, 2) each mesh edge once, smaller index first
    spacing_m: float  # median edge length

    @classmethod
    def from_surface(cls, surface: Surface) -> "MeshGraph":
        """Build the graph of a surface; normals are averaged over mesh neighbors twice, colors once."""
        points = np.asarray(surface.vertices, np.float64)
        faces = np.asarray(surface.faces, np.int64)
        count = len(points)
        corners = points[faces]
        spanned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled = np.linalg.norm(spanned, axis=1)
        areas = np.bincount(faces.ravel(), weights=np.repeat(doubled / 6.0, 3), minlength=count)
        pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        keys = np.unique(pairs[:, 0] * count + pairs[:, 1]) if count else np.zeros(0, np.int64)
        edges = np.stack([keys // max(count, 1), keys % max(count, 1)], axis=1).astype(np.int32)
        averaging = _averaging_matrix(edges, count)
        normals = np.asarray(surface.normals, np.float64)
        lab = lab_from_rgb(surface.colors)
        for _ in range(2):
            normals = averaging @ normals
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        lab = (averaging @ lab).astype(np.float32)
        lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
        spacing = float(np.median(lengths)) if len(lengths) else float(surface.voxel_size_m)
        return cls(points, normals, lab, areas, edges, max(spacing, 1e-3))

    def edges_within(self, chosen: np.ndarray) -> np.ndarray:
        """Return the edges, int32 (k, 2), between vertices `chosen` (indices or mask), in the order of `edges`."""
        inside = np.zeros(len(self.points), bool)
        inside[chosen] = True
        return self.edges[inside[self.edges[:, 0]] & inside[self.edges[:, 1]]]


def lab_from_rgb(colors: np.ndarray) -> np.ndarray:
    """Convert uint8 sRGB (..., 3) to float32 CIELAB (..., 3)."""
    flat = np.ascontiguousarray(colors, np.float32).reshape(1, -1, 3) / 255.0
    if flat.size == 0:
        return np.zeros(np.shape(colors), np.float32)
    return cv2.cvtColor(flat, cv2.COLOR_RGB2LAB).reshape(np.shape(colors))


def _averaging_matrix(edges: np.ndarray, count: int) -> csr_matrix:
    """Return the matrix (v, v) that averages each vertex and its neighbors."""
    rows = np.concatenate([edges[:, 0], edges[:, 1], np.arange(count)])
    columns = np.concatenate([edges[:, 1], edges[:, 0], np.arange(count)])
    matrix = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    degree = np.asarray(matrix.sum(axis=1)).ravel()
    matrix.data /= np.repeat(degree, np.diff(matrix.indptr))
    return matrix


def pieces(graph: MeshGraph, chosen: np.ndarray, bridge_m: float = 0.0) -> list[np.ndarray]:
    """Split vertices `chosen` (sorted indices) into connected components, the largest area first.

    With `bridge_m` > 0 vertices closer than that are connected as well, across holes of the mesh.
    """
    chosen = np.asarray(chosen)
    if len(chosen) == 0:
        return []
    local = np.full(len(graph.points), -1, np.int64)
    local[chosen] = np.arange(len(chosen))
    links = local[graph.edges_within(chosen)]
    if bridge_m > 0:
        near = KDTree(graph.points[chosen]).query_pairs(bridge_m, output_type="ndarray")
        links = np.concatenate([links, near])
    adjacency = coo_matrix(
        (np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(len(chosen),) * 2
    )
    _, labels = connected_components(adjacency, directed=False)
    order = np.argsort(labels, kind="stable")
    groups = np.split(chosen[order], np.flatnonzero(np.diff(labels[order])) + 1)
    return sorted(groups, key=lambda g: (-graph.areas[g].sum(), g[0]))
