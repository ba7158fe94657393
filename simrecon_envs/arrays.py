"""The functions of arrays that tasks are written with, for NumPy and torch alike.

One environment on the CPU is computed in NumPy, many on a GPU in torch: for a handful of numbers an operation of torch
costs as much as ten of NumPy, and a task's fifty operations more than the physics does. Operators, slices, `sum(1)` and
`all(1)` are the same in both. Arrays are batched, (b, ...), float32 or bool.
"""

import numpy as np
import torch

Array = np.ndarray | torch.Tensor


def tensor(x: Array) -> torch.Tensor:
    """Return an array as a tensor of its own; doubles become floats."""
    if isinstance(x, torch.Tensor):
        return x
    return torch.from_numpy(x.astype(np.float32) if x.dtype == np.float64 else x.copy())


def numpy(x: Array) -> np.ndarray:
    """Return an array as NumPy's, on the CPU."""
    return x if isinstance(x, np.ndarray) else x.cpu().numpy()


def norm(x: Array) -> Array:
    """Return the lengths (...) of vectors (..., d)."""
    if isinstance(x, np.ndarray):
        return np.sqrt((x * x).sum(-1))
    return torch.linalg.norm(x, dim=-1)


def real(x: Array) -> Array:
    """Return an array of bool or integers as float32."""
    return x.astype(np.float32) if isinstance(x, np.ndarray) else x.float()


def whole(x: Array) -> Array:
    """Return an array as integers."""
    return x.astype(np.int64) if isinstance(x, np.ndarray) else x.long()


def where(condition: Array, yes: Array | float, no: Array | float) -> Array:
    """Return `yes` where the condition holds, else `no`; numbers stand for arrays of them."""
    if isinstance(condition, torch.Tensor):
        return torch.where(condition, yes, no)
    return np.where(condition, _float32(yes), _float32(no))


def clamp(x: Array, least: float | None = None, most: float | None = None) -> Array:
    """Return an array with its values brought between two bounds."""
    if isinstance(x, torch.Tensor):
        return torch.clamp(x, least, most)
    x = x if least is None else np.maximum(x, least)
    return x if most is None else np.minimum(x, most)


def tanh(x: Array) -> Array:
    """Return the hyperbolic tangent."""
    return np.tanh(x) if isinstance(x, np.ndarray) else torch.tanh(x)


def atan2(y: Array, x: Array) -> Array:
    """Return the angle of (x, y)."""
    return np.arctan2(y, x) if isinstance(y, np.ndarray) else torch.atan2(y, x)


def cos_sin(x: Array) -> tuple[Array, Array]:
    """Return cosine and sine."""
    return (np.cos(x), np.sin(x)) if isinstance(x, np.ndarray) else (torch.cos(x), torch.sin(x))


def stack(parts: list[Array]) -> Array:
    """Return arrays (b, ...) side by side, (b, n, ...)."""
    return np.stack(parts, 1) if isinstance(parts[0], np.ndarray) else torch.stack(parts, dim=1)


def largest(x: Array) -> Array:
    """Return the largest of the last axis."""
    return x.max(-1) if isinstance(x, np.ndarray) else x.amax(dim=-1)


def smallest(x: Array) -> Array:
    """Return the smallest of the last axis."""
    return x.min(-1) if isinstance(x, np.ndarray) else x.amin(dim=-1)


def pick(x: Array, index: Array) -> Array:
    """Return of every row of x (b, n, ...) the one that index (b,) says."""
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


def _float32(x: Array | float) -> Array | np.float32:
    return x if isinstance(x, np.ndarray) else np.float32(x)
