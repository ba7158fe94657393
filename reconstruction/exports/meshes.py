"""Write the OBJ files that MJCF and URDF refer to: textured visual meshes and convex hulls; +z up, metres."""

from pathlib import Path

import numpy as np

from reconstruction.assets.gltf import read_glb, vertex_normals
from reconstruction.core.types import TexturedMesh
from reconstruction.exports.scene import ExportBody, Hull
from registry.errors import SimReconError

FOLDER = "meshes"


def _stem(body: ExportBody) -> str:
    return f"{FOLDER}/{body.id:03d}_{body.name.rsplit('_', 1)[0]}"


def visual_obj(body: ExportBody) -> str:
    """Return the path of the visual mesh, relative to the export folder."""
    return f"{_stem(body)}_visual.obj"


def texture_png(body: ExportBody) -> str:
    """Return the path of the texture, relative to the export folder."""
    return f"{_stem(body)}.png"


def collision_obj(body: ExportBody, number: int) -> str:
    """Return the path of a convex part, relative to the export folder."""
    return f"{_stem(body)}_collision_{number:03d}.obj"


def hulls_of(body: ExportBody) -> list[tuple[int, Hull]]:
    """Return the indices and meshes of the parts that are not exported as primitives."""
    return [(k, part) for k, part in enumerate(body.parts) if body.primitives[k] is None]


def write_meshes(bodies: tuple[ExportBody, ...], folder: Path) -> None:
    """Write the meshes and textures of all bodies into `folder/meshes`."""
    (folder / FOLDER).mkdir(exist_ok=True)
    for body in bodies:
        mesh = read_glb(body.visual)
        write_texture(mesh, folder / texture_png(body))
        _write_textured_obj(mesh, folder / visual_obj(body), Path(texture_png(body)).name)
        for number, part in hulls_of(body):
            _write_hull(part, folder / collision_obj(body, number))


def write_texture(mesh: TexturedMesh, path: Path) -> None:
    """Write the texture of a mesh as PNG.

    Raises:
        SimReconError: OpenCV cannot encode it.
    """
    import cv2

    done, png = cv2.imencode(".png", np.ascontiguousarray(mesh.texture[..., ::-1]))
    if not done:
        raise SimReconError(f"{path}: a texture of shape {mesh.texture.shape} cannot be encoded as PNG")
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(png.tobytes())


def _write_textured_obj(mesh: TexturedMesh, path: Path, texture: str) -> None:
    material = path.with_suffix(".mtl")
    material.write_text(f"newmtl surface\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\nmap_Kd {texture}\n")
    normals = vertex_normals(mesh.vertices, mesh.faces)
    lines = [f"mtllib {material.name}", "usemtl surface"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in mesh.uvs.tolist()]
    lines += [f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in normals.tolist()]
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")


def _write_hull(part: Hull, path: Path) -> None:
    lines = [f"v {x:.12g} {y:.12g} {z:.12g}" for x, y, z in part.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (part.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")
