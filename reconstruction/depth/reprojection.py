"""Compiled reprojection of one pixel into another view, shared by the kernels that compare depth maps."""

import numba


@numba.njit(cache=True, nogil=True, inline="always")
def reproject(m, k, xn, yn, z):  # pragma: no cover - compiled
    """Return depth and pixel coordinates (u, v), in a neighbor, of a pixel's point; u = v = -1 behind the camera.

    Args:
        m: (4, 4) neighbor_from_view.
        k: fx, fy, cx, cy of both views, pixels.
        xn: Normalized image coordinate (x - cx) / fx of the pixel.
        yn: (y - cy) / fy.
        z: z-depth of the pixel, in the units of `m`.
    """
    there = z * (m[2, 0] * xn + m[2, 1] * yn + m[2, 2]) + m[2, 3]
    if there <= 1e-9:
        return there, -1.0, -1.0
    u = k[0] * (z * (m[0, 0] * xn + m[0, 1] * yn + m[0, 2]) + m[0, 3]) / there + k[2]
    v = k[1] * (z * (m[1, 0] * xn + m[1, 1] * yn + m[1, 2]) + m[1, 3]) / there + k[3]
    return there, u, v
