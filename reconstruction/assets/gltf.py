"""Mesh files of a bundle: textured .glb (glTF 2.0) and convex parts as .obj, byte-identical for identical input.

Object space is +z up, glTF is +y up: `(x, y, z)_object = (x, -z, y)_gltf`. The origin of texture coordinates is at the
lower left here, at the upper left in glTF.
"""

import io
import json
import struct
from pathlib import Path

import numpy as np

from reconstruction.core.types import ConvexPart, TexturedMesh
from registry.errors import BundleError
from registry.geometry import GLTF_FROM_WORLD, WORLD_FROM_GLTF

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT, _ARRAY, _ELEMENTS = 5126, 5125, 34962, 34963
_CLAMP = 33071


def write_glb(mesh: TexturedMesh, path: Path) -> None:
    """Write a textured mesh (+z up) as a self-contained binary glTF file (+y up).

    Raises:
        BundleError: the texture cannot be encoded.
    """
    import cv2

    rotation = GLTF_FROM_WORLD[:3, :3]
    vertices = np.ascontiguousarray(mesh.vertices @ rotation.T, np.float32)
    normals = np.ascontiguousarray(vertex_normals(mesh.vertices, mesh.faces) @ rotation.T, np.float32)
    uvs = np.ascontiguousarray(mesh.uvs, np.float32).copy()
    uvs[:, 1] = 1.0 - uvs[:, 1]
    done, png = cv2.imencode(
        ".png", np.ascontiguousarray(mesh.texture[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 6]
    )
    if not done:
        raise BundleError(f"{path.name}: its texture of shape {mesh.texture.shape} cannot be encoded as PNG")
    chunks = [
        (np.ascontiguousarray(mesh.faces, np.uint32).tobytes(), _ELEMENTS),
        (vertices.tobytes(), _ARRAY),
        (normals.tobytes(), _ARRAY),
        (uvs.tobytes(), _ARRAY),
        (png.tobytes(), None),
    ]
    views, offset, binary = [], 0, io.BytesIO()
    for data, target in chunks:
        view = {"buffer": 0, "byteOffset": offset, "byteLength": len(data)}
        views.append(view if target is None else {**view, "target": target})
        binary.write(data + b"\0" * (-len(data) % 4))
        offset = binary.tell()
    document = {
        "asset": {"version": "2.0", "generator": "SimRecon"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{
            "attributes": {"POSITION": 1, "NORMAL": 2, "TEXCOORD_0": 3}, "indices": 0, "material": 0, "mode": 4,
        }]}],
        "materials": [{
            "pbrMetallicRoughness": {
                "baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 0.85,
            },
        }],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": _UINT, "count": int(mesh.faces.size), "type": "SCALAR"},
            {"bufferView": 1, "componentType": _FLOAT, "count": len(vertices), "type": "VEC3",
             "min": [float(x) for x in vertices.min(axis=0)], "max": [float(x) for x in vertices.max(axis=0)]},
            {"bufferView": 2, "componentType": _FLOAT, "count": len(vertices), "type": "VEC3"},
            {"bufferView": 3, "componentType": _FLOAT, "count": len(vertices), "type": "VEC2"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }  # fmt: skip
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body = binary.getvalue()
    with Path(path).open("wb") as file:
        file.write(struct.pack("<3I", _MAGIC, 2, 12 + 8 + len(text) + 8 + len(body)))
        file.write(struct.pack("<2I", len(text), _JSON) + text)
        file.write(struct.pack("<2I", len(body), _BIN) + body)


def read_glb(path: Path) -> TexturedMesh:
    """Read a file of `write_glb`: one primitive with one texture, +z up.

    Raises:
        BundleError: the file is no such .glb.
    """
    import cv2

    try:
        raw = Path(path).read_bytes()
        magic, version, _, length, kind = struct.unpack("<5I", raw[:20])
        if magic != _MAGIC or version != 2 or kind != _JSON:
            raise ValueError("not a binary glTF 2.0 file")
        document = json.loads(raw[20 : 20 + length])
        body = raw[28 + length :]
        primitive = document["meshes"][0]["primitives"][0]
        vertices = _accessor(document, body, primitive["attributes"]["POSITION"])
        uvs = _accessor(document, body, primitive["attributes"]["TEXCOORD_0"]).copy()
        faces = _accessor(document, body, primitive["indices"]).reshape(-1, 3)
        view = document["bufferViews"][document["images"][0]["bufferView"]]
        start = view.get("byteOffset", 0)
        image = cv2.imdecode(
            np.frombuffer(body[start : start + view["byteLength"]], np.uint8), cv2.IMREAD_COLOR
        )
        if image is None:
            raise ValueError("its texture cannot be decoded")
    except (OSError, ValueError, KeyError, IndexError, struct.error) as error:
        raise BundleError(
            f"{path}: cannot read it as a textured .glb ({error}). Write it with write_glb."
        ) from error
    uvs[:, 1] = 1.0 - uvs[:, 1]
    return TexturedMesh(
        np.ascontiguousarray(vertices @ WORLD_FROM_GLTF[:3, :3].T, np.float32),
        faces.astype(np.int32),
        uvs.astype(np.float32),
        np.ascontiguousarray(image[..., ::-1]),
    )


def _accessor(document: dict, body: bytes, number: int) -> np.ndarray:
    """Return the array (n,) or (n, width) of a glTF accessor."""
    item = document["accessors"][number]
    view = document["bufferViews"][item["bufferView"]]
    kinds = {5121: np.uint8, 5123: np.uint16, _UINT: np.uint32, _FLOAT: np.float32}
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[item["type"]]
    start = view.get("byteOffset", 0) + item.get("byteOffset", 0)
    out = np.frombuffer(body, kinds[item["componentType"]], item["count"] * width, start)
    return out if width == 1 else out.reshape(-1, width)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray, crease_deg: float = 45.0) -> np.ndarray:
    """Return a unit normal per vertex (v, 3): the area-weighted mean over the faces at its position.

    Vertices at the same position (texture seams) are smoothed together unless their normals differ by more than the
    crease angle.
    """
    p = np.asarray(vertices, np.float64)
    corner = p[faces]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    own = np.zeros_like(p)
    for k in range(3):
        np.add.at(own, faces[:, k], area)
    _, place = np.unique(np.round(p, 7), axis=0, return_inverse=True)
    place = place.ravel()
    shared = np.zeros((place.max() + 1, 3))
    np.add.at(shared, place, own)

    def unit(x: np.ndarray) -> np.ndarray:
        return x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-30)

    own_unit, shared_unit = unit(own), unit(shared[place])
    smooth = np.einsum("nk,nk->n", own_unit, shared_unit) > np.cos(np.radians(crease_deg))
    out = np.where(smooth[:, None], shared_unit, own_unit)
    bad = np.linalg.norm(out, axis=1) < 0.5
    out[bad] = [0.0, 0.0, 1.0]
    return out


def write_obj(part: ConvexPart, path: Path) -> None:
    """Write a convex part as Wavefront OBJ in its own space (+z up, metres, seven digits).

    Where rounding merges corners, the hull of the rounded corners is written, as readers that merge vertices would see
    openings.
    """
    corners, faces = _written(part)
    lines = corners + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    Path(path).write_text("\n".join(lines) + "\n")


def written_corners(part: ConvexPart) -> np.ndarray:
    """Return the corners (n, 3) that a reader of the part's file gets, to the last bit."""
    return np.array([line.split()[1:] for line in _written(part)[0]], np.float64)


def _written(part: ConvexPart) -> tuple[list[str], np.ndarray]:
    """Return the vertex lines of a part's file, and its faces (f, 3) from 0."""
    from reconstruction.assets.solid import hull_solid

    corners, faces = _corner_lines(part.vertices), np.asarray(part.faces, np.int64)
    if len(set(corners)) < len(corners):
        hull = hull_solid(np.array([line.split()[1:] for line in sorted(set(corners))], np.float64))
        corners, faces = _corner_lines(hull.vertices), hull.faces
    return corners, faces


def _corner_lines(vertices: np.ndarray) -> list[str]:
    return [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in np.asarray(vertices, np.float64)]


def read_obj(path: Path) -> ConvexPart:
    """Read a file of `write_obj`."""
    vertices, faces = [], []
    for line in Path(path).read_text().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(x) for x in words[1:4]])
        elif words[:1] == ["f"]:
            faces.append([int(x.split("/")[0]) - 1 for x in words[1:4]])
    return ConvexPart(np.array(vertices, np.float32).reshape(-1, 3), np.array(faces, np.int32).reshape(-1, 3))
