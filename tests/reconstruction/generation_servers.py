"""Servers that speak the protocols of Rodin and of Hunyuan3D, or break them as they are told, and a mesh to send."""

import base64

import numpy as np
import trimesh
from local_server import LocalServer, reply

from registry.geometry import GLTF_FROM_WORLD
from synthetic.furniture import Workshop


def thing_mesh(make, seed: int = 0) -> trimesh.Trimesh:
    """Return the true mesh of a thing of the generator's rooms: +z up, metres, standing on z = 0."""
    vertices, faces, count = [], [], 0
    for solid in make(Workshop(np.random.default_rng(seed), 1e9, 0.02), "x").parts:
        for patch in solid:
            vertices.append(patch.vertices)
            faces.append(patch.faces + count)
            count += len(patch.vertices)
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)


def as_glb(mesh: trimesh.Trimesh, scale: float = 1.0, yaw: float = 0.0, color=(200, 40, 30)) -> bytes:
    """Return a mesh as a generator sends it: +y up, of another size, turned, painted."""
    made = mesh.copy()
    made.apply_transform(trimesh.transformations.rotation_matrix(yaw, [0, 0, 1]))
    made.apply_scale(scale)
    made.apply_transform(GLTF_FROM_WORLD)
    shade = np.linspace(0.6, 1.0, len(made.vertices))[:, None] * np.array(color)
    made.visual = trimesh.visual.ColorVisuals(made, vertex_colors=shade.astype(np.uint8))
    return made.export(file_type="glb")


class Server(LocalServer):
    """Answers by `respond(method, path, body)`; `broken` takes the place of single answers, by path."""

    def __init__(self, mesh: bytes = b"") -> None:
        self.mesh = mesh
        self.requests: list[tuple[str, str, bytes]] = []
        self.keys: list[str | None] = []
        self.broken: dict[str, list] = {}  # path -> answers before the good ones
        super().__init__()

    def answer(self, method: str, path: str, headers: dict, body: bytes):
        self.requests.append((method, path, body))
        self.keys.append(headers.get("Authorization"))
        waiting = self.broken.get(path)
        return waiting.pop(0) if waiting else self.respond(method, path, body)

    def respond(self, method: str, path: str, body: bytes):
        raise NotImplementedError

    def sent(self, path: str) -> list[bytes]:
        """Return the bodies that were sent to a path."""
        return [body for _, asked, body in self.requests if asked == path]


class RodinServer(Server):
    """POST /api/v2/rodin, /api/v2/status and /api/v2/download, GET /api/v2/check_balance and the file itself."""

    def __init__(self, mesh: bytes = b"", states=("Waiting", "Generating", "Done")) -> None:
        super().__init__(mesh)
        self.states = list(states)
        self.files = [("preview.webp", "/files/preview"), ("base_basic_pbr.glb", "/files/mesh?signature=1")]

    def respond(self, method: str, path: str, body: bytes):
        if path == "/api/v2/rodin":
            jobs = {"uuids": ["j1", "j2"], "subscription_key": "sub-1"}
            return reply({"error": None, "message": "Submitted.", "uuid": "task-1", "jobs": jobs}, 201)
        if path == "/api/v2/status":
            state = self.states.pop(0) if len(self.states) > 1 else self.states[0]
            jobs = [{"uuid": "j1", "status": "Done"}, {"uuid": "j2", "status": state}]
            return reply({"error": "OK", "jobs": jobs}, 201)
        if path == "/api/v2/download":
            listed = [{"name": name, "url": f"{self.url}{address}"} for name, address in self.files]
            return reply({"error": "OK", "list": listed}, 201)
        if path == "/api/v2/check_balance":
            return reply({"balance": 12.5})
        return 200, {"Content-Type": "model/gltf-binary"}, self.mesh


class HunyuanServer(Server):
    """POST /generate (the file), POST /send and GET /status/{uid}."""

    def __init__(self, mesh: bytes = b"", states=("processing", "texturing", "completed")) -> None:
        super().__init__(mesh)
        self.states = list(states)

    def respond(self, method: str, path: str, body: bytes):
        if path == "/generate":
            return 200, {"Content-Type": "application/octet-stream"}, self.mesh
        if path == "/send":
            return reply({"uid": "7"})
        if path.startswith("/status/"):
            state = self.states.pop(0) if len(self.states) > 1 else self.states[0]
            made = {"model_base64": base64.b64encode(self.mesh).decode()} if state == "completed" else {}
            return reply({"status": state} | made)
        return reply({"status": "healthy", "worker_id": "a"})
