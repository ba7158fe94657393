"""Memory that is used again every step: fresh pages cost as much time as the rendering itself."""

import numpy as np


class Scratch:
    """Hands out arrays by name; one with the same name overwrites the one before.

    A result that lives in scratch memory is valid until the next call with the same scratch.
    """

    def __init__(self) -> None:
        self._buffers: dict[str, np.ndarray] = {}

    def empty(self, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        """Return an array with arbitrary content."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        buffer = self._buffers.get(name)
        if buffer is None or len(buffer) < size:
            buffer = self._buffers[name] = np.empty(size + size // 4 + 64, np.uint8)
        return buffer[:size].view(dtype).reshape(shape)

    def zeros(self, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        """Return an array of zeros."""
        array = self.empty(name, shape, dtype)
        array[...] = 0
        return array
