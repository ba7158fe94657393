# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Validate a parsed scene.json (docs/bundle_format.md, CONTRACT section 2).

Every message names the JSON place: `objects[3].mass_kg: expected a positive number, got -1`. Unknown keys are
allowed: an older reader opens files of a newer writer of the same major version.
"""

import re
from typing import Any

import numpy as np

from registry import values
from registry.errors import BundleError, UsageError
from registry.labels import STRUCTURE
from registry.primitives import SIZES
from registry.report_schema import check_report
from registry.values import JsonObject, as_object, check_relative_path

__all__ = [
    "SCHEMA",
    "JsonObject",
    "as_object",
    "check_relative_path",
    "check_scene_id",
    "is_scene_id",
    "referenced_files",
    "validate_scene",
]

SCHEMA = "simrecon.scene/1"
_SCHEMA_PATTERN = re.compile(r"simrecon\.scene/(\d+)(\.\d+)?")
_SCENE_ID = re.compile(r"[a-z0-9_]{1,64}")
_RELATIONS = ("supported_by", "attached_to")
_BASE_LABELS = ("floor", "wall", "ceiling", STRUCTURE)
MAX_OBJECTS, MAX_BASE, MAX_PARTS = 2000, 500, 1000  # MAX_PARTS: collision parts of one object
MAX_FRAMES, MAX_STEPS, MAX_VIEWS = 200_000, 20_000, 10_000
MAX_GRAPH_DEPTH = 100  # edges between an object and the base
_MAX_SIDE_PX = 32_768


def is_scene_id(value: Any) -> bool:
    """Return whether a value is a valid scene id: 1 to 64 small letters, digits and underscores."""
    return isinstance(value, str) and _SCENE_ID.fullmatch(value) is not None


def check_scene_id(scene_id: str) -> str:
    """Return a valid scene id unchanged; otherwise raise UsageError with a valid suggestion."""
    if is_scene_id(scene_id):
        return scene_id
    suggestion = re.sub(r"[^a-z0-9]+", "_", str(scene_id).lower()).strip("_")[:64] or "scene0001"
    raise UsageError(
        f"scene id {scene_id!r}: use 1 to 64 small letters, digits and underscores, such as {suggestion!r}"
    )


def validate_scene(scene: Any) -> None:
    """Check a parsed scene.json.

    Raises:
        BundleError: Names the first invalid place, the expected and the found value.
    """
    scene = values.mapping(scene, "scene.json")
    _schema_version(scene)
    if not is_scene_id(scene.get("id")):
        values.fail("id", "a scene id of small letters, digits and underscores", scene.get("id"))
    _source(values.mapping(values.get(scene, "source", ""), "source"))
    _scale(values.mapping(values.get(scene, "scale", ""), "scale"))
    _cameras(values.mapping(values.get(scene, "cameras", ""), "cameras"))
    base_ids = _base(values.sequence(values.get(scene, "base", ""), "base", MAX_BASE))
    object_ids = _objects(values.sequence(values.get(scene, "objects", ""), "objects", MAX_OBJECTS), base_ids)
    graph = values.mapping(values.get(scene, "graph", ""), "graph")
    _edges(values.sequence(values.get(graph, "edges", "graph"), "graph.edges"), base_ids, object_ids)
    if "steps" in graph:  # absent from older bundles, as the next two are
        _steps(values.sequence(graph["steps"], "graph.steps", MAX_STEPS), base_ids | object_ids)
    check_report(values.mapping(values.get(scene, "report", ""), "report"))
    if "world" in scene:
        _world(values.mapping(scene["world"], "world"))
    if "gaussians" in scene:
        values.path(values.mapping(scene["gaussians"], "gaussians"), "file", "gaussians", ".ply")
    if "backdrop" in scene:
        backdrop = values.mapping(scene["backdrop"], "backdrop")
        values.path(backdrop, "mesh", "backdrop", ".glb")
        values.number(backdrop, "observed_fraction", "backdrop", low=0, high=1)
    if "instances" in scene:
        _instance_views(values.mapping(scene["instances"], "instances"))


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
        values.fail("schema", f'"{SCHEMA}"', schema)
    if match.group(1) != "1":
        raise BundleError(
            f"schema: this bundle is {schema}, this simrecon reads {SCHEMA}; "
            "upgrade with `pip install -U simrecon`"
        )


def _source(source: JsonObject) -> None:
    values.text(source, "file", "source")
    if not isinstance(source.get("sha256"), str) or not re.fullmatch(r"[0-9a-f]{64}", source["sha256"]):
        values.fail("source.sha256", "64 hexadecimal digits", source.get("sha256"))
    for key in ("width", "height"):
        values.integer(source, key, "source", low=1, high=_MAX_SIDE_PX)
    values.integer(source, "frame_count", "source", low=1)
    for key in ("fps", "duration_s"):
        values.number(source, key, "source", low=0, high=1e9)


def _scale(scale: JsonObject) -> None:
    method = values.text(scale, "method", "scale")
    if "detail" in scale:
        values.text(scale, "detail", "scale", empty=True)
    if method == "unknown" and scale.get("uncertainty", 0) is None:
        return
    values.number(scale, "uncertainty", "scale", low=0, high=1e6)


def _world(world: JsonObject) -> None:
    for key in ("floor_observed", "yaw_snapped"):
        if key in world:
            values.boolean(world, key, "world")
    values.text(world, "gravity_method", "world")
    values.number(world, "gravity_sigma_deg", "world", low=0, high=1e6)
    values.get(world, "floor_observed", "world")


def _cameras(cameras: JsonObject) -> None:
    model = cameras.get("model")
    if model not in ("PINHOLE", "OPENCV"):
        values.fail("cameras.model", '"PINHOLE" or "OPENCV"', model)
    for key in ("width", "height"):
        values.integer(cameras, key, "cameras", low=1, high=_MAX_SIDE_PX)
    params = values.vector(cameras, "params", "cameras", 4 if model == "PINHOLE" else 8, high=1e7)
    if params[0] <= 0 or params[1] <= 0:
        values.fail("cameras.params", "positive focal lengths in the first two places", cameras["params"])
    seen: set[int] = set()
    frames = values.sequence(values.get(cameras, "frames", "cameras"), "cameras.frames", MAX_FRAMES)
    for i, frame in enumerate(frames):
        where = f"cameras.frames[{i}]"
        values.mapping(frame, where)
        values.unique(values.integer(frame, "index", where, low=0), seen, f"{where}.index")
        values.number(frame, "time_s", where, low=0, high=1e9)
    if not frames or values.are_transforms([frame.get("world_from_camera") for frame in frames]):
        return
    for i, frame in enumerate(frames):  # name the wrong one
        values.transform(frame, "world_from_camera", f"cameras.frames[{i}]")


def _instance_views(views: JsonObject) -> None:
    seen: set[int] = set()
    for i, frame in enumerate(
        values.sequence(values.get(views, "frames", "instances"), "instances.frames", MAX_VIEWS)
    ):
        where = f"instances.frames[{i}]"
        values.mapping(frame, where)
        values.unique(values.integer(frame, "index", where, low=0), seen, f"{where}.index")
        values.path(frame, "image", where, ".jpg")
        values.path(frame, "ids", where, ".png")


def _anchor(anchor: JsonObject, where: str) -> None:
    values.integer(anchor, "frame", where, low=0)
    for key in ("x", "y"):
        values.number(anchor, key, where, low=0, high=_MAX_SIDE_PX)


def _base(items: list[Any]) -> set[int]:
    seen: set[int] = set()
    for i, item in enumerate(items):
        where = f"base[{i}]"
        values.mapping(item, where)
        values.unique(values.integer(item, "id", where, low=1), seen, f"{where}.id")
        if item.get("label") not in _BASE_LABELS:
            values.fail(f"{where}.label", " or ".join(f'"{x}"' for x in _BASE_LABELS), item.get("label"))
        values.path(item, "mesh", where, ".glb")
        if item["label"] == STRUCTURE:  # it is no plane
            if not item.get("collision"):
                values.fail(f"{where}.collision", "convex parts of the structure", item.get("collision"))
        elif abs(np.linalg.norm(values.vector(item, "plane", where, 4)[:3]) - 1) > 1e-3:
            values.fail(f"{where}.plane", "a unit normal in the first three places", item["plane"])
        values.boolean(item, "observed", where)
        if "observed_fraction" in item:  # absent from older bundles
            values.number(item, "observed_fraction", where, low=0, high=1)
        if "collision" in item:
            values.paths(item, "collision", where, ".obj")
    return seen


def _objects(items: list[Any], base_ids: set[int]) -> set[int]:
    seen = set(base_ids)
    for i, item in enumerate(items):
        where = f"objects[{i}]"
        values.mapping(item, where)
        values.unique(values.integer(item, "id", where, low=1), seen, f"{where}.id")
        values.text(item, "label", where)
        if "name" in item:  # absent from older bundles
            values.text(item, "name", where)
        values.number(item, "label_confidence", where, low=0, high=1)
        values.transform(item, "world_from_object", where)
        if min(values.vector(item, "scale", where, 3, high=values.MAX_METRES)) <= 0:
            values.fail(f"{where}.scale", "three positive extents in metres", item["scale"])
        values.path(item, "visual", where, ".glb")
        dynamic = values.boolean(item, "dynamic", where)
        if not values.paths(item, "collision", where, ".obj") and dynamic:
            values.fail(f"{where}.collision", "at least one convex part, because the object is dynamic", [])
        if "collision_primitives" in item:  # absent from older bundles
            _primitives(item, where)
        _physics(item, where)
        provenance = values.mapping(values.get(item, "provenance", where), f"{where}.provenance")
        for key in ("geometry", "appearance", "physics"):
            values.text(provenance, key, f"{where}.provenance")
        values.number(provenance, "observed_fraction", f"{where}.provenance", low=0, high=1)
        _views(
            values.sequence(values.get(item, "views", where), f"{where}.views", MAX_FRAMES), f"{where}.views"
        )
        if "assembly" in item:
            values.mapping(item["assembly"], f"{where}.assembly")
        if "anchor" in item:
            _anchor(values.mapping(item["anchor"], f"{where}.anchor"), f"{where}.anchor")
    return seen - base_ids


def _views(items: list[Any], where: str) -> None:
    for k, frame in enumerate(items):
        if type(frame) is not int or not 0 <= frame < 2**31:
            values.fail(f"{where}[{k}]", "the number of a frame", frame)


def _primitives(item: JsonObject, where: str) -> None:
    where = f"{where}.collision_primitives"
    entries = values.sequence(item["collision_primitives"], where)
    if len(entries) != len(item["collision"]):
        values.fail(where, f"{len(item['collision'])} entries, one for each collision part", len(entries))
    for k, entry in enumerate(entries):
        if entry is None:
            continue
        place = f"{where}[{k}]"
        shape = values.mapping(entry, place).get("shape")
        if not isinstance(shape, str) or shape not in SIZES:
            values.fail(f"{place}.shape", " or ".join(f'"{x}"' for x in SIZES), shape)
        if min(values.vector(entry, "size", place, SIZES[shape], high=values.MAX_METRES)) <= 0:
            values.fail(f"{place}.size", "lengths above 0 in metres", entry["size"])
        values.transform(entry, "object_from_primitive", place)


def _physics(item: JsonObject, where: str) -> None:
    values.text(item, "material", where)
    for key in ("density_kg_m3", "mass_kg"):
        values.number(item, key, where, low=0, high=1e7, positive=True)
    values.vector(item, "center_of_mass", where, 3, high=values.MAX_METRES)
    values.number(item, "friction", where, low=0, high=100)
    values.number(item, "restitution", where, low=0, high=1)
    if "ranges" in item:
        _ranges(values.mapping(item["ranges"], f"{where}.ranges"), item, f"{where}.ranges")
    if "relation_fixed" in item:
        values.boolean(item, "relation_fixed", where)
    if "inertia" in item:
        inertia = values.matrix(item["inertia"], 3, f"{where}.inertia")
        symmetric = np.allclose(inertia, inertia.T, rtol=1e-6, atol=1e-12)
        if not symmetric or np.linalg.eigvalsh(inertia).min() <= 0:
            values.fail(f"{where}.inertia", "a symmetric positive definite 3x3 matrix", item["inertia"])


def _ranges(spans: JsonObject, item: JsonObject, where: str) -> None:
    for name, span in spans.items():
        if name not in ("mass_kg", "friction", "restitution"):
            values.fail(f"{where}.{name}", "one of mass_kg, friction, restitution", name)
        low, high = values.vector(spans, name, where, 2, high=1e7)
        if not 0 <= low <= item[name] <= high:
            values.fail(f"{where}.{name}", f"low and high around {name} {item[name]}", span)


def _edges(items: list[Any], base_ids: set[int], object_ids: set[int]) -> None:
    parent_of: dict[int, int] = {}
    for i, item in enumerate(items):
        where = f"graph.edges[{i}]"
        values.mapping(item, where)
        child, parent = values.integer(item, "child", where), values.integer(item, "parent", where)
        if child not in object_ids:
            values.fail(f"{where}.child", "the id of an object", child)
        if parent not in object_ids and parent not in base_ids:
            values.fail(f"{where}.parent", "the id of an object or base entity", parent)
        if child in parent_of:
            values.fail(f"{where}.child", "one parent an object", f"a second parent of {child}")
        if item.get("relation") not in _RELATIONS:
            values.fail(f"{where}.relation", " or ".join(f'"{x}"' for x in _RELATIONS), item.get("relation"))
        values.number(item, "confidence", where, low=0, high=1)
        values.get(item, "evidence", where)
        if "said_by" in item:  # absent from older bundles
            values.text(item, "said_by", where, empty=True)
        parent_of[child] = parent
    orphans = sorted(object_ids - parent_of.keys())
    if orphans:
        raise BundleError(f"graph.edges: expected one parent for every object, object {orphans[0]} has none")
    _check_forest(parent_of, base_ids)


def _check_forest(parent_of: dict[int, int], base_ids: set[int]) -> None:
    """Check that every object leads to the base in at most `MAX_GRAPH_DEPTH` edges."""
    depth = dict.fromkeys(base_ids, 0)
    for start in sorted(parent_of):
        trail: list[int] = []
        node = start
        while node not in depth and len(trail) <= MAX_GRAPH_DEPTH:
            if node in trail:
                cycle = " -> ".join(str(x) for x in [*trail[trail.index(node) :], node][:8])
                raise BundleError(
                    f"graph.edges: expected a forest rooted in the base, found the cycle {cycle}"
                )
            trail.append(node)
            node = parent_of[node]
        if depth.get(node, 0) + len(trail) > MAX_GRAPH_DEPTH:
            raise BundleError(
                f"graph.edges: object {start} is more than {MAX_GRAPH_DEPTH} edges away from the base"
            )
        for k, item in enumerate(reversed(trail), start=1):
            depth[item] = depth[node] + k


def _steps(steps: list[Any], known: set[int]) -> None:
    """Check the log of graph inference. Merged edges must have known ids; raw answers may invent ids."""
    for i, step in enumerate(steps):
        where = f"graph.steps[{i}]"
        values.text(values.mapping(step, where), "kind", where)
        for key in ("about", "visible", "said", "decisions", "merged", "notes"):
            values.sequence(values.get(step, key, where), f"{where}.{key}")
        for k, edge in enumerate(step["merged"]):
            place = f"{where}.merged[{k}]"
            for key in ("child", "parent"):
                if values.integer(values.mapping(edge, place), key, place) not in known:
                    values.fail(f"{place}.{key}", "the id of an object or base entity", edge[key])
        if "picture" in step:
            values.path(step, "picture", where, ".jpg")
