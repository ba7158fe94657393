"""Textured meshes from a folder on this machine in, kinds of things and furniture for generated rooms out.

The meshes are models that others made and published under free licences; none is part of the repository. A table
(`priors/models.yaml`) says which file is what: its use, its scale, its turn. `use_models` adds the kinds to
`kind_named` under names that begin with "models_".
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from registry.errors import InputError
from synthetic import footprints as plane
from synthetic import textures
from synthetic.furniture import Workshop
from synthetic.shapes import Patch
from synthetic.shapes_kit import divided, turn
from synthetic.textures import Texture
from synthetic.things import Kind, Place, Thing

PREFIX = "models"
USES = ("thing", "table", "low_table", "seat", "couch", "side", "wall")
"""Uses of a model in a room: a `thing` stands on furniture, `wall` hangs, the others stand on the floor."""
_LARGEST_PX = 1024
_MOST_FACES = 25_000
_PICTURES = (".jpg", ".jpeg", ".png")
_STEPS = 4.0  # a model has detail of its own: large triangles are divided less finely than the makers divide theirs
_SHEET_M = 0.001  # between the two sides of a surface that is not closed
_SIZES = (0.85, 1.15)  # factor on the size, drawn per thing
_LEVEL = 0.98  # least z of the normal of a face that others may stand on
_FLAT_M = 0.004  # faces of one level differ by less
_FULL = 0.8  # least share of its convex hull that a level covers
_THING_M2, _FURNITURE_M2, _HEADROOM_M = 0.002, 0.03, 0.1
_THING_SHARE = 0.5  # least share of a thing's footprint that a level covers
_MOST_PLACES = 4


@dataclass(frozen=True)
class Record:
    """A model's line in the table."""

    name: str
    file: str
    use: str
    label: str
    scale: float = 1.0
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hangs_m: tuple[float, float] = (0.9, 1.4)


@dataclass(frozen=True)
class _Mesh:
    """Triangles of one material, metres, on z = 0, centred."""

    vertices: np.ndarray  # float64 (v, 3)
    normals: np.ndarray  # float64 (v, 3)
    uvs_m: np.ndarray  # float64 (v, 2)
    faces: np.ndarray  # int32 (f, 3)
    look: Texture | None  # None: nothing is known of its color


def read_records(table: Path, folder: Path) -> list[Record]:
    """Read the table; keep the models whose files are below `folder`.

    Raises:
        InputError: The table cannot be read, names an unknown use, or no file is there.
    """
    import yaml

    try:
        lines = yaml.safe_load(Path(table).read_text())["models"]
        records = [
            Record(name, **{k: tuple(v) if isinstance(v, list) else v for k, v in line.items()})
            for name, line in lines.items()
        ]
    except (OSError, KeyError, TypeError, AttributeError, yaml.YAMLError) as broken:
        raise InputError(f"{table}: not a table of models ({broken})") from broken
    wrong = sorted({r.use for r in records} - set(USES))
    if wrong:
        raise InputError(f"{table}: use {', '.join(wrong)}, there are {', '.join(USES)}")
    present = [r for r in records if (Path(folder) / r.file).is_file()]
    if not present:
        raise InputError(
            f"{folder}: none of the {len(records)} files of {table} is there; see docs/priors.md"
        )
    return present


@dataclass(frozen=True)
class Library:
    """Models by name."""

    folder: Path
    records: dict[str, Record]

    def keys(self, *uses: str) -> list[str]:
        """Return the room names of the models of some uses."""
        return [f"{PREFIX}_{name}" for name, r in self.records.items() if r.use in uses]

    def record(self, key: str) -> Record | None:
        """Return the record of a room name, None for names of others."""
        return self.records.get(key.removeprefix(f"{PREFIX}_")) if key.startswith(f"{PREFIX}_") else None

    def kind(self, key: str) -> Kind | None:
        """Return the kind of a room name, None for names of others."""
        record = self.record(key)
        if record is None:
            return None

        def make(shop: Workshop, name: str) -> Thing:
            return _made(self.folder, record, shop, name)

        return Kind(record.label, make, fixed=record.use not in ("thing", "seat"))


_in_use = Library(Path(), {})


def library() -> Library:
    """Return the models in use; an empty library before `use_models`."""
    return _in_use


def use_models(table: Path | None, folder: Path | None) -> Library:
    """Let rooms be furnished with the models of a table; None: with none."""
    global _in_use
    if table is None or folder is None:
        _in_use = Library(Path(), {})
    else:
        _in_use = Library(Path(folder), {r.name: r for r in read_records(table, folder)})
    return _in_use


# One model


def _made(folder: Path, record: Record, shop: Workshop, name: str) -> Thing:
    """Make a thing of a record, its size and tint drawn."""
    factor = float(shop.rng.uniform(*_SIZES)) if record.use in ("thing", "wall") else 1.0
    tint, gain = shop.rng.uniform(-0.12, 0.12, 3), float(shop.rng.uniform(0.75, 1.2))
    meshes = _read_model(str(folder), record)
    looks, parts = {}, []
    for number, mesh in enumerate(meshes):
        look = f"{name}look{number}"
        texture = mesh.look or textures.plain(tuple(shop.rng.uniform(30, 225, 3).tolist()))
        pixels = np.clip(texture.pixels * (gain * (1 + tint)), 0, 255).astype(np.uint8)
        looks[look] = Texture(pixels, factor * texture.width_m, factor * texture.height_m)
        rows = np.concatenate(
            [factor * mesh.vertices, 1e-6 * mesh.normals, 1e-6 * factor * mesh.uvs_m], axis=1
        )
        rows, faces, _ = divided(rows, mesh.faces, np.zeros(len(rows), np.int64), _STEPS * shop.step_m)
        length = np.maximum(np.linalg.norm(rows[:, 3:6], axis=1, keepdims=True), 1e-30)
        parts.append(
            (
                Patch(
                    np.ascontiguousarray(rows[:, :3]), rows[:, 3:6] / length, 1e6 * rows[:, 6:],
                    faces.astype(np.int32), look,
                ),
            )
        )  # fmt: skip
    points = np.concatenate([m.vertices for m in meshes]) * factor
    places = _places(str(folder), record)
    return Thing(
        record.label, parts, looks, tuple(np.ptp(points, axis=0).tolist()),
        places=tuple(
            Place(factor * p.height_m, factor * p.area, factor * p.headroom_m, stack=p.stack, name=p.name)
            for p in places
        ),
    )  # fmt: skip


@lru_cache(maxsize=256)
def _places(folder: str, record: Record) -> tuple[Place, ...]:
    """Return the level areas of a model where others may stand, the largest first."""
    if record.use == "wall":
        return ()
    meshes = _read_model(folder, record)
    corners = np.concatenate([m.vertices[m.faces] for m in meshes])
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(cross, axis=1)
    left = cross[:, 2] > _LEVEL * 2 * np.maximum(areas, 1e-12)
    heights = corners[:, :, 2].mean(1)
    footprint = plane.area(plane.convex_hull(corners[..., :2].reshape(-1, 2)))
    thing = record.use == "thing"
    least = max(_THING_M2, _THING_SHARE * footprint) if thing else _FURNITURE_M2
    out: list[tuple[float, Place]] = []
    while left.any():
        order = np.flatnonzero(left)
        at = float(heights[order[np.argmax(areas[order])]])
        member = left & (np.abs(heights - at) < _FLAT_M)
        left &= ~member
        size = float(areas[member].sum())
        if size < least:
            continue
        hull = plane.convex_hull(corners[member][..., :2].reshape(-1, 2))
        if size < _FULL * plane.area(hull):
            continue
        above = corners[heights > at + 0.01]
        over = above[_inside(above.mean(1)[:, :2], hull)]
        headroom = float(over[..., 2].min() - at) if len(over) else np.inf
        if headroom > _HEADROOM_M:
            out.append((size, Place(at, hull, headroom, stack=thing, name=f"level_{len(out)}")))
    return tuple(place for _, place in sorted(out, key=lambda pair: -pair[0])[:_MOST_PLACES])


def _inside(points: np.ndarray, hull: np.ndarray) -> np.ndarray:
    steps = np.roll(hull, -1, axis=0) - hull
    away = points[:, None] - hull
    return (steps[:, 0] * away[..., 1] - steps[:, 1] * away[..., 0] > 0).all(1)


@lru_cache(maxsize=256)
def _read_model(folder: str, record: Record) -> tuple[_Mesh, ...]:
    """Read a model: scaled, turned, centred, on the floor; what hangs has its back at y = 0.

    Raises:
        InputError: The file holds no triangles, or too many.
    """
    path = Path(folder) / record.file
    rotation = turn(*record.turn_deg) * record.scale
    geometries = [part for part in _geometries(path) if len(part.faces)]
    count = sum(len(part.faces) for part in geometries)
    if not 0 < count <= _MOST_FACES:
        raise InputError(f"{path}: {count} triangles, expected 1 to {_MOST_FACES}")
    meshes = [_mesh(part.vertices @ rotation.T, part, path) for part in geometries]
    points = np.concatenate([m.vertices for m in meshes])
    low, high = points.min(0), points.max(0)
    back = high[1] if record.use == "wall" else (low[1] + high[1]) / 2
    shift = np.array([(low[0] + high[0]) / 2, back, low[2]])
    return tuple(_Mesh(m.vertices - shift, m.normals, m.uvs_m, m.faces, m.look) for m in meshes)


def _geometries(path: Path) -> list:
    """Read the triangles of a file, with pictures found by their names alone wherever they lie below its folder."""
    import trimesh
    from trimesh.resolvers import Resolver

    folder = path.parent.parent if path.parent.name == "meshes" else path.parent
    files = {p.name.lower(): p for p in sorted(folder.rglob("*")) if p.is_file()}

    class ByName(Resolver):
        def __init__(self) -> None: ...

        def get(self, key: str) -> bytes:
            name = Path(str(key).replace("\\", "/")).name.lower()
            if name not in files:
                raise FileNotFoundError(key)
            return files[name].read_bytes()

        def write(self, name: str, data) -> None:
            raise NotImplementedError("models are only read")

        def namespaced(self, namespace: str) -> "ByName":
            return self

        def keys(self):
            return files.keys()

    try:
        scene = trimesh.load_scene(path, process=False, resolver=ByName())
    except (ValueError, OSError, KeyError, AttributeError, ImportError) as broken:
        raise InputError(f"{path}: cannot be read as a mesh ({broken})") from broken
    return [g for g in scene.dump() if isinstance(g, trimesh.Trimesh)]


def _mesh(vertices: np.ndarray, part, path: Path) -> _Mesh:
    import trimesh

    whole = trimesh.Trimesh(vertices, part.faces, process=False)
    closed = whole.copy()
    closed.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=5)
    faces = np.asarray(part.faces, np.int32)
    normals = np.asarray(whole.vertex_normals, float)
    uvs = getattr(part.visual, "uv", None)
    uvs = np.asarray(uvs, float) if uvs is not None and len(uvs) == len(vertices) else vertices[:, [0, 2]]
    if closed.is_watertight:
        if closed.volume < 0:
            faces, normals = faces[:, ::-1], -normals
    else:  # a sheet: its back lies a little behind it
        faces = np.concatenate([faces, faces[:, ::-1] + len(vertices)]).astype(np.int32)
        vertices = np.concatenate([vertices, vertices - _SHEET_M * normals])
        normals = np.concatenate([normals, -normals])
        uvs = np.concatenate([uvs, uvs])
    image = _image(part.visual, path)
    if image is None:
        return _Mesh(vertices, normals, uvs, faces, _color(part.visual))
    # One texture coordinate is this many metres, on average over the surface.
    corner, flat = vertices[faces], uvs[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    size = float(np.sqrt(area / max(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), 1e-9)))
    return _Mesh(vertices, normals, uvs * size, faces, Texture(image, size, size))


def _image(visual, path: Path) -> np.ndarray | None:
    """Return a part's picture; where the file names none, the only picture that lies beside it."""
    material = getattr(visual, "material", None)
    picture = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if picture is not None:
        image = np.asarray(picture.convert("RGB"))
    else:
        beside = [p for p in sorted(path.parent.iterdir()) if p.suffix.lower() in _PICTURES]
        read = cv2.imread(str(beside[0]), cv2.IMREAD_COLOR) if len(beside) == 1 else None
        if read is None:
            return None
        image = read[..., ::-1]
    scale = _LARGEST_PX / max(image.shape[:2])
    if scale < 1:
        size = (max(round(image.shape[1] * scale), 1), max(round(image.shape[0] * scale), 1))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image)


def _color(visual) -> Texture | None:
    material = getattr(visual, "material", None)
    color = getattr(material, "main_color", None)
    if color is None:
        return None
    rgb = tuple(float(c) for c in np.asarray(color, float)[:3])
    return None if rgb in ((102.0, 102.0, 102.0), (255.0, 255.0, 255.0)) else textures.plain(rgb)
