"""Mesh files of a bundle: textured .glb (glTF 2.0) and convex parts as .obj, byte-identical for identical input.

Object space is +z up, glTF is +y up: `(x, y, z)_object = (x, -z, y)_gltf`. The origin of texture coordinates is at the
lower left here, at the upper left in glTF.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.core.types import ConvexPart, TexturedMesh
from registry.errors import BundleError
from registry.geometry import GLTF_FROM_WORLD, WORLD_FROM_GLTF
from registry.glb import write_glb_chunks

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
    write_glb_chunks(path, document, binary.getvalue())


def read_glb(path: Path) -> TexturedMesh:
    """Read a file of `write_glb`: one primitive with one texture, +z up.

    Raises:
        BundleError: the file is no such .glb.
    """
    import trimesh

    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
        uvs, texture = loaded.visual.uv, loaded.visual.material.baseColorTexture.convert("RGB")
    except Exception as error:  # trimesh raises whatever its readers raise
        raise BundleError(
            f"{path}: cannot read it as a textured .glb ({error}). Write it with write_glb."
        ) from error
    return TexturedMesh(
        np.ascontiguousarray(loaded.vertices @ WORLD_FROM_GLTF[:3, :3].T, np.float32),
        np.asarray(loaded.faces, np.int32),
        np.asarray(uvs, np.float32),
        np.asarray(texture),
    )


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
