"""The meshes of a bundle, placed."""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assets.gltf import read_glb
from reconstruction.core.types import Camera, TexturedMesh
from registry import SceneBundle
from registry.errors import UsageError
from registry.geometry import transform_points


@dataclass(frozen=True)
class PlacedMesh:
    """One base surface or object of a scene, in some world."""

    id: int
    label: str
    base: bool
    dynamic: bool
    vertices: np.ndarray  # float64 (v, 3)
    faces: np.ndarray  # int32 (f, 3)
    visual: TexturedMesh  # in its own space
    world_from_mesh: np.ndarray  # float64 (4, 4) as the bundle has it

    @property
    def bounds(self) -> np.ndarray:
        """Lower and upper corner (2, 3) of its axis-aligned box."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def moved(self, b_from_a: np.ndarray) -> "PlacedMesh":
        """Return it with its vertices taken to another world."""
        return replace(self, vertices=transform_points(b_from_a, self.vertices))


def placed_meshes(bundle: SceneBundle) -> list[PlacedMesh]:
    """Read every mesh of a bundle: base surfaces first, then objects, in the bundle's world."""
    out = []
    for item in bundle.scene["base"]:
        mesh = read_glb(bundle.resolve(item["mesh"]))
        vertices = np.asarray(mesh.vertices, np.float64)
        out.append(PlacedMesh(item["id"], item["label"], True, False, vertices, mesh.faces, mesh, np.eye(4)))
    for item in bundle.scene["objects"]:
        mesh = read_glb(bundle.resolve(item["visual"]))
        pose = np.asarray(item["world_from_object"], np.float64)
        out.append(
            PlacedMesh(
                item["id"],
                item["label"],
                False,
                bool(item["dynamic"]),
                transform_points(pose, mesh.vertices),
                mesh.faces,
                mesh,
                pose,
            )
        )
    return out


def joined(meshes: list) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (v, 3) and faces (f, 3) of several meshes as one."""
    if not meshes:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    vertices = np.concatenate([np.asarray(m.vertices, np.float64) for m in meshes])
    return vertices, np.concatenate([np.asarray(m.faces) + o for m, o in zip(meshes, offsets)]).astype(
        np.int32
    )


def bundle_camera(bundle: SceneBundle) -> Camera:
    """Return the bundle's camera.

    Raises:
        UsageError: it has lens distortion; pictures would have to be undistorted first.
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
    """Return world_from_camera (4, 4) by video frame number."""
    cameras = bundle.cameras
    return {int(i): pose for i, pose in zip(cameras.indices, cameras.world_from_camera)}
