"""Compiled kernels of the losses: values and gradients by the rendered image.

All loop over the image rows start..stop. Sums are kept per row and added by the caller, so that they do not depend on
the number of threads.
"""

import math

import numba
import numpy as np

from reconstruction.gaussians.kernels import F_ALPHA, F_DEPTH, F_DISTORTION, F_NORMAL

MIN_ALPHA = 0.2  # smallest opacity of pixels with depth and normal losses
EDGE = 0.05  # largest relative depth difference of the neighbors that span a normal


@numba.njit(cache=True, nogil=True)
def color_products(
    start, stop, features, gain, bias, target, color, squares, products
):  # pragma: no cover - compiled
    """Fill color = gain * rendered + bias, its square and its product with the target, all (h, w, 3)."""
    for y in range(start, stop):
        for x in range(color.shape[1]):
            for c in range(3):
                value = gain[c] * features[y, x, c] + bias[c]
                color[y, x, c] = value
                squares[y, x, c] = value * value
                products[y, x, c] = value * target[y, x, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def ssim_partials(
    start, stop, mean, mean_target, square, square_target, product, row_sum, d_mean, d_square, d_product
):  # pragma: no cover - compiled
    """Compute SSIM (Wang et al. 2004; K1 = 0.01, K2 = 0.03, range 1) from windowed moments (h, w, 3).

    Fills row_sum (h,) with the sum of SSIM, and its derivatives by mean, square and product (h, w, 3).
    """
    c1, c2 = 0.0001, 0.0009
    for y in range(start, stop):
        total = 0.0
        for x in range(mean.shape[1]):
            for c in range(3):
                a, b = float(mean[y, x, c]), float(mean_target[y, x, c])
                variance_a = float(square[y, x, c]) - a * a
                variance_b = float(square_target[y, x, c]) - b * b
                covariance = float(product[y, x, c]) - a * b
                a1, a2 = 2 * a * b + c1, 2 * covariance + c2
                b1, b2 = a * a + b * b + c1, variance_a + variance_b + c2
                inverse = 1.0 / (b1 * b2)
                s = a1 * a2 * inverse
                total += s
                by_covariance = 2 * a1 * inverse
                by_variance = -s / b2
                d_product[y, x, c] = by_covariance
                d_square[y, x, c] = by_variance
                d_mean[y, x, c] = (
                    2 * b * a2 * inverse - 2 * a * s / b1 - b * by_covariance - 2 * a * by_variance
                )
        row_sum[y] = total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def color_gradients(
    start, stop, features, color, target, gain, d_mean, d_square, d_product, l1_factor, ssim_factor, image_gradients,
    error, sums,
):  # fmt: skip  # pragma: no cover - compiled
    """Compute gradients of the L1 and SSIM losses by the rendered color.

    Takes features (h, w, 13), color = gain * rendered + bias and target (h, w, 3), gain (3,), the windowed derivatives
    of SSIM (h, w, 3), and the weights of the summed |color - target| and of the summed SSIM (negative: it is
    maximized). Fills image_gradients (h, w, 9), columns 0..2, error (h, w), the mean absolute difference, and
    sums (h, 7): |difference|, gradient by gain (3) and by bias (3).
    """
    for y in range(start, stop):
        for c in range(7):
            sums[y, c] = 0
        for x in range(color.shape[1]):
            total = 0.0
            for c in range(3):
                value, wanted = color[y, x, c], target[y, x, c]
                difference = value - wanted
                d = ssim_factor * (
                    d_mean[y, x, c] + 2 * value * d_square[y, x, c] + wanted * d_product[y, x, c]
                )
                if difference > 0:
                    d += l1_factor
                elif difference < 0:
                    d -= l1_factor
                total += abs(difference)
                sums[y, 1 + c] += d * features[y, x, c]
                sums[y, 4 + c] += d
                image_gradients[y, x, c] = d * gain[c]
            sums[y, 0] += total
            error[y, x] = total / 3


@numba.njit(cache=True, nogil=True, error_model="numpy")
def normal_partials(
    start, stop, features, rays, factor, d_axes, image_gradients, row_sum
):  # pragma: no cover - compiled
    """Compute normal consistency (2DGS eq. 14): alpha minus rendered normal dot normal of the rendered depth.

    Fills image_gradients[..., 4:7], row_sum (h,) with the loss, and d_axes (h, w, 6), the gradients by the two
    differences of neighboring points that span the surface at a pixel. alpha is treated as constant.
    """
    height, width = features.shape[0], features.shape[1]
    for y in range(start, stop):
        row_sum[y] = 0
        p = np.empty((4, 3))
        for x in range(width):
            for c in range(6):
                d_axes[y, x, c] = 0
            for c in range(3):
                image_gradients[y, x, F_NORMAL + c] = 0
            if y == 0 or x == 0 or y == height - 1 or x == width - 1 or features[y, x, F_ALPHA] < MIN_ALPHA:
                continue
            low, high, usable = 1e30, 0.0, True
            for k in range(4):
                yy = y + (k == 2) - (k == 3)
                xx = x + (k == 0) - (k == 1)
                alpha = features[yy, xx, F_ALPHA]
                if alpha < MIN_ALPHA:
                    usable = False
                    break
                z = features[yy, xx, F_DEPTH] / alpha
                low, high = min(low, z), max(high, z)
                for c in range(3):
                    p[k, c] = z * rays[yy, xx, c]
            if not usable or high - low > EDGE * low:
                continue
            ax, ay, az = p[0, 0] - p[1, 0], p[0, 1] - p[1, 1], p[0, 2] - p[1, 2]
            bx, by, bz = p[2, 0] - p[3, 0], p[2, 1] - p[3, 1], p[2, 2] - p[3, 2]
            # Down cross right points towards the camera.
            mx, my, mz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
            length = math.sqrt(mx * mx + my * my + mz * mz)
            if length < 1e-20:
                continue
            mx, my, mz = mx / length, my / length, mz / length
            nx, ny = features[y, x, F_NORMAL], features[y, x, F_NORMAL + 1]
            nz = features[y, x, F_NORMAL + 2]
            cosine = nx * mx + ny * my + nz * mz
            row_sum[y] += features[y, x, F_ALPHA] - cosine
            image_gradients[y, x, F_NORMAL] = -factor * mx
            image_gradients[y, x, F_NORMAL + 1] = -factor * my
            image_gradients[y, x, F_NORMAL + 2] = -factor * mz
            s = -factor / length
            gx, gy, gz = s * (nx - cosine * mx), s * (ny - cosine * my), s * (nz - cosine * mz)
            # m = b x a: dL/da = g x b, dL/db = a x g.
            d_axes[y, x, 0], d_axes[y, x, 1] = gy * bz - gz * by, gz * bx - gx * bz
            d_axes[y, x, 2], d_axes[y, x, 3] = gx * by - gy * bx, ay * gz - az * gy
            d_axes[y, x, 4], d_axes[y, x, 5] = az * gx - ax * gz, ax * gy - ay * gx


@numba.njit(cache=True, nogil=True, error_model="numpy")
def depth_gradients(
    start, stop, features, rays, target, weight, d_axes, scale, depth_factor, opacity_factor, distortion_factor,
    image_gradients, sums,
):  # fmt: skip  # pragma: no cover - compiled
    """Compute depth, opacity and distortion losses, and all gradients by depth, opacity and distortion.

    Takes features (h, w, 13), rays (h, w, 3), target depth and weight (h, w; 0 = unknown), d_axes (h, w, 6) of
    `normal_partials`, the scale s of the robust loss s log(1 + |e| / s), and the weights of the summed losses. Fills
    image_gradients (h, w, 9), columns 3, 7 and 8, and sums (h, 3): depth, opacity and distortion loss.
    """
    height, width = features.shape[0], features.shape[1]
    for y in range(start, stop):
        for c in range(3):
            sums[y, c] = 0
        for x in range(width):
            alpha = features[y, x, F_ALPHA]
            image_gradients[y, x, 8] = distortion_factor
            sums[y, 2] += features[y, x, F_DISTORTION]
            d_alpha, d_z = 0.0, 0.0
            if weight[y, x] > 0:
                d_alpha = -opacity_factor * weight[y, x]
                sums[y, 1] += weight[y, x] * (1.0 - alpha)
            if alpha >= MIN_ALPHA:
                z = features[y, x, F_DEPTH] / alpha
                if weight[y, x] > 0:
                    e = (z - target[y, x]) / target[y, x]
                    sums[y, 0] += weight[y, x] * scale * math.log1p(abs(e) / scale)
                    d = depth_factor * weight[y, x] / ((1.0 + abs(e) / scale) * target[y, x])
                    d_z += d if e > 0 else -d
                for c in range(3):
                    d = 0.0
                    if x > 0:
                        d += d_axes[y, x - 1, c]
                    if x < width - 1:
                        d -= d_axes[y, x + 1, c]
                    if y > 0:
                        d += d_axes[y - 1, x, 3 + c]
                    if y < height - 1:
                        d -= d_axes[y + 1, x, 3 + c]
                    d_z += d * rays[y, x, c]
                d_alpha -= d_z * z / alpha
                d_z /= alpha
            image_gradients[y, x, F_DEPTH] = d_z
            image_gradients[y, x, 7] = d_alpha
