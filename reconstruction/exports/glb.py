"""Merge the `.glb` files of a scene into one `scene.glb`: one named node per body, its properties in `extras`."""

from pathlib import Path

from reconstruction.exports.scene import ExportBody, ExportScene
from registry.errors import BundleError
from registry.geometry import GLTF_FROM_WORLD, WORLD_FROM_GLTF, quat_from_matrix
from registry.glb import read_glb_json, write_glb_chunks

# Top-level arrays of a glTF document that are concatenated, in the order of the file.
_LISTS = ("nodes", "meshes", "materials", "textures", "images", "samplers", "accessors", "bufferViews")


def write_glb_scene(scene: ExportScene, folder: Path) -> list[str]:
    """Write `scene.glb`, +y up as glTF demands; return its path relative to the folder.

    Raises:
        BundleError: a visual mesh uses a glTF feature that cannot be merged.
    """
    document: dict = {
        "asset": {"version": "2.0", "generator": "SimRecon"},
        "scene": 0,
        "scenes": [{"name": scene.id, "nodes": []}],
        **{name: [] for name in _LISTS},
    }
    binary = bytearray()
    for body in scene.bodies:
        _append(document, binary, body)
    document["buffers"] = [{"byteLength": len(binary)}]
    document = {key: value for key, value in document.items() if value != []}
    write_glb_chunks(folder / "scene.glb", document, binary)
    return ["scene.glb"]


def _append(document: dict, binary: bytearray, body: ExportBody) -> None:
    """Append the buffers and index-shifted entries of one `.glb`, without decoding, so that nothing is lost."""
    part, data = _read(body.visual)
    first = {name: len(document[name]) for name in _LISTS}
    for view in part.get("bufferViews", []):
        document["bufferViews"].append({**view, "byteOffset": view.get("byteOffset", 0) + len(binary)})
    binary += data + b"\0" * (-len(data) % 4)
    shifts = {"bufferView": first["bufferViews"], "source": first["images"], "sampler": first["samplers"]}
    for name in ("accessors", "images", "samplers", "textures"):
        document[name] += [_shifted(item, shifts) for item in part.get(name, [])]
    document["materials"] += [
        {**_textures_shifted(item, first["textures"]), "name": body.name}
        for item in part.get("materials", [])
    ]
    for item in part["meshes"]:
        primitives = [_primitive(p, first) for p in item["primitives"]]
        document["meshes"].append({**item, "name": body.name, "primitives": primitives})
    _add_nodes(document, part, first, body)


def _add_nodes(document: dict, part: dict, first: dict, body: ExportBody) -> None:
    roots = part["scenes"][part.get("scene", 0)]["nodes"]
    nodes = part["nodes"]
    top = {"name": body.name, "extras": _facts(body), **_pose(body)}
    document["scenes"][0]["nodes"].append(first["nodes"])
    # Our own files have one node with one mesh, which becomes the named node itself.
    if len(nodes) == 1 and nodes[roots[0]].keys() <= {"mesh", "name"}:
        document["nodes"].append({**top, "mesh": nodes[0]["mesh"] + first["meshes"]})
        return
    document["nodes"].append({**top, "children": [root + first["nodes"] + 1 for root in roots]})
    for node in nodes:
        kept = {key: value for key, value in node.items() if key not in ("skin", "camera")}
        kept = _shifted(kept, {"mesh": first["meshes"]})
        if "children" in kept:
            kept["children"] = [child + first["nodes"] + 1 for child in kept["children"]]
        document["nodes"].append(kept)


def _facts(body: ExportBody) -> dict:
    kind = "object" if not body.base else "base" if body.parts else "backdrop"
    facts = {"id": body.id, "label": body.label, "kind": kind}
    if not body.base:
        facts |= {"mass_kg": body.mass_kg, "friction": body.friction, "dynamic": body.moves}
    if body.relation is not None:
        facts["relation"], facts["parent"] = body.relation
    return facts


def _pose(body: ExportBody) -> dict:
    if body.base:
        return {}
    pose = GLTF_FROM_WORLD @ body.world_from_object @ WORLD_FROM_GLTF
    w, x, y, z = quat_from_matrix(pose[:3, :3]).tolist()
    return {"translation": pose[:3, 3].tolist(), "rotation": [x, y, z, w]}


def _primitive(primitive: dict, first: dict) -> dict:
    out = _shifted(primitive, {"indices": first["accessors"], "material": first["materials"]})
    shift = first["accessors"]
    out["attributes"] = {name: number + shift for name, number in primitive["attributes"].items()}
    return out


def _shifted(item: dict, shifts: dict[str, int]) -> dict:
    """Return a copy whose index under each key of `shifts` is increased."""
    return {key: value + shifts[key] if key in shifts else value for key, value in item.items()}


def _textures_shifted(material: dict, shift: int) -> dict:
    """Return a copy of a material with the texture index of every `...Texture` entry increased."""
    out = {}
    for key, value in material.items():
        if isinstance(value, dict):
            value = _textures_shifted(value, shift)
            if key.endswith("Texture"):
                value["index"] += shift
        out[key] = value
    return out


def _read(path: Path) -> tuple[dict, bytes]:
    """Read the JSON and binary chunks of a `.glb`; reject what cannot be merged by shifting indices."""
    try:
        document, start = read_glb_json(path, str(path))
        if document.get("extensionsUsed") or any("sparse" in a for a in document.get("accessors", [])):
            raise ValueError("it uses glTF extensions or sparse accessors")
        if not document["meshes"] or not document["scenes"][document.get("scene", 0)]["nodes"]:
            raise ValueError("it has no mesh or no root node")
        size = document["buffers"][0]["byteLength"]
        data = path.read_bytes()[start : start + size]
        if len(document["buffers"]) != 1 or len(data) != size:
            raise ValueError("its buffer is external or truncated")
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise BundleError(f"{path}: cannot be merged into scene.glb ({error})") from error
    return document, data
