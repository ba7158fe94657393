"""Reusable buffers: allocating fresh pages in every step would take as long as rendering."""

import numpy as np
from numpy.typing import DTypeLike


class Scratch:
    """Provides arrays by name; an array overwrites the former one of the same name."""

    def __init__(self) -> None:
        self._buffers: dict[str, np.ndarray] = {}

    def empty(self, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> np.ndarray:
        """Return an array with arbitrary content."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        buffer = self._buffers.get(name)
        if buffer is None or len(buffer) < size:
            buffer = self._buffers[name] = np.empty(size + size // 4 + 64, np.uint8)
        return buffer[:size].view(dtype).reshape(shape)

    def zeros(self, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> np.ndarray:
        """Return an array of zeros."""
        array = self.empty(name, shape, dtype)
        array[...] = 0
        return array
