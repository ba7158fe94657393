"""Fixed inputs of the kernels: small, analytic, the same on every machine."""

import importlib.util
import sys
from pathlib import Path

import numpy as np

from reconstruction.assets.volume import ObjectFrame, ObjectVolume
from reconstruction.core.types import Camera, DepthMaps
from registry.geometry import rigid
from registry.simulation import BodySpec

ROOT = Path(__file__).resolve().parents[2]


def bumpy_mesh(side: int = 320) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a wavy sheet 2 m wide: near and far triangles, some hidden by others."""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    z = 0.25 * np.sin(9 * x) * np.cos(7 * y)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    row, column = np.mgrid[: side - 1, : side - 1]
    a = (row * side + column).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)])
    return vertices, faces.astype(np.int32)


def camera(width: int, height: int) -> Camera:
    """Return a camera of 60 degrees across."""
    focal = 0.5 * width / np.tan(np.radians(30))
    return Camera(width, height, focal, focal, width / 2, height / 2)


def looking_down(height_m: float, x_m: float = 0.0, tilt: float = 0.3) -> np.ndarray:
    """Return `world_from_camera` of a camera above the origin that looks down, tilted about x."""
    c, s = np.cos(np.pi - tilt), np.sin(np.pi - tilt)
    rotation = np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    return rigid(rotation, np.array([x_m, -height_m * np.tan(tilt), height_m]))


def splats_on_a_sheet(count: int = 20_000) -> np.ndarray:
    """Return packed Gaussians float32 (count, 13), discs of 1.5 cm that lie on a wavy sheet 2 m wide."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-1, 1, (2, count))
    out = np.zeros((count, 13))
    out[:, :3] = np.stack([x, y, 0.05 * np.sin(9 * x) * np.cos(7 * y)], axis=1)
    out[:, 3] = 1.0  # no rotation: discs face up
    out[:, 7:9] = np.log(0.015)
    out[:, 9] = 1.5
    out[:, 10:] = rng.uniform(0, 1, (count, 3))
    return out.astype(np.float32)


def textured_images(count: int, width: int, height: int) -> np.ndarray:
    """Return smooth random gray images float32 (n, h, w) about zero, each shifted a little against the last."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(1)
    wide = gaussian_filter(rng.standard_normal((height, width + 4 * count)), 1.5).astype(np.float32)
    wide *= 60.0 / wide.std()
    return np.stack([np.ascontiguousarray(wide[:, 4 * i : 4 * i + width]) for i in range(count)])


def depth_of_a_ball(views: int, view_camera: Camera) -> tuple[DepthMaps, np.ndarray, np.ndarray]:
    """Return true depth maps of a ball on a plane, their poses, and gray images (n, h, w, 3)."""
    poses = np.stack([looking_down(1.6, 0.2 * (i - views / 2)) for i in range(views)])
    v, u = np.mgrid[: view_camera.height, : view_camera.width] + 0.5
    rays = np.stack(
        [(u - view_camera.cx) / view_camera.fx, (v - view_camera.cy) / view_camera.fy, np.ones_like(u)], -1
    )
    depth = np.zeros((views, *u.shape), np.float32)
    for i, pose in enumerate(poses):
        direction, eye = rays @ pose[:3, :3].T, pose[:3, 3]
        plane = np.where(direction[..., 2] < 0, -eye[2] / direction[..., 2], 0.0)
        center = eye - np.array([0, 0, 0.3])
        a, b, c = (direction**2).sum(-1), direction @ center, center @ center - 0.3**2
        root = b * b - a * c
        ball = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        depth[i] = np.minimum(np.where(ball > 0, ball, np.inf), plane)
    confidence = np.where(depth > 0, 2, 0).astype(np.uint8)
    images = np.full((*depth.shape, 3), 128, np.uint8)
    return DepthMaps(view_camera, depth, confidence), poses, images


def half_seen_can(cells: int = 72) -> tuple[ObjectVolume, ObjectFrame]:
    """Return the evidence of a can that stands on a table and was seen from the front only."""
    radius, height = 0.04, 0.11
    voxel = 2.6 * radius / cells
    shape = (cells, cells, int(height / voxel) + 10)
    origin = np.array([-1.3 * radius, -1.3 * radius, -3 * voxel])
    x, y, z = (origin[a] + (np.arange(shape[a]) + 0.5) * voxel for a in range(3))
    around = np.hypot(x[:, None], y[None, :])[:, :, None] - radius
    distance = np.maximum(around, z[None, None, :] - height)
    trunc = 3 * voxel
    front = (y[None, :, None] < -0.2 * radius) | (z[None, None, :] > height)
    free = (distance > 0) & front & np.ones(shape, bool)
    near = (np.abs(distance) < trunc) & front
    volume = ObjectVolume(
        origin, voxel, trunc, 0.5 * voxel, np.clip(distance, -trunc, trunc).astype(np.float32), free | near, free,
        near,
    )  # fmt: skip
    turn, up = np.meshgrid(np.linspace(-2.9, -0.25, 60), np.linspace(0.002, height - 0.002, 40))
    side = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], -1).reshape(-1, 3)
    points = side * radius + np.array([0, 0, 1.0]) * up.reshape(-1, 1)
    return volume, ObjectFrame(np.eye(4), points, side, True, None)


def pile(levels: int = 3, across: int = 3) -> list[BodySpec]:
    """Return boxes dropped in layers onto a floor, each turned a little against the others."""
    half = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 2

    def body(number: int, size: tuple, position: tuple, yaw: float, **options: object) -> BodySpec:
        c, s = np.cos(yaw), np.sin(yaw)
        pose = rigid(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array(position))
        values = dict(
            mass_kg=0.3, center_of_mass=np.zeros(3), inertia=None, friction=0.6, restitution=0.0, dynamic=True
        )
        return BodySpec(
            number, f"box {number}", (half * np.array(size),), world_from_object=pose, **(values | options)
        )

    bodies = [body(1, (4, 4, 0.2), (0, 0, -0.1), 0.0, dynamic=False, base=True)]
    for level in range(levels):
        for i in range(across):
            for j in range(across):
                place = (0.13 * i + 0.03 * level, 0.13 * j - 0.02 * level, 0.06 + 0.12 * level)
                bodies.append(body(len(bodies) + 1, (0.12, 0.1, 0.08), place, 0.7 * len(bodies)))
    return bodies


def room_registry(folder: Path) -> Path:
    """Write the hand-made room of the environment's tests into a registry; its id is `room`."""
    from registry import SceneRegistry

    tests = ROOT / "tests"
    spec = importlib.util.spec_from_file_location("perf_room", tests / "simrecon_envs" / "made_scenes.py")
    fixtures = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(tests))  # what the tests share lies there
    try:
        spec.loader.exec_module(fixtures)
    finally:
        sys.path.remove(str(tests))
    writer = fixtures.BundleWriter(folder / "bundle")
    writer.folder.mkdir(parents=True)
    fixtures.add_room(writer)
    fixtures.add_furniture(writer)
    writer.seal("room")
    registry = SceneRegistry(folder / "registry", create=True)
    registry.publish(writer.folder, "room")
    return folder / "registry"
