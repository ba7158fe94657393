# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Rigid and similarity transforms, quaternions and axis conventions. NumPy only.

Transforms are named `b_from_a`: `x_b = b_from_a @ x_a`. Quaternions are wxyz. See `docs/conventions.md`.
"""

import numpy as np

# From glTF axes (+Y up, +Z towards the viewer) to object or world axes (+Z up).
WORLD_FROM_GLTF = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
GLTF_FROM_WORLD = WORLD_FROM_GLTF.T
# SAPIEN camera: +x forward, +y left, +z up. OpenCV camera: +x right, +y down, +z forward.
SAPIEN_CAMERA_FROM_OPENCV = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


def quat_from_matrix(rotation: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (..., 3, 3) to unit quaternions wxyz (..., 4) with w >= 0."""
    m = np.asarray(rotation, dtype=np.float64)
    # Eigenvector of the largest eigenvalue of a symmetric 4x4 matrix (Bar-Itzhack 2000); no singular cases.
    k = np.empty((*m.shape[:-2], 4, 4))
    k[..., 0, 0] = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    k[..., 0, 1] = k[..., 1, 0] = m[..., 2, 1] - m[..., 1, 2]
    k[..., 0, 2] = k[..., 2, 0] = m[..., 0, 2] - m[..., 2, 0]
    k[..., 0, 3] = k[..., 3, 0] = m[..., 1, 0] - m[..., 0, 1]
    k[..., 1, 1] = m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2]
    k[..., 2, 2] = m[..., 1, 1] - m[..., 0, 0] - m[..., 2, 2]
    k[..., 3, 3] = m[..., 2, 2] - m[..., 0, 0] - m[..., 1, 1]
    k[..., 1, 2] = k[..., 2, 1] = m[..., 0, 1] + m[..., 1, 0]
    k[..., 1, 3] = k[..., 3, 1] = m[..., 0, 2] + m[..., 2, 0]
    k[..., 2, 3] = k[..., 3, 2] = m[..., 1, 2] + m[..., 2, 1]
    _, vectors = np.linalg.eigh(k)
    quat = vectors[..., :, -1]
    return quat * np.where(quat[..., :1] < 0, -1.0, 1.0)


def matrix_from_quat(quat_wxyz: np.ndarray) -> np.ndarray:
    """Normalize quaternions wxyz (..., 4) and convert them to rotation matrices (..., 3, 3)."""
    q = np.asarray(quat_wxyz, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rigid(rotation: np.ndarray | None = None, translation: np.ndarray | None = None) -> np.ndarray:
    """Compose a rigid transform (4, 4) from a rotation (3, 3) and a translation (3,); None is the identity."""
    out = np.eye(4)
    if rotation is not None:
        out[:3, :3] = rotation
    if translation is not None:
        out[:3, 3] = translation
    return out


def invert_rigid(b_from_a: np.ndarray) -> np.ndarray:
    """Invert rigid transforms (..., 4, 4) by transposing the rotation."""
    m = np.asarray(b_from_a, dtype=np.float64)
    out = np.zeros_like(m)
    rotation_t = np.swapaxes(m[..., :3, :3], -1, -2)
    out[..., :3, :3] = rotation_t
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation_t, m[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def transform_points(b_from_a: np.ndarray, points_a: np.ndarray) -> np.ndarray:
    """Apply a rigid or similarity transform (4, 4) to points (n, 3)."""
    m = np.asarray(b_from_a, dtype=np.float64)
    return np.asarray(points_a, dtype=np.float64) @ m[:3, :3].T + m[:3, 3]


def umeyama(points_a: np.ndarray, points_b: np.ndarray, with_scale: bool = True) -> np.ndarray:
    """Estimate the least-squares similarity between paired points (n, 3) (Umeyama 1991).

    Returns:
        `b_from_a` (4, 4) with the scale in the 3x3 block; the scale is 1 without `with_scale`.
    """
    a, b = np.asarray(points_a, np.float64), np.asarray(points_b, np.float64)
    mean_a, mean_b = a.mean(0), b.mean(0)
    u, s, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a) / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    variance = ((a - mean_a) ** 2).sum() / len(a)
    scale = float((s * sign).sum() / variance) if with_scale and variance > 0 else 1.0
    return rigid(scale * rotation, mean_b - scale * rotation @ mean_a)


def split_similarity(b_from_a: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Split a similarity (4, 4) into scale, rotation (3, 3) and translation (3,)."""
    m = np.asarray(b_from_a, dtype=np.float64)
    scale = float(np.cbrt(np.linalg.det(m[:3, :3])))
    return scale, m[:3, :3] / scale, m[:3, 3]
