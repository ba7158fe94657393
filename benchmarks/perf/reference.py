"""The yardstick: a fixed piece of arithmetic and of memory traffic that has nothing to do with the project.

Machines differ, and the same machine differs from minute to minute. What is timed next to this kernel, in turns with
it, can be told as a ratio that hardly changes. CPU time is taken, not wall time, so that other programs matter little.
Never change this file: ratios of before and after could not be compared.
"""

import time

import numpy as np
from numba import njit

timer = time.process_time  # of all threads
_SIDE, _SWEEPS, _COPY_MB = 384, 24, 24


@njit(cache=True)
def _stencil(grid, out, sweeps):  # pragma: no cover - compiled
    """Average every cell with its eight neighbours, again and again: arithmetic that stays in the cache."""
    height, width = grid.shape
    for _ in range(sweeps):
        for y in range(1, height - 1):
            for x in range(1, width - 1):
                total = np.float32(0.0)
                for dy in range(-1, 2):
                    for dx in range(-1, 2):
                        total += grid[y + dy, x + dx]
                out[y, x] = total * np.float32(1.0 / 9.0)
        grid, out = out, grid


class Reference:
    """A stencil on one thread, then a copy of memory; `time_s` takes it once."""

    def __init__(self) -> None:
        """Make the inputs and compile."""
        rng = np.random.default_rng(0)
        self._grid = rng.random((_SIDE, _SIDE), np.float32)
        self._out = self._grid.copy()
        self._source = rng.integers(0, 255, _COPY_MB << 20, np.uint8)
        self._target = np.empty_like(self._source)
        self.time_s()

    def time_s(self) -> float:
        """Run once and return the CPU seconds that it took."""
        began = timer()
        _stencil(self._grid, self._out, _SWEEPS)
        np.copyto(self._target, self._source)
        return timer() - began
