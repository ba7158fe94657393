"""A stand-in for a generative model: completes an object from one view of it, served as Hunyuan3D's server does.

It knows what the view shows and nothing else: colors, mask and depth of the reconstruction there, and which way is
up. Never the truth, no other view. What the view shows to be empty is carved from a box around what it shows; that
things look the same turned by half (or in a mirror, if that fits better) is its only prior. A generative model knows
more about things and less about depth.
"""

import base64
import hashlib
import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from reconstruction.core.types import Camera
from registry.geometry import GLTF_FROM_WORLD, invert_rigid, transform_points

_CELLS = 56  # along the longest side
_LEAST_POINTS = 30
_MOST_DISAGREEING = 0.1  # of the seen points that a symmetry moves into what is seen to be empty


@dataclass(frozen=True)
class Shown:
    """What a view shows of an object."""

    picture: np.ndarray  # uint8 (h, w, 3)
    mask: np.ndarray  # bool (h, w)
    depth: np.ndarray  # float32 (h, w) z-depth, metres, 0 where there is none
    camera: Camera
    world_from_camera: np.ndarray  # float64 (4, 4)


def complete_from_view(shown: Shown) -> bytes | None:
    """Return a closed, colored mesh as a .glb: upright, its front ahead, its longest side 1; None of too few pixels."""
    shown = replace(shown, depth=_filled(shown.depth, shown.mask))
    seen, colors = _seen_points(shown)
    if len(seen) < _LEAST_POINTS:
        return None
    low, high = np.percentile(seen, [0.5, 99.5], axis=0)
    center, size = (low + high) / 2, np.maximum(high - low, 0.01)
    ahead = shown.world_from_camera[:2, 2] / max(np.linalg.norm(shown.world_from_camera[:2, 2]), 1e-9)
    cell = float(size.max()) / _CELLS
    symmetry = _best_symmetry(shown, seen, center, ahead, cell)
    count = np.ceil(size / cell).astype(int) + 1
    axes = [low[k] + cell * np.arange(count[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    empty = _seen_empty(shown, grid, cell)
    if symmetry is not None:
        empty |= _seen_empty(shown, symmetry(grid), cell)
    solid = np.pad((~empty).reshape(count).astype(np.float32), 2)
    if not solid.any():
        return None
    field = gaussian_filter(solid, 0.6)
    if field.max() <= 0.5:
        return None
    vertices, faces, _, _ = marching_cubes(field, 0.5)
    vertices = low + cell * (vertices - 2)
    near = cKDTree(seen if symmetry is None else np.concatenate([seen, symmetry(seen)])).query(vertices)[1]
    return _as_glb((vertices - center) / size.max(), faces, colors[near % len(colors)], ahead)


def _filled(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the depth (h, w), where the object was hidden from all frames as it is around."""
    holes = (mask & (depth <= 0)).astype(np.uint8)
    return cv2.inpaint(depth, holes, 3, cv2.INPAINT_NS) if holes.any() and (depth > 0).any() else depth


def _seen_points(shown: Shown) -> tuple[np.ndarray, np.ndarray]:
    """Return what the view shows of the object as points (n, 3) in world space, and their colors (n, 3)."""
    rows, columns = np.nonzero(shown.mask & (shown.depth > 0))
    z, camera = shown.depth[rows, columns].astype(np.float64), shown.camera
    local = np.stack(
        [(columns + 0.5 - camera.cx) / camera.fx * z, (rows + 0.5 - camera.cy) / camera.fy * z, z], axis=1
    )
    return transform_points(shown.world_from_camera, local), shown.picture[rows, columns]


def _best_symmetry(
    shown: Shown, seen: np.ndarray, center: np.ndarray, ahead: np.ndarray, cell: float
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the symmetry of upright things that what is seen contradicts least; None where it contradicts all."""

    def half_turn(points: np.ndarray) -> np.ndarray:
        return np.concatenate([2 * center[:2] - points[:, :2], points[:, 2:]], axis=1)

    def mirror(points: np.ndarray) -> np.ndarray:
        along = (points[:, :2] - center[:2]) @ ahead
        return np.concatenate([points[:, :2] - 2 * along[:, None] * ahead, points[:, 2:]], axis=1)

    wrong = [float(_seen_empty(shown, one(seen), 2 * cell).mean()) for one in (half_turn, mirror)]
    best = int(np.argmin(wrong))
    return (half_turn, mirror)[best] if wrong[best] < _MOST_DISAGREEING else None


def _seen_empty(shown: Shown, points: np.ndarray, margin_m: float) -> np.ndarray:
    """Tell which points (n, 3) the view shows to be empty: beside the object, or before its surface."""
    local = transform_points(invert_rigid(shown.world_from_camera), points)
    camera, z = shown.camera, np.maximum(local[:, 2], 1e-6)
    u = np.floor(camera.fx * local[:, 0] / z + camera.cx).astype(int)
    v = np.floor(camera.fy * local[:, 1] / z + camera.cy).astype(int)
    inside = (local[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    out = np.zeros(len(points), bool)
    rows = np.flatnonzero(inside)
    mask, depth = shown.mask[v[rows], u[rows]], shown.depth[v[rows], u[rows]]
    out[rows] = ~mask | ((depth > 0) & (z[rows] < depth - margin_m))
    return out


def _as_glb(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, ahead: np.ndarray) -> bytes:
    turn = trimesh.transformations.rotation_matrix(-np.arctan2(ahead[1], ahead[0]), [0, 0, 1])
    mesh = trimesh.Trimesh(vertices, faces[:, ::-1], vertex_colors=colors, process=False)
    if mesh.volume < 0:
        mesh.invert()
    mesh.apply_transform(GLTF_FROM_WORLD @ turn)
    return mesh.export(file_type="glb")


class OneViewServer:
    """Answers POST /generate as `api_server.py` of Hunyuan3D-2 does, for pictures that it was told of."""

    def __init__(self) -> None:
        known = self._known = {}

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                shown = known.get(_digest(base64.b64decode(body["image"])))
                mesh = None if shown is None else complete_from_view(shown)
                if mesh is None:
                    self._send(404, "application/json", b'{"text": "no mesh", "error_code": 1}')
                else:
                    self._send(200, "application/octet-stream", mesh)

            def _send(self, status: int, kind: str, data: bytes) -> None:
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_: object) -> None:
                return

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def tell(self, sent: bytes, shown: Shown) -> None:
        """Tell what stands behind a picture, by the PNG that a client sends."""
        self._known[_digest(sent)] = shown

    def __enter__(self) -> "OneViewServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
