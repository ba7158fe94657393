"""What makers of varied shapes build with: raw triangle meshes, their textured solids, random looks, a bench.

A raw mesh is (vertices float64 (v, 3), faces int (f, 3)) and closed. How finely it follows its curves is fixed
by numbers of segments; a fine step only divides its flat triangles, so that the fine and the coarse version have
the same shape.
"""

# ruff: noqa: RUF005 - arrays are added here, nothing is concatenated

from collections.abc import Sequence
from functools import cache

import manifold3d
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from synthetic import textures
from synthetic.furniture import Workshop
from synthetic.shapes import COARSE, Patch, Solid, moved
from synthetic.textures import Texture
from synthetic.things import Place, Thing

Raw = tuple[np.ndarray, np.ndarray]

_CREASE_DEG = 38.0  # sharper edges are seen as edges
_LARGEST_M, _SMALLEST_M = 0.45, 0.045  # of the longest side of a thing
_SAME_M = 1e-5  # closer corners of an outline are one
_LONG_STEPS = 1.5  # edges of triangles may be that many steps long; light is stored per vertex
_HALVED = (
    (0, 1, 2), (0, 3, 2, 3, 1, 2), (0, 1, 4, 0, 4, 2), (0, 3, 2, 3, 1, 4, 3, 4, 2), (0, 1, 5, 5, 1, 2),
    (0, 3, 5, 3, 1, 5, 5, 1, 2), (0, 1, 4, 0, 4, 5, 5, 4, 2), (0, 3, 5, 3, 1, 4, 5, 4, 2, 3, 4, 5),
)  # fmt: skip
"""What a triangle becomes whose long edges 01, 12, 20 are the bits of the index; 3 4 5 are their middles."""
_WORDS = (
    ("NOVA", "LINE 4"), ("HELLO", "WORLD"), ("FRAGILE",), ("N 51", "E 13"), ("AURORA",), ("PLAY",), ("2 4 8",),
    ("SALT", "& STONE"), ("MODEL X", "220 V"), ("GARDEN",), ("OPEN", "HERE"), ("SILENT", "RIVER"), ("A1", "B2"),
)  # fmt: skip


# Raw meshes


def turn(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """Return a rotation (3, 3) about x, then y, then z, in degrees."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians((x, y, z))), np.sin(np.radians((x, y, z)))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]]) @ about_y @ about_x


def posed(raw: Raw, at: Sequence[float] = (0, 0, 0), rotation: np.ndarray | None = None) -> Raw:
    """Turn a raw mesh, then move it."""
    vertices = raw[0] if rotation is None else raw[0] @ rotation.T
    return vertices + np.asarray(at, float), raw[1]


def grounded(raw: Raw, cut: float) -> Raw:
    """Flatten what lies in the lowest share `cut` of the height, and stand it on z = 0.

    The part below the cut must not widen downwards, or its faces would fold over each other.
    """
    vertices = raw[0].copy()
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    vertices[:, 2] = np.maximum(vertices[:, 2] - low - cut * (high - low), 0.0)
    return vertices, raw[1]


def _ring_faces(rows: int, columns: int, closed: bool = False) -> np.ndarray:
    """Return faces between rings of points; columns wrap around, rows too where `closed`."""
    row = np.arange(rows if closed else rows - 1)[:, None]
    column = np.arange(columns)[None]
    after, beside = (row + 1) % rows, (column + 1) % columns
    a, b = row * columns + column, row * columns + beside
    c, d = after * columns + beside, after * columns + column
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])


def _capped(rings: np.ndarray, ends: np.ndarray) -> Raw:
    """Close rings (r, c, 3) with a fan to one point at each end (2, 3)."""
    rows, columns = rings.shape[:2]
    around, beside = np.arange(columns), (np.arange(columns) + 1) % columns
    first, last = rows * columns, (rows - 1) * columns
    bottom = np.stack([np.full(columns, first), beside, around], -1)
    top = np.stack([np.full(columns, first + 1), last + around, last + beside], -1)
    faces = np.concatenate([_ring_faces(rows, columns), bottom, top])
    return np.concatenate([rings.reshape(-1, 3), ends]), faces


def raw_box(width: float, depth: float, height: float) -> Raw:
    """Make a box on its bottom centre."""
    return raw_extrude(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, depth / 2), height)


def raw_lathe(profile: np.ndarray, segments: int = 32, closed: bool = False) -> Raw:
    """Turn a profile (k, 2) of (radius, height) around z; it starts and ends on the axis, or is `closed`."""
    angles = np.arange(segments) * 2 * np.pi / segments
    flat = np.stack([np.cos(angles), np.sin(angles)], -1)
    points = np.asarray(profile, float)
    body = points if closed else points[1:-1]
    rings = np.empty((len(body), segments, 3))
    rings[..., :2], rings[..., 2] = body[:, None, :1] * flat[None], body[:, 1:]
    if closed:
        return rings.reshape(-1, 3), _ring_faces(len(body), segments, closed=True)
    return _capped(rings, np.array([[0, 0, points[0, 1]], [0, 0, points[-1, 1]]]))


def raw_superquadric(
    radii: Sequence[float], upright: float, level: float, rings: int = 20, segments: int = 32
) -> Raw:
    """Make a superellipsoid around the origin: exponents in elevation and in plan; 1 is round, 0 square."""
    power = lambda a, e: np.sign(a) * np.abs(a) ** e  # noqa: E731 - a formula
    up = np.linspace(-np.pi / 2, np.pi / 2, rings + 2)
    around = np.arange(segments) * 2 * np.pi / segments + np.pi / segments
    wide = power(np.cos(up[1:-1]), upright)
    body = np.empty((rings, segments, 3))
    body[..., 0] = radii[0] * wide[:, None] * power(np.cos(around), level)
    body[..., 1] = radii[1] * wide[:, None] * power(np.sin(around), level)
    body[..., 2] = radii[2] * power(np.sin(up[1:-1]), upright)[:, None]
    return _capped(body, np.array([[0, 0, -radii[2]], [0, 0, radii[2]]], float))


@cache
def _unit_sphere(level: int) -> Raw:
    import trimesh

    sphere = trimesh.creation.icosphere(level)
    return np.array(sphere.vertices), np.array(sphere.faces)


def raw_ellipsoid(radii: Sequence[float], level: int = 2) -> Raw:
    """Make an ellipsoid around the origin."""
    vertices, faces = _unit_sphere(level)
    return vertices * np.asarray(radii, float), faces


def raw_sweep(
    path: np.ndarray, radius: float | np.ndarray, sides: int = 8, flat: float = 1.0, closed: bool = False
) -> Raw:
    """Sweep a circle (pressed by `flat` along its second axis) along a path (k, 3) in space; cap the ends.

    The second axis points upwards all along paths that are nowhere steep, so that what lies on the support
    touches it with a facet; else it starts upwards, if it can, and turns as little as possible.
    """
    path = np.asarray(path, float)
    ahead = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    level = np.abs(ahead[:, 2]).max() < 0.9
    up = np.array([0, 0, 1.0]) if level or abs(ahead[0, 2]) < 0.9 else np.array([0, 1.0, 0])
    ups = np.empty_like(path)
    for number, direction in enumerate(ahead):
        up = np.array([0, 0, 1.0]) if level else up
        up = up - direction * (up @ direction)
        up = up / max(float(np.linalg.norm(up)), 1e-12)
        ups[number] = up
    across = np.cross(ups, ahead)
    angles = (np.arange(sides) + 0.5) * 2 * np.pi / sides + np.pi / 2
    radii = np.broadcast_to(np.asarray(radius, float), len(path))[:, None, None]
    ring = np.cos(angles)[None, :, None] * across[:, None]
    ring = ring + flat * np.sin(angles)[None, :, None] * ups[:, None]
    rings = path[:, None] + radii * ring
    if closed:
        return rings.reshape(-1, 3), _ring_faces(len(path), sides, closed=True)
    return _capped(rings, path[[0, -1]])


def rod(a: Sequence[float], b: Sequence[float], radius: float, sides: int = 8, taper: float = 1.0) -> Raw:
    """Make a straight rod from a to b; `taper` is its last radius over its first."""
    return raw_sweep(np.array([a, b], float), np.array([radius, taper * radius]), sides)


def cleaned(outline: np.ndarray) -> np.ndarray:
    """Drop doubled points and points on straight edges."""
    points = np.asarray(outline, float)
    while True:
        before, after = points - np.roll(points, 1, 0), np.roll(points, -1, 0) - points
        keep = np.linalg.norm(before, axis=1) > _SAME_M
        if keep.all():
            keep = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]) > 1e-9
        if keep.all():
            return points
        points = points[keep]


def cut_below(outline: np.ndarray, level: float) -> np.ndarray:
    """Cut off what of an outline (k, 2) lies below a level, or a lower one where that would cut it in two."""
    outline, low = _counter_clockwise(outline), float(outline[:, 1].min())
    for _ in range(12):
        out, facets = [], []
        for a, b in zip(outline, np.roll(outline, -1, axis=0)):
            if a[1] >= level:
                out.append(a)
            if (a[1] >= level) != (b[1] >= level):
                out.append(a + (level - a[1]) / (b[1] - a[1]) * (b - a))
                facets.append((a[1] >= level, float(out[-1][0])))
        if facets and not facets[0][0]:
            facets = facets[1:] + facets[:1]  # every facet starts where the outline goes below
        # Facets run to the right; one that runs back is the inner side of what would fall apart.
        if all(end[1] > start[1] for start, end in zip(facets[::2], facets[1::2])):
            break
        level = low + 0.5 * (level - low)
    return cleaned(np.array(out))


def _counter_clockwise(outline: np.ndarray) -> np.ndarray:
    x, y = outline.T
    return outline if np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) > 0 else outline[::-1]


def raw_extrude(
    outline: np.ndarray, height: float, holes: Sequence[np.ndarray] = (), layers: int = 1,
    taper: float = 1.0, twist_deg: float = 0.0,
) -> Raw:  # fmt: skip
    """Extrude an outline (k, 2) with holes from z = 0 up; it may shrink and twist on its way."""
    rims = [_counter_clockwise(cleaned(outline)), *(_counter_clockwise(cleaned(h))[::-1] for h in holes)]
    flat = np.concatenate(rims)
    caps = np.array(manifold3d.triangulate([np.ascontiguousarray(r) for r in rims]), np.int64)
    count, levels = len(flat), []
    for share in np.linspace(0, 1, layers + 1):
        scaled = flat * (1 + share * (taper - 1)) @ turn(z=twist_deg * share)[:2, :2].T
        levels.append(np.column_stack([scaled, np.full(count, share * height)]))
    faces, start = [caps[:, ::-1], caps + layers * count], 0
    for rim in rims:
        index = start + np.arange(len(rim))
        beside = np.roll(index, -1)
        for layer in range(layers):
            low, high = layer * count, (layer + 1) * count
            faces.append(np.stack([index + low, beside + low, beside + high], -1))
            faces.append(np.stack([index + low, beside + high, index + high], -1))
        start += len(rim)
    return np.concatenate(levels), np.concatenate(faces)


def raw_slab(grid: np.ndarray, thickness: float | np.ndarray) -> Raw:
    """Give a sheet, a grid of points (r, c, 3), a thickness (also per point): half to either side."""
    rows, columns = grid.shape[:2]
    along, across = np.gradient(grid, axis=0), np.gradient(grid, axis=1)
    normal = np.cross(along, across)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    half = 0.5 * np.broadcast_to(np.asarray(thickness, float), (rows, columns))[..., None] * normal
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    top = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    beside, below = np.roll(rim, -1), rows * columns
    sides = [np.stack([beside, rim, rim + below], -1), np.stack([beside, rim + below, beside + below], -1)]
    vertices = np.concatenate([(grid + half).reshape(-1, 3), (grid - half).reshape(-1, 3)])
    return vertices, np.concatenate([top, top[:, ::-1] + below, *sides])


def raw_leaf(length: float, width: float, droop: float, fold: float, thickness: float = 0.0012) -> Raw:
    """Make a leaf from the origin along +x: pointed, folded along its rib, bent down by `droop` radians."""
    t = np.linspace(0, 1, 7)
    angle = droop * t
    rib = np.cumsum(np.column_stack([np.cos(angle), np.sin(-angle)]), axis=0) * length / 7
    rib = rib - rib[0]
    half = 0.5 * width * np.maximum(np.sin(np.pi * t**0.8), 0.09)
    side = np.array([-1.0, 0.0, 1.0])
    grid = np.empty((7, 3, 3))
    grid[..., 0], grid[..., 1] = rib[:, :1], half[:, None] * side
    grid[..., 2] = rib[:, 1:] + fold * half[:, None] * np.abs(side)
    return raw_slab(grid, thickness * np.maximum(np.sin(np.pi * t**0.8), 0.2)[:, None])


def wobbled(raw: Raw, rng: np.random.Generator, amount: float, size_m: float, waves: int = 5) -> Raw:
    """Push points to and fro by smooth waves of about `size_m`; `amount` in metres."""
    vertices = raw[0]
    vectors = rng.standard_normal((waves, 3)) * 2.0 / size_m
    phases, pushes = rng.uniform(0, 2 * np.pi, waves), rng.standard_normal((waves, 3))
    moves = np.sin(vertices @ vectors.T + phases) @ pushes
    return vertices + amount / np.sqrt(waves) * moves, raw[1]


# Outlines and curves


def rounded(width: float, height: float, radius: float, corner: int = 5) -> np.ndarray:
    """Return a rectangle (k, 2) around the origin with round corners."""
    radius = min(radius, 0.49 * width, 0.49 * height)
    bend = np.linspace(0, np.pi / 2, corner)
    arc = radius * np.stack([np.cos(bend), np.sin(bend)], -1)
    x, y = width / 2 - radius, height / 2 - radius
    corners = [arc + (x, y), arc[::-1] * (-1, 1) + (-x, y), -arc + (-x, -y), arc[::-1] * (1, -1) + (x, -y)]
    return np.concatenate(corners)


def ring(radius: float, count: int = 32) -> np.ndarray:
    """Return a circle (k, 2)."""
    angles = np.arange(count) * 2 * np.pi / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], -1)


def smooth(points: np.ndarray, count: int, closed: bool = False) -> np.ndarray:
    """Lead a smooth curve (count, d) through points (k, d)."""
    from scipy.interpolate import CubicSpline

    points = np.asarray(points, float)
    if closed:
        points = np.concatenate([points, points[:1]])
    knots = np.arange(len(points))
    curve = CubicSpline(knots, points, bc_type="periodic" if closed else "natural")
    at = np.linspace(0, knots[-1], count + 1)[:-1] if closed else np.linspace(0, knots[-1], count)
    return curve(at)


def gentle(points: np.ndarray, count: int) -> np.ndarray:
    """Lead a curve (count, 2) through points (radius, height) that does not overshoot."""
    from scipy.interpolate import PchipInterpolator

    points = np.asarray(points, float)
    knots = np.arange(len(points))
    return PchipInterpolator(knots, points)(np.linspace(0, knots[-1], count))


def bow(a: Sequence[float], b: Sequence[float], way: Sequence[float], count: int = 14) -> np.ndarray:
    """Return a path (count, 3) from a to b that swings out by the vector `way`, as handles do."""
    t = np.linspace(0, 1, count)[:, None]
    swing = np.sin(np.pi * t) ** 0.7
    return (1 - t) * np.asarray(a, float) + t * np.asarray(b, float) + swing * np.asarray(way, float)


# Solids


def divided(
    vertices: np.ndarray, faces: np.ndarray, owner: np.ndarray, step_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Halve long edges, alike in both faces of an edge, until none is left; `owner` (v,) follows vertices."""
    longest = _LONG_STEPS * step_m
    for _ in range(6):
        a, b = faces, faces[:, [1, 2, 0]]
        long = ((vertices[a] - vertices[b]) ** 2).sum(-1) > longest**2
        if not long.any():
            break
        first, second = np.minimum(a[long], b[long]), np.maximum(a[long], b[long])
        keys, number = np.unique(first.astype(np.int64) * len(vertices) + second, return_inverse=True)
        points = np.zeros((len(faces), 6), np.int64)
        points[:, :3] = faces
        points[:, 3:][long] = len(vertices) + number
        ends = np.stack([keys // len(vertices), keys % len(vertices)])
        vertices = np.concatenate([vertices, 0.5 * (vertices[ends[0]] + vertices[ends[1]])])
        owner = np.concatenate([owner, owner[ends[0]]])
        code = long @ np.array([1, 2, 4])
        faces = np.concatenate([points[code == k][:, t].reshape(-1, 3) for k, t in enumerate(_HALVED)])
    return vertices, faces, owner


def _outwards(raw: Raw) -> Raw:
    corner = raw[0][raw[1]]
    volume = np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))
    return raw if volume > 0 else (raw[0], raw[1][:, ::-1])


def mesh_solids(
    raws: Sequence[Raw], texture: str, step_m: float, crease_deg: float = _CREASE_DEG
) -> list[Solid]:
    """Make solids of closed raw meshes: outwards, shaded smoothly up to the crease, mapped from six sides."""
    raws = [_outwards(raw) for raw in raws]
    counts = [len(v) for v, _ in raws]
    starts = np.cumsum([0, *counts])
    vertices = np.concatenate([v for v, _ in raws])
    faces = np.concatenate([f + s for (_, f), s in zip(raws, starts)])
    owner = np.repeat(np.arange(len(raws)), counts)
    if step_m < COARSE:
        vertices, faces, owner = divided(vertices, faces, owner, step_m)
    # From here on the vertices and the faces of a raw mesh stand together.
    order = np.argsort(owner, kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    vertices, faces = vertices[order], place[faces]
    starts = np.searchsorted(owner[order], np.arange(len(raws) + 1))
    corner = vertices[faces]
    areas = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    unit = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-30)
    groups = _smooth_groups(faces, unit, np.cos(np.radians(crease_deg)))
    axis = np.abs(unit).argmax(1)
    aspect = 2 * axis + (np.take_along_axis(unit, axis[:, None], 1)[:, 0] < 0)
    # One normal for every corner of a group; one texture coordinate for every side it is mapped from.
    group_count = groups.max() + 1
    shared = (faces * group_count + groups[:, None]).ravel()
    keys, which = np.unique(shared * 6 + np.repeat(aspect, 3), return_inverse=True)
    _, norm_of = np.unique(shared, return_inverse=True)
    sums = np.stack([np.bincount(norm_of, np.repeat(areas[:, k], 3)) for k in range(3)], -1)
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)
    normals = np.empty((len(keys), 3))
    normals[which] = sums[norm_of]
    origin = keys // (6 * group_count)
    points, side = vertices[origin], keys % 6
    uvs = _mapped(points, side)
    new_faces = which.reshape(-1, 3).astype(np.int32)
    owner = np.searchsorted(starts, origin, side="right") - 1  # keys are sorted by vertex, so by raw mesh
    face_owner = np.searchsorted(starts, faces[:, 0], side="right") - 1
    out = []
    for number in range(len(raws)):
        low, high = np.searchsorted(owner, (number, number + 1))
        own = new_faces[face_owner == number] - low
        out.append(
            (Patch(points[low:high], normals[low:high], uvs[low:high], own.astype(np.int32), texture),)
        )
    return out


def mesh_solid(raw: Raw, texture: str, step_m: float, crease_deg: float = _CREASE_DEG) -> Solid:
    """Make a solid of one closed raw mesh, see `mesh_solids`."""
    return mesh_solids([raw], texture, step_m, crease_deg)[0]


def _smooth_groups(faces: np.ndarray, unit: np.ndarray, least_cosine: float) -> np.ndarray:
    """Number the groups of faces that join without a crease (f,)."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2)
    key = edges[:, 0] * (faces.max() + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    twin = key[order][1:] == key[order][:-1]
    a, b = order[:-1][twin] // 3, order[1:][twin] // 3
    soft = np.einsum("ij,ij->i", unit[a], unit[b]) > least_cosine
    graph = coo_matrix((np.ones(soft.sum()), (a[soft], b[soft])), shape=(len(faces),) * 2)
    return connected_components(graph, directed=False)[1]


def _mapped(points: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Map points from the side (+x -x +y -y +z -z) they face: u to the right, v up."""
    x, y, z = points.T
    u = np.select([side == 0, side == 1, side == 2], [y, -y, -x], x)
    v = np.select([side == 4, side == 5], [y, -y], z)
    return np.stack([u, v], -1)


# Looks


def random_color(rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw any color: half of them greyish, some white or black."""
    kind, tone = rng.random(), rng.uniform(0.12, 0.95)
    weights = rng.dirichlet((0.5, 0.5, 0.5))
    if kind < 0.14:
        return tuple((rng.uniform(212, 246) + rng.uniform(-5, 5, 3)).tolist())
    if kind < 0.27:
        return tuple((rng.uniform(14, 46) + rng.uniform(-5, 5, 3)).tolist())
    strength = rng.uniform(0.05, 0.35) if kind < 0.55 else rng.uniform(0.4, 1.0)
    rgb = 255 * tone * ((1 - strength) + strength * weights / weights.max())
    return tuple(np.clip(rgb, 8, 248).tolist())


def _pattern(rng: np.random.Generator, shape: tuple[int, int], density: float) -> np.ndarray:
    """Draw stripes, checks, dots or waves as a mask (h, w) of 0..1."""
    row = np.arange(shape[0], dtype=np.float32)[:, None] / max(density, 1.0)
    column = np.arange(shape[1], dtype=np.float32)[None] / max(density, 1.0)
    period, kind = rng.uniform(0.006, 0.05), rng.integers(5)
    angle = float(rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)]))
    u = (row * np.sin(angle) + column * np.cos(angle)) / period
    v = (row * np.cos(angle) - column * np.sin(angle)) / period
    if kind == 0:
        mask = u % 1 < rng.uniform(0.15, 0.6)
    elif kind == 1:
        mask = (np.floor(u) + np.floor(v)) % 2 > 0
    elif kind == 2:
        mask = np.hypot(u % 1 - 0.5, v % 1 - 0.5) < rng.uniform(0.2, 0.42)
    elif kind == 3:
        mask = (u % 1 < 0.12) | (v % 1 < 0.12)
    else:
        mask = np.sin(2 * np.pi * (u + 0.4 * np.sin(2 * v))) > 0
    return mask.astype(np.float32)


def _drawn(image: np.ndarray, width_m: float, height_m: float) -> Texture:
    return Texture(np.clip(image, 0, 255).astype(np.uint8), width_m, height_m)


def random_look(shop: Workshop, width_m: float, height_m: float, kind: str = "") -> Texture:
    """Draw the texture of a part: plain in 38 of 100 cases, else speckled, patterned, printed, wood, noise ...

    Args:
        shop: Its stream of random numbers and its factor on resolutions are used.
        width_m: Extent of the drawn image, which repeats; 0.1 to 0.3 is enough for small things.
        height_m: As above.
        kind: Draws this kind: plain, white, dark, metal, paint, speckle, pattern, print, wood, cardboard,
            noise, green.
    """
    rng = shop.rng
    kinds = (
        "plain",
        "white",
        "dark",
        "metal",
        "paint",
        "speckle",
        "pattern",
        "print",
        "wood",
        "cardboard",
        "noise",
    )
    shares = (0.20, 0.08, 0.07, 0.03, 0.14, 0.09, 0.11, 0.07, 0.09, 0.04, 0.08)
    kind = kind or str(rng.choice(kinds, p=shares))
    density = rng.uniform(800, 1300) * shop.density
    rgb, other = random_color(rng), random_color(rng)
    shape = (max(8, round(height_m * density)), max(8, round(width_m * density)))
    area = (rng, width_m, height_m, density)
    if kind == "white":
        return textures.plain(tuple((rng.uniform(205, 247) + rng.uniform(-6, 6, 3)).tolist()))
    if kind == "dark":
        return textures.plain(tuple((rng.uniform(10, 40) + rng.uniform(-4, 4, 3)).tolist()))
    if kind == "metal":
        return textures.plain(tuple((rng.uniform(90, 200) + rng.uniform(-4, 8, 3)).tolist()))
    if kind == "speckle":
        return textures.glaze(*area, rgb)
    if kind == "wood":
        base = rng.uniform((80, 50, 25), (205, 160, 110))
        return textures.wood(*area, tuple(np.sort(base)[::-1].tolist()))
    if kind == "cardboard":
        return textures.cardboard(*area, "".join(_WORDS[int(rng.integers(len(_WORDS)))][:1]))
    if kind == "print":
        return textures.label(*area, rgb, _WORDS[int(rng.integers(len(_WORDS)))])
    image = np.broadcast_to(np.array(rgb, np.float32), (*shape, 3)).copy()
    if kind == "paint":  # nearly plain
        image += rng.uniform(1, 5) * textures.octave_noise(rng, shape, (0.04 * density,) * 2, 4)[..., None]
    elif kind == "green":
        image[:] = np.array(rgb, np.float32) * 0.25 + rng.uniform((20, 60, 10), (110, 170, 70))
        image += (
            rng.uniform(0, 14)
            * textures.octave_noise(rng, shape, (0.03 * density, 0.008 * density), 4)[..., None]
        )
    elif kind == "pattern":
        image += _pattern(rng, shape, density)[..., None] * (np.array(other, np.float32) - image)
    elif kind == "noise":
        cells = (rng.uniform(0.005, 0.06) * density, rng.uniform(0.005, 0.06) * density)
        mask = np.clip(0.5 + 0.5 * textures.octave_noise(rng, shape, cells, 4), 0, 1)[..., None]
        image += mask * (np.array(other, np.float32) - image)
    else:
        return textures.plain(rgb)
    return _drawn(image, width_m, height_m)


# The bench


class Bench:
    """A thing under construction. Its shape and its looks draw from streams of their own."""

    def __init__(self, shop: Workshop, name: str) -> None:
        """Start with nothing; `name` is the prefix of the textures."""
        shape_seed, look_seed = shop.rng.integers(2**62, size=2)
        self.rng = np.random.default_rng(shape_seed)
        self.painter = Workshop(np.random.default_rng(look_seed), shop.step_m, shop.density)
        self.step_m, self.name = shop.step_m, name
        self.parts: list[Solid] = []
        self.textures: dict[str, Texture] = {}

    def u(self, low: float, high: float) -> float:
        """Draw a number."""
        return float(self.rng.uniform(low, high))

    def n(self, low: int, high: int) -> int:
        """Draw a whole number, both ends included."""
        return int(self.rng.integers(low, high + 1))

    def chance(self, share: float) -> bool:
        """Draw yes or no."""
        return bool(self.rng.random() < share)

    def pick(self, options: Sequence):
        """Draw one of these."""
        return options[int(self.rng.integers(len(options)))]

    def look(self, kind: str = "", size_m: float = 0.15) -> str:
        """Draw a texture and return its name."""
        name = f"{self.name}look{len(self.textures)}"
        self.textures[name] = random_look(self.painter, size_m, size_m, kind)
        return name

    def put(
        self, raw: Raw, look: str, at: Sequence[float] = (0, 0, 0), rotation: np.ndarray | None = None,
        crease_deg: float = _CREASE_DEG,
    ) -> None:  # fmt: skip
        """Add a part: mapped where it was made, then turned and moved."""
        solid = mesh_solid(raw, look, self.step_m, crease_deg)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.eye(3) if rotation is None else rotation, at
        self.parts.append(moved(solid, pose))

    def put_all(self, raws: Sequence[Raw], look: str, crease_deg: float = _CREASE_DEG) -> None:
        """Add many parts of one look."""
        if raws:
            self.parts += mesh_solids(raws, look, self.step_m, crease_deg)

    def thing(
        self, label: str, places: Sequence[Place] = (), vary: tuple[float, float] = (0.75, 1.25)
    ) -> Thing:
        """Finish: centre it, stand it on z = 0, vary its size."""
        patches = [patch for part in self.parts for patch in part]
        low = np.min([p.vertices.min(0) for p in patches], axis=0)
        high = np.max([p.vertices.max(0) for p in patches], axis=0)
        longest = float((high - low).max())
        scale = float(np.clip(self.u(*vary), _SMALLEST_M / longest, _LARGEST_M / longest))
        shift = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])

        def fitted(patch: Patch) -> Patch:
            vertices = scale * (patch.vertices - shift)
            return Patch(vertices, patch.normals, scale * patch.uvs_m, patch.faces, patch.texture)

        parts = [tuple(fitted(patch) for patch in part) for part in self.parts]
        moved_places = tuple(
            Place(
                scale * (p.height_m - shift[2]), scale * (p.area - shift[:2]), scale * p.headroom_m, p.inside,
                scale * p.rim_m, p.stack, p.name,
            )
            for p in places
        )  # fmt: skip
        size = tuple((scale * (high - low)).tolist())
        return Thing(label, parts, self.textures, size, places=moved_places)


def top(height: float, area: np.ndarray) -> tuple[Place, ...]:
    """Return a level top where others may stand."""
    return (Place(height, area, stack=True),)


def inside(floor: float, area: np.ndarray, rim: float) -> tuple[Place, ...]:
    """Return the inside of an open container."""
    return (Place(floor, area, inside=True, rim_m=rim, name="inside"),)
