"""Correlation of a slanted window with another view: the inner loop of refinement and of edge placement.

A window is a list of offsets from its pixel. Over it the projection into a source is a ratio of affine functions, so
that a sample costs one division; the loop over samples is free of branches, which lets it run on vector units. The
order of its sums is the compiler's choice (`FAST`): it depends on the machine, never on threads or on the run.
"""

import numba
import numpy as np

from reconstruction.depth.vector_memory import load_two

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""What the compiler may assume of float arithmetic in loops that are to be vectorized; nan and inf keep their sense."""


def offsets(radius: int, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the x and y offsets (samples,) float32 of a square window, row by row."""
    line = np.arange(-radius, radius + 1, stride, dtype=np.float32)
    y, x = np.meshgrid(line, line, indexing="ij")
    return np.ascontiguousarray(x.ravel()), np.ascontiguousarray(y.ravel())


def fill_vectors(values: np.ndarray) -> np.ndarray:
    """Return values of samples (n,) with zeros after them, so that vector units of 16 numbers work on all at once."""
    return np.pad(values, (0, -len(values) % 16))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def source_maps(h_inf, shift):  # pragma: no cover - compiled
    """Return (s, 12) float32: room for where a pixel is at infinity, then its change by x, y and inverse depth."""
    maps = np.zeros((h_inf.shape[0], 12), np.float32)
    for k in range(h_inf.shape[0]):
        for a in range(3):
            maps[k, 3 + a], maps[k, 6 + a], maps[k, 9 + a] = h_inf[k, a, 0], h_inf[k, a, 1], shift[k, a]
    return maps


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project(h_inf, y, x, maps):  # pragma: no cover - compiled
    """Write to `maps`, for each source, where pixel (y, x) would be if it were infinitely far away."""
    for k in range(h_inf.shape[0]):
        for a in range(3):
            maps[k, a] = h_inf[k, a, 0] * (x + 0.5) + h_inf[k, a, 1] * (y + 0.5) + h_inf[k, a, 2]


def make_correlate(samples: int):
    """Compile the correlation for windows of so many samples: a loop of known length runs on vector units."""

    # Inlined for good: a copy of its own and one inside the caller would be optimized, and round, differently, and
    # which of them runs would depend on whether this process compiled them or found them compiled.
    @numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
    def correlate(
        weight, centered, variance, source, height, width, m, rho, gx, gy, zero, dx, dy
    ):  # pragma: no cover - compiled
        """Return the weighted correlation of a slanted window with a source; -2 where that does not see its pixel.

        Args:
            weight: float32 (samples,) that sum to 1.
            centered: float32 (samples,) weight times what the reference's gray levels differ from their mean.
            variance: Weighted variance of the reference's gray levels, noise floor included.
            source: float32 (height * width,) gray levels.
            height: Of the source.
            width: Of the source.
            m: (12,) a row of `source_maps` after `project`.
            rho: Inverse depth of the pixel.
            gx: Its slope along x.
            gy: Its slope along y.
            zero: Noise variance.
            dx: float32 (samples,) offsets along x.
            dy: float32 (samples,) offsets along y.
        """
        top_u, top_v = np.float32(width - 1.01), np.float32(height - 1.01)
        one, half, nil = np.float32(1.0), np.float32(0.5), np.float32(0.0)
        tx, ty, tz = m[9], m[10], m[11]
        u0, v0, z0 = m[0] + rho * tx, m[1] + rho * ty, m[2] + rho * tz
        if z0 <= np.float32(1e-9):
            return np.float32(-2.0)
        u, v = u0 / z0 - half, v0 / z0 - half
        if not (u >= nil and v >= nil and u < top_u and v < top_v):
            return np.float32(-2.0)
        ux, vx, zx = m[3] + gx * tx, m[4] + gx * ty, m[5] + gx * tz
        uy, vy, zy = m[6] + gy * tx, m[7] + gy * ty, m[8] + gy * tz
        stride = np.int32(width)
        sb, sbb, sab = nil, nil, nil
        for n in range(samples):
            inv = one / (z0 + dx[n] * zx + dy[n] * zy)
            # Comparisons in this order also catch what is not a number.
            u = min(max(nil, (u0 + dx[n] * ux + dy[n] * uy) * inv - half), top_u)
            v = min(max(nil, (v0 + dx[n] * vx + dy[n] * vy) * inv - half), top_v)
            ix, iy = np.int32(u), np.int32(v)
            fx, fy = u - np.float32(ix), v - np.float32(iy)
            p = np.uint32(iy * stride + ix)
            a, b = load_two(source, p)  # pyright: ignore[reportCallIssue]
            c, d = load_two(source, p + np.uint32(width))  # pyright: ignore[reportCallIssue]
            top = a + fx * (b - a)
            low = c + fx * (d - c)
            g = top + fy * (low - top)
            sb += weight[n] * g
            sbb += weight[n] * g * g
            sab += centered[n] * g
        return sab / np.sqrt(variance * (max(sbb - sb * sb, nil) + zero))

    return correlate
