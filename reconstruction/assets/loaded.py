"""Mesh files of other programs, read by trimesh, with their textures or vertex colors."""

from typing import Any, BinaryIO

import numpy as np

from registry.geometry import WORLD_FROM_GLTF


def load_mesh(source: "str | BinaryIO", file_type: str | None = None) -> Any:
    """Read all meshes of a file as one `trimesh.Trimesh`, in the file's own axes.

    Raises:
        ValueError: the file holds no readable mesh, with the reason.
    """
    import trimesh

    try:
        loaded: Any = trimesh.load(source, file_type=file_type, force="mesh", process=False)
    except Exception as error:  # trimesh raises whatever its many readers raise
        raise ValueError(f"it cannot be read ({type(error).__name__}: {error})") from error
    if len(getattr(loaded, "faces", ())) < 4:
        raise ValueError("it holds no mesh of at least 4 triangles")
    if not np.isfinite(np.asarray(loaded.vertices)).all():
        raise ValueError("it has vertices that are not finite")
    if int(np.max(loaded.faces)) >= len(loaded.vertices) or int(np.min(loaded.faces)) < 0:
        raise ValueError("its triangles refer to vertices that do not exist")
    return loaded


def upright(vertices: np.ndarray, *, gltf: bool) -> np.ndarray:
    """Return vertices (v, 3) with +z up; glTF files are +y up."""
    vertices = np.asarray(vertices, np.float64)
    return vertices @ WORLD_FROM_GLTF[:3, :3].T if gltf else vertices


def picture_of(loaded: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Return uvs (v, 2) and the texture uint8 (h, w, 3) RGB of a mesh; None where it has none."""
    visual = loaded.visual
    uv = getattr(visual, "uv", None)
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if uv is None or len(uv) != len(loaded.vertices) or image is None:
        return None
    return np.asarray(uv, np.float64), np.asarray(image.convert("RGB"))


def colors_of(loaded: Any) -> np.ndarray | None:
    """Return RGB colors uint8 (v, 3) of the vertices; None where a mesh has none."""
    try:
        visual = loaded.visual if loaded.visual.kind in ("vertex", "face") else loaded.visual.to_color()
        colors = np.asarray(visual.vertex_colors)[:, :3]
    except (AttributeError, IndexError, ValueError):
        return None
    return colors.astype(np.uint8) if len(colors) == len(loaded.vertices) else None
