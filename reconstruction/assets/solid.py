"""Closed triangle meshes: extraction from a signed distance field, cleaning, smoothing, decimation, boxes and hulls."""

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.assets.completion import CompletedField

if TYPE_CHECKING:
    import manifold3d

_LEG_SHARE, _LEG_HEIGHT_SHARE = (
    0.003,
    0.4,
)  # least volume and height of a leg, relative to the main body, to the solid
_LEG_GAP_M, _LEG_OVERLAP_M = 0.06, 0.003  # widest gap that is bridged; overlap after that
_MOST_POINTS = 5000  # seen points that are looked up
_SEEN_SHARE = 0.01  # least share of the seen points on a body that is kept though small
_MAX_VOLUME_CHANGE = 0.1  # by decimation, relative
_DECIMATING = threading.Lock()  # fast_simplification keeps its mesh in global variables


@dataclass(frozen=True)
class Solid:
    """A closed triangle mesh with outward normals."""

    vertices: np.ndarray  # float64 (v, 3)
    faces: np.ndarray  # int32 (f, 3)

    @property
    def volume(self) -> float:
        """Return the enclosed volume in cubic metres."""
        return float(self.tetrahedra.sum() / 6)

    @property
    def tetrahedra(self) -> np.ndarray:
        """Return six times the signed volume (f,) that each face spans with the origin."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.einsum("nk,nk->n", a, np.cross(b, c))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner (3,) of the axis-aligned box."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    @property
    def extents(self) -> np.ndarray:
        """Return the size of the axis-aligned box (3,)."""
        return np.ptp(self.vertices, axis=0)


def extract(field: CompletedField, points: np.ndarray | None = None) -> Solid | None:
    """Extract a field's zero surface by marching cubes, without small bodies (`without_crumbs`); None if empty."""
    from skimage.measure import marching_cubes

    if not (field.distance < 0).any():
        return None
    vertices, faces, _, _ = marching_cubes(field.distance, 0.0, gradient_direction="ascent")
    solid = Solid(field.origin + (vertices + 0.5) * field.voxel_m, faces.astype(np.int32))
    if solid.volume < 0:
        solid = Solid(solid.vertices, solid.faces[:, ::-1].copy())
    return without_crumbs(solid, points)


def without_crumbs(solid: Solid, points: np.ndarray | None = None, share: float = 0.04) -> Solid | None:
    """Drop small bodies and closed cavities; None where nothing is left.

    Two kinds of small bodies stay: tall ones (legs; a gap to the main body is bridged), and those with many seen points
    (the rail of a chair's back).

    Args:
        solid: closed bodies.
        points: float64 (k, 3) seen points in the same frame; None: volume alone decides.
        share: least volume of a body, relative to the largest.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    f = solid.faces
    n = len(solid.vertices)
    edges = coo_matrix(
        (np.ones(2 * len(f)), (np.r_[f[:, 0], f[:, 1]], np.r_[f[:, 1], f[:, 2]])), shape=(n, n)
    )
    count, label = connected_components(edges, directed=False)
    face_label = label[f[:, 0]]
    volumes = np.bincount(face_label, weights=solid.tetrahedra / 6, minlength=count)
    if volumes.max() <= 0:
        return None
    main = int(np.argmax(volumes))
    keep = volumes > share * volumes[main]
    keep |= (volumes > _LEG_SHARE * volumes[main]) & _well_seen(solid, label, count, points)
    vertices = solid.vertices.copy()
    height = float(np.ptp(vertices[:, 2]))
    for body in np.flatnonzero(volumes > _LEG_SHARE * volumes[main]):
        own = label == body
        if body == main or np.ptp(vertices[own, 2]) < _LEG_HEIGHT_SHARE * height:
            continue
        keep[body] = True
        vertices[own, 2] = _reaching(vertices[own], vertices[label == main])
    return compact(Solid(vertices, f[keep[face_label]]))


def _well_seen(solid: Solid, label: np.ndarray, count: int, points: np.ndarray | None) -> np.ndarray:
    """Return which of `count` bodies (`label` of each vertex) hold many of the seen points."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    if points is None or len(points) == 0:
        return np.zeros(count, bool)
    some = points[:: max(1, len(points) // _MOST_POINTS)]
    nearest = cKDTree(solid.vertices).query(some)[1]
    return np.bincount(label[nearest], minlength=count) > _SEEN_SHARE * len(some)


def _reaching(leg: np.ndarray, main: np.ndarray) -> np.ndarray:
    """Return the heights (k,) of a leg's vertices, stretched up over a small gap to the body above it."""
    low, high = leg.min(axis=0), leg.max(axis=0)
    over = np.all((main[:, :2] > low[:2]) & (main[:, :2] < high[:2]), axis=1)
    if not over.any():
        return leg[:, 2]
    gap = float(main[over, 2].min() - high[2])
    if not 0.0 < gap < _LEG_GAP_M:
        return leg[:, 2]
    return low[2] + (leg[:, 2] - low[2]) * (1 + (gap + _LEG_OVERLAP_M) / (high[2] - low[2]))


def surface_samples(solid: Solid, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return points (count, 3) that are uniformly distributed on the surface."""
    corner = solid.vertices[solid.faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    return np.einsum("nk,nkc->nc", rng.dirichlet((1.0, 1.0, 1.0), count), corner[chosen])


def compact(solid: Solid) -> Solid:
    """Drop vertices that no face uses."""
    used, inverse = np.unique(solid.faces, return_inverse=True)[:2]
    return Solid(solid.vertices[used], inverse.reshape(-1, 3).astype(np.int32))


def taubin(solid: Solid, iterations: int, fixed: np.ndarray) -> Solid:
    """Smooth without shrinking (Taubin 1995); vertices marked `fixed` (v,) keep their height."""
    from scipy.sparse import coo_matrix

    if iterations == 0:
        return solid
    f, n = solid.faces, len(solid.vertices)
    rows, columns = np.r_[f[:, 0], f[:, 1], f[:, 2]], np.r_[f[:, 1], f[:, 2], f[:, 0]]
    neighbours = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n)).tocsr()
    neighbours = ((neighbours + neighbours.T) > 0).astype(np.float64)
    average = neighbours.multiply(1.0 / np.maximum(neighbours.sum(axis=1), 1)).tocsr()
    vertices = solid.vertices.copy()
    height = vertices[fixed, 2].copy()
    for _ in range(iterations):
        for factor in (0.5, -0.53):
            vertices = vertices + factor * (average @ vertices - vertices)
            vertices[fixed, 2] = height
    return Solid(vertices, solid.faces)


def decimate(
    vertices: np.ndarray, faces: np.ndarray, max_faces: int, aggressiveness: int
) -> tuple[np.ndarray, np.ndarray]:
    """Decimate a mesh to about `max_faces` faces by quadric error: float64 (v, 3), int32 (f, 3)."""
    import fast_simplification

    with _DECIMATING:
        vertices, faces = fast_simplification.simplify(
            np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32),
            target_count=max_faces, agg=aggressiveness,
        )[:2]  # fmt: skip
    return vertices.astype(np.float64), faces.astype(np.int32)


def lightened(solid: Solid, max_faces: int) -> Solid | None:
    """Decimate to about `max_faces` faces by quadric error; None where the result is open or changes the volume."""
    closed = to_manifold(compact(Solid(*decimate(solid.vertices, solid.faces, max_faces, 4))))
    if closed is None or abs(closed.volume - solid.volume) >= 0.05 * solid.volume + 1e-7:
        return None
    return closed


def lighten(solid: Solid, max_faces: int, tolerance_m: float) -> Solid:
    """Decimate to a manifold mesh of about `max_faces` faces at most."""
    if len(solid.faces) > max_faces:
        light = lightened(solid, max_faces)
        if light is not None:
            return light
        solid = simplify_manifold(solid, max_faces, tolerance_m)
    closed = to_manifold(solid)
    return solid if closed is None else closed


def to_manifold(solid: Solid) -> Solid | None:
    """Return the mesh as manifold3d reads it; None where it is not a closed manifold."""
    body = manifold_of(solid)
    return None if body is None else from_manifold(body)


def manifold_of(solid: Solid) -> "manifold3d.Manifold | None":
    """Return a mesh as a manifold3d body; None where it is not a closed manifold."""
    import manifold3d

    body = _read_manifold(solid)
    if body.status() != manifold3d.Error.NoError or body.is_empty() or body.volume() <= 0:
        return None
    return body


def _read_manifold(solid: Solid) -> "manifold3d.Manifold":
    """Return a mesh as a manifold3d body, which has an error status where it is no manifold."""
    import manifold3d

    mesh = manifold3d.Mesh(
        vert_properties=np.ascontiguousarray(solid.vertices, np.float32),
        tri_verts=np.ascontiguousarray(solid.faces, np.uint32),
    )
    mesh.merge()
    return manifold3d.Manifold(mesh)


def from_manifold(body: "manifold3d.Manifold") -> Solid:
    """Return the mesh of a manifold3d body."""
    out = body.to_mesh()
    vertices = np.array(out.vert_properties[:, :3], np.float64, order="C")
    return Solid(vertices, np.array(out.tri_verts, np.int32, order="C"))


def simplify_manifold(solid: Solid, max_faces: int, tolerance_m: float) -> Solid:
    """Decimate within a growing tolerance until `max_faces` is reached or the volume changes."""
    import manifold3d

    body = _read_manifold(solid)
    if body.status() != manifold3d.Error.NoError:
        return solid
    light = body
    for factor in (0.3, 0.6, 1.0, 2.0, 4.0):
        made = body.simplify(tolerance_m * factor)
        # A tolerance near the thickness of a body destroys it: a table's top layer is a few millimetres thin.
        if abs(made.volume() - body.volume()) > _MAX_VOLUME_CHANGE * body.volume():
            break
        light = made
        if light.num_tri() <= max_faces:
            break
    return from_manifold(light)


def raster_section(
    body: "manifold3d.Manifold", height: float, low: np.ndarray, cell: float, shift: float, shape: np.ndarray
) -> np.ndarray:
    """Draw a body's horizontal section: uint8 (rows along y, columns along x), 1 inside, to a sixteenth of a cell.

    `low` (2,) is drawn at coordinate `shift` of the picture, where pixel centers are whole; `shape` is columns, rows.
    """
    import cv2

    out = np.zeros((shape[1], shape[0]), np.uint8)
    outlines = [((outline - low) / cell + shift) * 16 for outline in body.slice(height).to_polygons()]
    fixed_point = [np.round(outline).astype(np.int32) for outline in outlines]
    cv2.fillPoly(out, fixed_point, 1, cv2.LINE_8, 4)  # even-odd
    return out


def box_solid(low: np.ndarray, high: np.ndarray) -> Solid:
    """Return the closed box between two corners."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
         [1, 5, 7], [1, 7, 3]], np.int32,
    )  # fmt: skip
    return Solid(np.asarray(low) + corners * (np.asarray(high) - np.asarray(low)), faces)


def hull_solid(points: np.ndarray) -> Solid:
    """Return the convex hull of points as a closed mesh with outward normals."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    faces = hull.simplices.copy()
    center = points[hull.vertices].mean(axis=0)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("nk,nk->n", np.cross(b - a, c - a), a - center) < 0
    faces[inward] = faces[inward][:, ::-1]
    return compact(Solid(np.asarray(points, np.float64), faces.astype(np.int32)))
