"""CoACD in a process of its own: on some meshes it crashes or does not end, and neither must cost the scene."""

import atexit
import io
import struct
import subprocess
import sys
import threading

import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, lighten

_LIMIT_S = 60.0
_LENGTH = struct.Struct("<q")


class Decomposer:
    """Runs CoACD in a child that is started at the first question and after each crash."""

    def __init__(self, limit_s: float = _LIMIT_S) -> None:
        """Nothing is started yet."""
        self._limit_s = limit_s
        self._child: subprocess.Popen | None = None
        self._lock = threading.Lock()

    def run(
        self, vertices: np.ndarray, faces: np.ndarray, options: dict[str, float]
    ) -> list[np.ndarray] | None:
        """Return the vertices (k, 3) of each part of a closed mesh; None where CoACD failed on it."""
        with self._lock:
            child = self._started()
            timer = threading.Timer(self._limit_s, child.kill)
            timer.start()
            try:
                send(child.stdin, {"vertices": vertices, "faces": faces, **options})
                answer = receive(child.stdout)
            except (OSError, EOFError):
                self.close()
                return None
            finally:
                timer.cancel()
        return [answer[str(number)] for number in range(len(answer))]

    def _started(self) -> subprocess.Popen:
        if self._child is None or self._child.poll() is not None:
            self._child = subprocess.Popen(
                [sys.executable, "-m", "reconstruction.assets.collision.child"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        return self._child

    def close(self) -> None:
        """End the child."""
        child, self._child = self._child, None
        if child is not None:
            child.kill()
            child.wait()
            child.stdin.close()
            child.stdout.close()


def send(stream, arrays: dict) -> None:
    """Write named arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    stream.write(_LENGTH.pack(buffer.getbuffer().nbytes))
    stream.write(buffer.getbuffer())
    stream.flush()


def receive(stream) -> dict[str, np.ndarray]:
    """Read named arrays.

    Raises:
        EOFError: the other side is gone.
    """
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        raise EOFError
    data = stream.read(_LENGTH.unpack(head)[0])
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


_decomposer = Decomposer()
atexit.register(_decomposer.close)


def end_decomposer() -> None:
    """End the process that parts are decomposed in; the next part starts another."""
    _decomposer.close()


def decompose(solid: Solid, threshold: float, budget: int, config: AssetsConfig) -> list[np.ndarray] | None:
    """Run CoACD on the normalized, decimated mesh; return the vertices of each part, None where it failed."""
    light = lighten(solid, config.collision_faces, 0.004 * float(solid.extents.max()))
    center = (light.vertices.max(axis=0) + light.vertices.min(axis=0)) / 2
    scale = float(light.extents.max()) / 2
    options = {
        "threshold": threshold, "budget": budget, "hull_vertices": config.hull_vertices, "seed": config.seed,
    }  # fmt: skip
    parts = _decomposer.run((light.vertices - center) / scale, light.faces, options)
    return None if parts is None else [part * scale + center for part in parts]
