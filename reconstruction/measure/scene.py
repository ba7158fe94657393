"""Read the meshes and cameras of a bundle."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assets.gltf import read_glb
from reconstruction.core.types import Camera, TexturedMesh
from registry import SceneBundle
from registry.errors import UsageError
from registry.geometry import transform_points


@dataclass(frozen=True)
class PlacedMesh:
    """One base surface or object of a scene, in the scene's or the true world."""

    id: int
    label: str
    base: bool
    dynamic: bool
    vertices: np.ndarray  # float64 (v, 3)
    faces: np.ndarray  # int32 (f, 3)
    visual: TexturedMesh  # in object space
    world_from_mesh: np.ndarray  # float64 (4, 4) of the bundle

    @property
    def bounds(self) -> np.ndarray:
        """Lower and upper corner (2, 3) of the axis-aligned bounding box."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def moved(self, b_from_a: np.ndarray) -> "PlacedMesh":
        """Return a copy with the vertices transformed to another world."""
        return replace(self, vertices=transform_points(b_from_a, self.vertices))


def placed_meshes(bundle: SceneBundle) -> list[PlacedMesh]:
    """Read all meshes of a bundle in its world: base surfaces first, then objects."""
    out = []
    for item in bundle.scene["base"]:
        mesh = read_glb(bundle.resolve(item["mesh"]))
        vertices = np.asarray(mesh.vertices, np.float64)
        out.append(PlacedMesh(item["id"], item["label"], True, False, vertices, mesh.faces, mesh, np.eye(4)))
    for item in bundle.scene["objects"]:
        mesh = read_glb(bundle.resolve(item["visual"]))
        pose = np.asarray(item["world_from_object"], np.float64)
        vertices, dynamic = transform_points(pose, mesh.vertices), bool(item["dynamic"])
        out.append(PlacedMesh(item["id"], item["label"], False, dynamic, vertices, mesh.faces, mesh, pose))
    return out


def backdrop_mesh(bundle: SceneBundle) -> TexturedMesh | None:
    """Read the backdrop of a bundle, in its world; None for a bundle without one. It is no surface of the scene."""
    return None if bundle.backdrop is None else read_glb(bundle.resolve(bundle.backdrop))


def joined(meshes: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Concatenate meshes with `vertices` and `faces`: float64 (v, 3) and int32 (f, 3)."""
    if not meshes:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    vertices = np.concatenate([np.asarray(m.vertices, np.float64) for m in meshes])
    faces = np.concatenate([np.asarray(m.faces) + offset for m, offset in zip(meshes, offsets)])
    return vertices, faces.astype(np.int32)


def bundle_camera(bundle: SceneBundle) -> Camera:
    """Return the bundle's camera.

    Raises:
        UsageError: it has lens distortion.
    """
    cameras = bundle.cameras
    params = [float(x) for x in cameras.params]
    if any(abs(x) > 1e-12 for x in params[4:]):
        raise UsageError(
            f"evaluate: {bundle.scene['id']} has a camera with lens distortion ({cameras.model} {params}); "
            "only bundles of undistorted frames can be evaluated"
        )
    return Camera(cameras.width, cameras.height, *params[:4])


def bundle_poses(bundle: SceneBundle) -> dict[int, np.ndarray]:
    """Return world_from_camera (4, 4) by video frame."""
    cameras = bundle.cameras
    return {int(i): pose for i, pose in zip(cameras.indices, cameras.world_from_camera)}
