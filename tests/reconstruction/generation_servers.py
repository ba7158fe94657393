"""Servers that speak the protocols of Rodin and of Hunyuan3D, or break them as they are told, and a mesh to send."""

import base64
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import trimesh

from reconstruction.synthetic.furniture import Workshop
from registry.geometry import GLTF_FROM_WORLD


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


class Server:
    """Answers by `respond(method, path, body)`; `broken` takes the place of single answers, by path."""

    def __init__(self, mesh: bytes = b"") -> None:
        self.mesh = mesh
        self.requests: list[tuple[str, str, bytes]] = []
        self.keys: list[str | None] = []
        self.broken: dict[
            str, list
        ] = {}  # path -> answers before the good ones: (status, headers, bytes) or "hang"
        outer, self._released = self, threading.Event()

        class Handler(BaseHTTPRequestHandler):
            def _answer(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                outer.requests.append((self.command, self.path, body))
                outer.keys.append(self.headers.get("Authorization"))
                waiting = outer.broken.get(self.path)
                answer = waiting.pop(0) if waiting else outer.respond(self.command, self.path, body)
                if answer == "hang":
                    outer._released.wait(5)
                    return
                status, headers, data = answer
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            do_GET = do_POST = _answer

            def log_message(self, *args) -> None:
                return

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()

    def respond(self, method: str, path: str, body: bytes):
        raise NotImplementedError

    def sent(self, path: str) -> list[bytes]:
        """Return the bodies that were sent to a path."""
        return [body for _, asked, body in self.requests if asked == path]

    def close(self) -> None:
        self._released.set()
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self):
        return self

    def __exit__(self, *error) -> None:
        self.close()


def reply(document: dict, status: int = 200) -> tuple[int, dict, bytes]:
    """Return a JSON answer."""
    return status, {"Content-Type": "application/json"}, json.dumps(document).encode()


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
