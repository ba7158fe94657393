"""CoACD in a child process, as it crashes or hangs on some meshes."""

import atexit
import subprocess
import sys
import threading
from pathlib import Path
from typing import IO

import numpy as np

from reconstruction.assets.collision import coacd_process as child_module
from reconstruction.assets.collision.coacd_process import receive, send
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, lighten
from registry.errors import EnvironmentMissing

_LIMIT_S = 300.0  # per request; a part takes a second or two


class Decomposer:
    """Runs CoACD in a child process, which starts with the first request and again after each crash."""

    def __init__(self, limit_s: float = _LIMIT_S, python: str = sys.executable) -> None:
        """Set the time limit of a request and the interpreter."""
        self._limit_s = limit_s
        self._python = python
        self._child: subprocess.Popen | None = None
        self._lock = threading.Lock()

    def run(
        self, vertices: np.ndarray, faces: np.ndarray, options: dict[str, float]
    ) -> list[np.ndarray] | None:
        """Decompose a closed mesh: vertices (k, 3) of each part; None where CoACD failed.

        Raises:
            EnvironmentMissing: CoACD cannot be run.
        """
        with self._lock:
            child = self._started()
            timer = self._guard(child)
            try:
                stdin, stdout = _pipes(child)
                send(stdin, {"vertices": vertices, "faces": faces, **options})
                answer = receive(stdout)
            except (OSError, EOFError):
                self.close()
                return None
            finally:
                timer.cancel()
        return [answer[str(number)] for number in range(len(answer))]

    def _guard(self, child: subprocess.Popen) -> threading.Timer:
        """Kill the child after the time limit."""
        timer = threading.Timer(self._limit_s, child.kill)
        timer.daemon = True
        timer.start()
        return timer

    def _started(self) -> subprocess.Popen:
        """Return the running child, or start one."""
        if self._child is not None and self._child.poll() is None:
            return self._child
        self.close()
        try:
            self._child = subprocess.Popen(
                [self._python, str(Path(child_module.__file__).resolve())],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except OSError as error:
            raise self._missing(str(error)) from error
        timer = self._guard(self._child)
        try:
            missing = receive(_pipes(self._child)[1]).get("missing")
        except (OSError, EOFError) as error:
            status = self._child.wait()
            self.close()
            raise self._missing(f"its process ended with status {status}") from error
        finally:
            timer.cancel()
        if missing is not None:
            self.close()
            raise self._missing(str(missing))
        return self._child

    def _missing(self, why: str) -> EnvironmentMissing:
        return EnvironmentMissing(
            f"assets: collision shapes need CoACD in a process of its own, which {self._python} cannot start ({why}); "
            "install it with `pip install coacd`, then `simrecon doctor`"
        )

    def close(self) -> None:
        """End the child."""
        child, self._child = self._child, None
        if child is not None:
            child.kill()
            child.wait()
            for pipe in _pipes(child):
                pipe.close()


def _pipes(child: subprocess.Popen) -> tuple[IO[bytes], IO[bytes]]:
    assert child.stdin is not None
    assert child.stdout is not None
    return child.stdin, child.stdout


_decomposer = Decomposer()
atexit.register(_decomposer.close)


def end_decomposer() -> None:
    """End the child process; the next part starts another."""
    _decomposer.close()


def decompose(solid: Solid, threshold: float, budget: int, config: AssetsConfig) -> list[np.ndarray] | None:
    """Decimate and normalize a mesh and run CoACD on it: vertices (k, 3) of each part, None where it failed."""
    light = lighten(solid, config.collision_faces, 0.004 * float(solid.extents.max()))
    center = (light.vertices.max(axis=0) + light.vertices.min(axis=0)) / 2
    scale = float(light.extents.max()) / 2
    options = {
        "threshold": threshold, "budget": budget, "hull_vertices": config.hull_vertices, "seed": config.seed,
    }  # fmt: skip
    parts = _decomposer.run((light.vertices - center) / scale, light.faces, options)
    return None if parts is None else [part * scale + center for part in parts]
