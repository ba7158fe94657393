# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Validate a parsed scene.json (docs/bundle_format.md, CONTRACT section 2).

Every message names the JSON place: `objects[3].mass_kg: expected a positive number, got -1`. Unknown keys are
allowed: an older reader opens files of a newer writer of the same major version.
"""

import math
import re
from typing import Any, NoReturn, TypeAlias, cast

import numpy as np

from registry.errors import BundleError, UsageError
from registry.primitives import SIZES

JsonObject: TypeAlias = dict[str, Any]

SCHEMA = "simrecon.scene/1"
_SCHEMA_PATTERN = re.compile(r"simrecon\.scene/(\d+)(\.\d+)?")
_SCENE_ID = re.compile(r"[a-z0-9_]{1,64}")
_RELATIONS = ("supported_by", "attached_to")
_BASE_LABELS = ("floor", "wall", "ceiling")
_RIGID_TOLERANCE = 1e-4  # of an entry of R R^T - I
_MAX_METRES = 1e4  # bounds coordinates and extents
_MAX_PATH_CHARACTERS = 240


def check_scene_id(scene_id: str) -> str:
    """Return a valid scene id unchanged; otherwise raise UsageError with a valid suggestion."""
    if isinstance(scene_id, str) and _SCENE_ID.fullmatch(scene_id):  # pyright: ignore[reportUnnecessaryIsInstance]
        return scene_id
    suggestion = re.sub(r"[^a-z0-9]+", "_", str(scene_id).lower()).strip("_")[:64] or "scene0001"
    raise UsageError(
        f"scene id {scene_id!r}: use 1 to 64 small letters, digits and underscores, such as {suggestion!r}"
    )


def check_relative_path(path: Any, where: str) -> str:
    """Return a safe path inside the bundle unchanged; raise BundleError if it could leave the folder on any system."""
    if not isinstance(path, str) or not path or len(path) > _MAX_PATH_CHARACTERS:
        _fail(where, f"a relative path of 1 to {_MAX_PATH_CHARACTERS} characters", path)
    unsafe = "\\" in path or ":" in path or any(ord(c) < 32 or ord(c) == 127 for c in path)
    if unsafe or path.startswith(("/", "~")) or any(part in ("", ".", "..") for part in path.split("/")):
        raise BundleError(f"{where}: {_show(path)} is not a plain relative path inside the bundle")
    return path


def validate_scene(scene: Any) -> None:
    """Check a parsed scene.json.

    Raises:
        BundleError: Names the first invalid place, the expected and the found value.
    """
    scene = _mapping(scene, "scene.json")
    _schema_version(scene)
    if not isinstance(scene.get("id"), str) or not _SCENE_ID.fullmatch(scene["id"]):
        _fail("id", "a scene id of small letters, digits and underscores", scene.get("id"))
    _source(_mapping(_get(scene, "source", ""), "source"))
    _scale(_mapping(_get(scene, "scale", ""), "scale"))
    _cameras(_mapping(_get(scene, "cameras", ""), "cameras"))
    base_ids = _base(_sequence(_get(scene, "base", ""), "base"))
    object_ids = _objects(_sequence(_get(scene, "objects", ""), "objects"), base_ids)
    graph = _mapping(_get(scene, "graph", ""), "graph")
    _edges(_sequence(_get(graph, "edges", "graph"), "graph.edges"), base_ids, object_ids)
    if "steps" in graph:  # absent from older bundles, as the next two are
        _steps(_sequence(graph["steps"], "graph.steps"), base_ids | object_ids)
    _report(_mapping(_get(scene, "report", ""), "report"))
    if "gaussians" in scene:
        _path(_mapping(scene["gaussians"], "gaussians"), "file", "gaussians", ".ply")
    if "backdrop" in scene:
        backdrop = _mapping(scene["backdrop"], "backdrop")
        _path(backdrop, "mesh", "backdrop", ".glb")
        _number(backdrop, "observed_fraction", "backdrop", low=0, high=1)
    if "instances" in scene:
        _instance_views(_mapping(scene["instances"], "instances"))


def referenced_files(scene: JsonObject) -> dict[str, str]:
    """Return {path: JSON place} of every file named in a valid scene."""
    found: dict[str, str] = {}
    for i, item in enumerate(scene["base"]):
        found[item["mesh"]] = f"base[{i}].mesh"
        found.update({path: f"base[{i}].collision[{k}]" for k, path in enumerate(item.get("collision", []))})
    for i, item in enumerate(scene["objects"]):
        found[item["visual"]] = f"objects[{i}].visual"
        found.update({path: f"objects[{i}].collision[{k}]" for k, path in enumerate(item["collision"])})
    if "gaussians" in scene:
        found[scene["gaussians"]["file"]] = "gaussians.file"
    if "backdrop" in scene:
        found[scene["backdrop"]["mesh"]] = "backdrop.mesh"
    for i, step in enumerate(scene["graph"].get("steps", [])):
        if "picture" in step:
            found[step["picture"]] = f"graph.steps[{i}].picture"
    for i, frame in enumerate(scene.get("instances", {"frames": []})["frames"]):
        found.update({frame[key]: f"instances.frames[{i}].{key}" for key in ("image", "ids")})
    return found


def _schema_version(scene: JsonObject) -> None:
    schema = scene.get("schema")
    match = _SCHEMA_PATTERN.fullmatch(schema) if isinstance(schema, str) else None
    if match is None:
        _fail("schema", f'"{SCHEMA}"', schema)
    if match.group(1) != "1":
        raise BundleError(
            f"schema: this bundle is {schema}, this simrecon reads {SCHEMA}; "
            "upgrade with `pip install -U simrecon`"
        )


def _source(source: JsonObject) -> None:
    _text(source, "file", "source")
    if not isinstance(source.get("sha256"), str) or not re.fullmatch(r"[0-9a-f]{64}", source["sha256"]):
        _fail("source.sha256", "64 hexadecimal digits", source.get("sha256"))
    for key in ("width", "height", "frame_count"):
        _integer(source, key, "source", low=1)
    for key in ("fps", "duration_s"):
        _number(source, key, "source", low=0)


def _scale(scale: JsonObject) -> None:
    method = _text(scale, "method", "scale")
    if method == "unknown" and scale.get("uncertainty", 0) is None:
        return
    _number(scale, "uncertainty", "scale", low=0)


def _cameras(cameras: JsonObject) -> None:
    model = cameras.get("model")
    if model not in ("PINHOLE", "OPENCV"):
        _fail("cameras.model", '"PINHOLE" or "OPENCV"', model)
    for key in ("width", "height"):
        _integer(cameras, key, "cameras", low=1)
    params = _vector(cameras, "params", "cameras", 4 if model == "PINHOLE" else 8)
    if params[0] <= 0 or params[1] <= 0:
        _fail("cameras.params", "positive focal lengths in the first two places", cameras["params"])
    seen: set[int] = set()
    for i, frame in enumerate(_sequence(_get(cameras, "frames", "cameras"), "cameras.frames")):
        where = f"cameras.frames[{i}]"
        _mapping(frame, where)
        _unique(_integer(frame, "index", where, low=0), seen, f"{where}.index")
        _number(frame, "time_s", where, low=0)
        _transform(frame, "world_from_camera", where)


def _instance_views(views: JsonObject) -> None:
    seen: set[int] = set()
    for i, frame in enumerate(_sequence(_get(views, "frames", "instances"), "instances.frames")):
        where = f"instances.frames[{i}]"
        _mapping(frame, where)
        _unique(_integer(frame, "index", where, low=0), seen, f"{where}.index")
        _path(frame, "image", where, ".jpg")
        _path(frame, "ids", where, ".png")


def _anchor(anchor: JsonObject, where: str) -> None:
    _integer(anchor, "frame", where, low=0)
    for key in ("x", "y"):
        _number(anchor, key, where, low=0)


def _base(items: list[Any]) -> set[int]:
    seen: set[int] = set()
    for i, item in enumerate(items):
        where = f"base[{i}]"
        _mapping(item, where)
        _unique(_integer(item, "id", where, low=1), seen, f"{where}.id")
        if item.get("label") not in _BASE_LABELS:
            _fail(f"{where}.label", " or ".join(f'"{x}"' for x in _BASE_LABELS), item.get("label"))
        _path(item, "mesh", where, ".glb")
        plane = _vector(item, "plane", where, 4)
        if abs(np.linalg.norm(plane[:3]) - 1) > 1e-3:
            _fail(f"{where}.plane", "a unit normal in the first three places", item["plane"])
        _boolean(item, "observed", where)
        if "observed_fraction" in item:  # absent from older bundles
            _number(item, "observed_fraction", where, low=0, high=1)
        if "collision" in item:
            _paths(item, "collision", where, ".obj")
    return seen


def _objects(items: list[Any], base_ids: set[int]) -> set[int]:
    seen = set(base_ids)
    for i, item in enumerate(items):
        where = f"objects[{i}]"
        _mapping(item, where)
        _unique(_integer(item, "id", where, low=1), seen, f"{where}.id")
        _text(item, "label", where)
        if "name" in item:  # absent from older bundles
            _text(item, "name", where)
        _number(item, "label_confidence", where, low=0, high=1)
        _transform(item, "world_from_object", where)
        if min(_vector(item, "scale", where, 3, high=_MAX_METRES)) <= 0:
            _fail(f"{where}.scale", "three positive extents in metres", item["scale"])
        _path(item, "visual", where, ".glb")
        dynamic = _boolean(item, "dynamic", where)
        if not _paths(item, "collision", where, ".obj") and dynamic:
            _fail(f"{where}.collision", "at least one convex part, because the object is dynamic", [])
        if "collision_primitives" in item:  # absent from older bundles
            _primitives(item, where)
        _physics(item, where)
        provenance = _mapping(_get(item, "provenance", where), f"{where}.provenance")
        for key in ("geometry", "appearance", "physics"):
            _text(provenance, key, f"{where}.provenance")
        _number(provenance, "observed_fraction", f"{where}.provenance", low=0, high=1)
        _sequence(_get(item, "views", where), f"{where}.views")
        if "anchor" in item:
            _anchor(_mapping(item["anchor"], f"{where}.anchor"), f"{where}.anchor")
    return seen - base_ids


def _primitives(item: JsonObject, where: str) -> None:
    where = f"{where}.collision_primitives"
    entries = _sequence(item["collision_primitives"], where)
    if len(entries) != len(item["collision"]):
        _fail(where, f"{len(item['collision'])} entries, one for each collision part", len(entries))
    for k, entry in enumerate(entries):
        if entry is None:
            continue
        place = f"{where}[{k}]"
        shape = _mapping(entry, place).get("shape")
        if not isinstance(shape, str) or shape not in SIZES:
            _fail(f"{place}.shape", " or ".join(f'"{x}"' for x in SIZES), shape)
        if min(_vector(entry, "size", place, SIZES[shape], high=_MAX_METRES)) <= 0:
            _fail(f"{place}.size", "lengths above 0 in metres", entry["size"])
        _transform(entry, "object_from_primitive", place)


def _physics(item: JsonObject, where: str) -> None:
    _text(item, "material", where)
    for key in ("density_kg_m3", "mass_kg"):
        _number(item, key, where, low=0, high=1e7, positive=True)
    _vector(item, "center_of_mass", where, 3, high=_MAX_METRES)
    _number(item, "friction", where, low=0, high=100)
    _number(item, "restitution", where, low=0, high=1)
    if "ranges" in item:
        _ranges(_mapping(item["ranges"], f"{where}.ranges"), item, f"{where}.ranges")
    if "relation_fixed" in item:
        _boolean(item, "relation_fixed", where)
    if "inertia" in item:
        inertia = _matrix(item["inertia"], 3, f"{where}.inertia")
        symmetric = np.allclose(inertia, inertia.T, rtol=1e-6, atol=1e-12)
        if not symmetric or np.linalg.eigvalsh(inertia).min() <= 0:
            _fail(f"{where}.inertia", "a symmetric positive definite 3x3 matrix", item["inertia"])


def _ranges(spans: JsonObject, item: JsonObject, where: str) -> None:
    for name, span in spans.items():
        if name not in ("mass_kg", "friction", "restitution"):
            _fail(f"{where}.{name}", "one of mass_kg, friction, restitution", name)
        low, high = _vector(spans, name, where, 2, high=1e7)
        if not 0 <= low <= item[name] <= high:
            _fail(f"{where}.{name}", f"low and high around {name} {item[name]}", span)


def _edges(items: list[Any], base_ids: set[int], object_ids: set[int]) -> None:
    parent_of: dict[int, int] = {}
    for i, item in enumerate(items):
        where = f"graph.edges[{i}]"
        _mapping(item, where)
        child, parent = _integer(item, "child", where), _integer(item, "parent", where)
        if child not in object_ids:
            _fail(f"{where}.child", "the id of an object", child)
        if parent not in object_ids and parent not in base_ids:
            _fail(f"{where}.parent", "the id of an object or base entity", parent)
        if child in parent_of:
            _fail(f"{where}.child", "one parent an object", f"a second parent of {child}")
        if item.get("relation") not in _RELATIONS:
            _fail(f"{where}.relation", " or ".join(f'"{x}"' for x in _RELATIONS), item.get("relation"))
        _number(item, "confidence", where, low=0, high=1)
        _get(item, "evidence", where)
        parent_of[child] = parent
    orphans = sorted(object_ids - parent_of.keys())
    if orphans:
        raise BundleError(f"graph.edges: expected one parent for every object, object {orphans[0]} has none")
    rooted = set(base_ids)
    for start in sorted(object_ids):
        trail: list[int] = []
        node = start
        while node not in rooted:
            if node in trail:
                cycle = " -> ".join(str(x) for x in [*trail[trail.index(node) :], node][:8])
                raise BundleError(
                    f"graph.edges: expected a forest rooted in the base, found the cycle {cycle}"
                )
            trail.append(node)
            node = parent_of[node]
        rooted.update(trail)


def _steps(steps: list[Any], known: set[int]) -> None:
    """Check the log of graph inference. Merged edges must have known ids; raw answers may invent ids."""
    for i, step in enumerate(steps):
        where = f"graph.steps[{i}]"
        _text(_mapping(step, where), "kind", where)
        for key in ("about", "visible", "said", "decisions", "merged", "notes"):
            _sequence(_get(step, key, where), f"{where}.{key}")
        for k, edge in enumerate(step["merged"]):
            place = f"{where}.merged[{k}]"
            for key in ("child", "parent"):
                if _integer(_mapping(edge, place), key, place) not in known:
                    _fail(f"{place}.{key}", "the id of an object or base entity", edge[key])
        if "picture" in step:
            _path(step, "picture", where, ".jpg")


def _report(report: JsonObject) -> None:
    for key in ("physics", "timings_s", "backends", "config"):
        if key in report:
            _mapping(report[key], f"report.{key}")
    if report.get("peak_memory_mb") is not None:
        _number(report, "peak_memory_mb", "report", low=0)


# ---- Checks of one value. `where` is the JSON place of the object that contains it.


def _fail(place: str, expected: str, got: Any) -> NoReturn:
    raise BundleError(f"{place}: expected {expected}, got {_show(got)}")


def _show(value: Any) -> str:
    text = value if isinstance(value, str) and value.startswith("a ") else repr(value)
    return "nothing" if value is None else text if len(text) <= 80 else text[:77] + "..."


def _get(mapping: JsonObject, key: str, where: str) -> Any:
    if key not in mapping:
        raise BundleError(f"{_place(where, key)}: missing")
    return mapping[key]


def _place(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


def as_object(value: Any) -> JsonObject:
    """Return a parsed JSON value as an object; an empty one if it is of another type."""
    return cast(JsonObject, value) if isinstance(value, dict) else {}


def _mapping(value: Any, place: str) -> JsonObject:
    if not isinstance(value, dict):
        _fail(place, "an object {...}", value)
    return cast(JsonObject, value)


def _sequence(value: Any, place: str) -> list[Any]:
    if not isinstance(value, list):
        _fail(place, "a list [...]", value)
    return cast("list[Any]", value)


def _text(mapping: JsonObject, key: str, where: str) -> str:
    value = _get(mapping, key, where)
    if not isinstance(value, str) or not value or len(value) > 4096:
        _fail(_place(where, key), "a text that is not empty", value)
    return value


def _boolean(mapping: JsonObject, key: str, where: str) -> bool:
    value = _get(mapping, key, where)
    if not isinstance(value, bool):
        _fail(_place(where, key), "true or false", value)
    return value


def _integer(mapping: JsonObject, key: str, where: str, low: int = -(2**31)) -> int:
    value = _get(mapping, key, where)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value < 2**31:
        _fail(_place(where, key), "a whole number" + (f" of at least {low}" if low >= 0 else ""), value)
    return value


def _finite(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= 1e300 and math.isfinite(value)


def _number(
    mapping: JsonObject,
    key: str,
    where: str,
    low: float = -1e300,
    high: float = 1e300,
    positive: bool = False,
) -> float:
    value = _get(mapping, key, where)
    if not _finite(value) or not low <= value <= high or (positive and value <= 0):
        kind = "a positive number" if positive else "a number"
        if high < 1e300:
            kind += f" of at most {high:g}" if positive else f" between {low:g} and {high:g}"
        elif low > -1e300 and not positive:
            kind += f" of at least {low:g}"
        _fail(_place(where, key), kind, value)
    return value


def _numbers(value: Any, count: int, high: float = 1e300) -> bool:
    numbers = cast("list[Any]", value) if isinstance(value, list) else []
    return len(numbers) == count and all(_finite(x) and abs(x) <= high for x in numbers)


def _vector(mapping: JsonObject, key: str, where: str, count: int, high: float = 1e300) -> list[float]:
    value = _get(mapping, key, where)
    if not _numbers(value, count, high):
        _fail(_place(where, key), f"{count} finite numbers", value)
    return value


def _matrix(value: Any, size: int, place: str) -> np.ndarray:
    rows = cast("list[Any]", value) if isinstance(value, list) else []
    if len(rows) != size or not all(_numbers(row, size) for row in rows):
        _fail(place, f"{size} rows of {size} finite numbers", value)
    return np.array(value, dtype=np.float64)


def _transform(mapping: JsonObject, key: str, where: str) -> None:
    place = _place(where, key)
    matrix = _matrix(_get(mapping, key, where), 4, place)
    rotation = matrix[:3, :3]
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        _fail(place, "the last row [0, 0, 0, 1]", mapping[key][3])
    if np.abs(rotation).max() > 2 or np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID_TOLERANCE:
        _fail(place, "a rigid transform (an orthonormal rotation, no scale)", mapping[key])
    if np.linalg.det(rotation) < 0:
        _fail(place, "a rotation, not a reflection", mapping[key])
    if np.abs(matrix[:3, 3]).max() > _MAX_METRES:
        _fail(place, f"a translation within {_MAX_METRES:g} m", matrix[:3, 3].tolist())


def _unique(value: int, seen: set[int], place: str) -> None:
    if value in seen:
        raise BundleError(f"{place}: {value} is used twice")
    seen.add(value)


def _path(mapping: JsonObject, key: str, where: str, suffix: str) -> str:
    path = check_relative_path(_get(mapping, key, where), _place(where, key))
    if not path.endswith(suffix):
        _fail(_place(where, key), f"a {suffix} file", path)
    return path


def _paths(mapping: JsonObject, key: str, where: str, suffix: str) -> list[str]:
    values = _sequence(_get(mapping, key, where), _place(where, key))
    for k, path in enumerate(values):
        place = f"{_place(where, key)}[{k}]"
        if not check_relative_path(path, place).endswith(suffix):
            _fail(place, f"a {suffix} file", path)
    return values
