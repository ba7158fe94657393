"""Array functions for tasks that work with NumPy and with torch.

One environment on the CPU uses NumPy, many on a GPU use torch: on a few numbers a torch operation costs as much as ten
NumPy operations, and the fifty operations of a task more than the physics. Operators, slices, `sum(1)` and `all(1)` are
the same in both. Arrays are batched, (b, ...), float32 or bool. In NumPy b is 1, and an array (b,) may be a NumPy
scalar, whose operations cost a tenth of those of an array: do not index it.
"""

import math
from typing import Any, TypeAlias

import numpy as np
import torch

# np.ndarray, np.generic or torch.Tensor; type checkers would reject operators on a union of them.
Array: TypeAlias = Any
_SCALAR: Any = np.generic  # not narrowed by type checkers: np.generic has no comparison
_NUMBERS = frozenset({np.float32, np.bool_, np.int64})


def tensor(x: Array) -> torch.Tensor:
    """Convert an array to a tensor (a copy, if it is NumPy's): a scalar to shape (1,), float64 to float32."""
    if type(x) in _NUMBERS:
        return torch.from_numpy(np.array([x]))
    if isinstance(x, torch.Tensor):
        return x
    if isinstance(x, np.generic):
        x = np.array([x])
        return torch.from_numpy(x if x.dtype != np.float64 else x.astype(np.float32))
    return torch.from_numpy(x.astype(np.float32) if x.dtype == np.float64 else x.copy())


def tensors(named: dict[str, Array]) -> dict[str, torch.Tensor]:
    """Apply `tensor` to every value."""
    array, wrap = np.array, torch.from_numpy
    return {key: wrap(array([x])) if type(x) in _NUMBERS else tensor(x) for key, x in named.items()}


def numpy(x: Array) -> np.ndarray:
    """Convert an array to NumPy, on the CPU."""
    return x.cpu().numpy() if isinstance(x, torch.Tensor) else x


def norm(x: Array) -> Array:
    """Return the Euclidean norms (...) of vectors (..., d)."""
    if isinstance(x, torch.Tensor):
        return torch.linalg.norm(x, dim=-1)
    if x.ndim == 2 and len(x) == 1:
        return np.float32(math.hypot(*x[0].tolist()))
    return np.sqrt((x * x).sum(-1))


def surely_not(x: Array) -> bool:
    """Return whether a condition (b,) is a false NumPy scalar; false for tensors, which would need a GPU sync."""
    return isinstance(x, np.bool_) and not x


def real(x: Array) -> Array:
    """Convert bool or integers to float32."""
    if isinstance(x, np.generic):
        return np.float32(x)
    return x.float() if isinstance(x, torch.Tensor) else x.astype(np.float32)


def whole(x: Array) -> Array:
    """Convert to int64."""
    if isinstance(x, np.generic):
        return np.int64(x)
    return x.long() if isinstance(x, torch.Tensor) else x.astype(np.int64)


def where(condition: Array, yes: Array | float, no: Array | float) -> Array:
    """Select `yes` where the condition holds, else `no`; numbers are broadcast."""
    if isinstance(condition, torch.Tensor):
        return torch.where(condition, yes, no)
    if isinstance(condition, np.bool_):
        return _float32(yes if condition else no)
    return np.where(condition, _float32(yes), _float32(no))


def clamp(x: Array, least: float | None = None, most: float | None = None) -> Array:
    """Clip values to [least, most]; None is no bound."""
    if isinstance(x, torch.Tensor):
        return torch.clamp(x, least, most)
    if isinstance(x, _SCALAR):
        x = x if least is None or x >= least else type(x)(least)
        return x if most is None or x <= most else type(x)(most)
    x = x if least is None else np.maximum(x, least)
    return x if most is None else np.minimum(x, most)


def tanh(x: Array) -> Array:
    """Return the hyperbolic tangent."""
    if isinstance(x, np.generic):
        return np.float32(math.tanh(x))
    return torch.tanh(x) if isinstance(x, torch.Tensor) else np.tanh(x)


def atan2(y: Array, x: Array) -> Array:
    """Return the angle (rad) of (x, y)."""
    if isinstance(y, np.generic):
        return np.float32(math.atan2(y, x))
    return torch.atan2(y, x) if isinstance(y, torch.Tensor) else np.arctan2(y, x)


def turn(x: Array, yaw: Array) -> Array:
    """Rotate vectors (b, 3) about +z by angles (b,) (rad)."""
    if isinstance(yaw, np.generic):
        c, s, (along, across, up) = math.cos(yaw), math.sin(yaw), x[0].tolist()
        return np.array([[c * along - s * across, s * along + c * across, up]], np.float32)
    c, s, (along, across, up) = yaw.cos(), yaw.sin(), x.unbind(-1)
    return torch.stack([c * along - s * across, s * along + c * across, up], dim=1)


def stack(parts: list[Array]) -> Array:
    """Stack n arrays (b, ...) to (b, n, ...)."""
    if isinstance(parts[0], torch.Tensor):
        return torch.stack(parts, dim=1)
    if all(isinstance(part, np.generic) for part in parts):
        return np.array([parts])
    return np.stack([np.atleast_1d(part) for part in parts], 1)


def component(x: Array, axis: int) -> Array:
    """Return a component (b,) of vectors (b, k)."""
    return x[:, axis] if isinstance(x, torch.Tensor) else x[0, axis]


def column(x: Array) -> Array:
    """Reshape (b,) to (b, 1)."""
    return np.array([[x]]) if isinstance(x, np.generic) else x[:, None]


def largest(x: Array) -> Array:
    """Return the maximum along the last axis."""
    return x.max(-1) if isinstance(x, np.ndarray) else x.amax(dim=-1)


def smallest(x: Array) -> Array:
    """Return the minimum along the last axis."""
    return x.min(-1) if isinstance(x, np.ndarray) else x.amin(dim=-1)


def larger(x: Array, y: Array) -> Array:
    """Return the elementwise maximum."""
    if isinstance(x, _SCALAR) and isinstance(y, _SCALAR):
        return x if x >= y else y
    return torch.maximum(x, y) if isinstance(x, torch.Tensor) else np.maximum(x, y)


def pick(x: Array, index: Array) -> Array:
    """Return x[i, index[i]] (b, ...) of x (b, n, ...) and index (b,)."""
    return x[np.arange(len(x)) if isinstance(x, np.ndarray) else torch.arange(len(x), device=x.device), index]


def rotate(quat: Array, vector: Array) -> Array:
    """Rotate vectors (b, 3) by unit quaternions wxyz (b, 4)."""
    if isinstance(quat, np.ndarray):
        vector = np.broadcast_to(vector, (len(quat), 3))
        axis = quat[:, 1:]
        twice = 2.0 * np.cross(axis, vector)
        return vector + quat[:, :1] * twice + np.cross(axis, twice)
    vector = vector.expand(*quat.shape[:-1], 3)
    axis = quat[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vector)
    return vector + quat[..., :1] * twice + torch.linalg.cross(axis, twice)


def _float32(x: Array | float) -> Array:
    return x if isinstance(x, np.ndarray | np.generic) else np.float32(x)
