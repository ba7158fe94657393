"""Convert video of high dynamic range (HLG, PQ) to the sRGB picture that a standard display shows.

Transfer functions of ITU-R BT.2100 give displayed light; 203 cd/m2, the white of standard video (BT.2408), becomes
white. Whatever is brighter is clipped, as in a standard film. libswscale does the same (the tests compare), but spends
five seconds on a table for every size of picture.
"""

from functools import lru_cache

import cv2
import numpy as np

PQ, HLG = 16, 18  # transfer characteristics of H.273
_WHITE_NITS = 203.0
_HLG_PEAK_NITS, _HLG_GAMMA = 1000.0, 1.2  # the reference display of BT.2100
_BT709_FROM_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)  # BT.2087
_BT2020_LUMA = np.array([[0.2627, 0.6780, 0.0593]], np.float32)
_CURVE_STEPS = 4096  # of the sRGB curve, below half a level of 8 bits


def to_standard_range(signal: np.ndarray, transfer: int) -> np.ndarray:
    """Convert BT.2020 R'G'B' uint16 (h, w, 3) of the `transfer` characteristic PQ or HLG to sRGB uint8 (h, w, 3)."""
    linear = _linear_table(transfer)[signal]
    if transfer == HLG:
        # OOTF: scene light to displayed light.
        luminance = cv2.transform(linear, _BT2020_LUMA).reshape(*linear.shape[:2], 1)
        linear *= luminance ** (_HLG_GAMMA - 1) * (_HLG_PEAK_NITS / _WHITE_NITS)
    linear = cv2.transform(linear, _BT709_FROM_BT2020)
    # The square root spreads the steps evenly over what is seen.
    steps = np.sqrt(np.clip(linear, 0, 1)) * (_CURVE_STEPS - 1)
    return _srgb_table()[np.rint(steps).astype(np.int32)]


@lru_cache(maxsize=2)
def _linear_table(transfer: int) -> np.ndarray:
    """Return linear light float32 (65536,): relative to white for PQ, of the scene (0 to 1) for HLG."""
    value = np.arange(65536) / 65535.0
    if transfer == PQ:
        root = value ** (32 / 2523)
        light = np.maximum(root - 3424 / 4096, 0) / (2413 / 128 - 2392 / 128 * root)
        return (10000 / _WHITE_NITS * light ** (16384 / 2610)).astype(np.float32)
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(value <= 0.5, value**2 / 3, (np.exp((value - c) / a) + b) / 12).astype(np.float32)


@lru_cache(maxsize=1)
def _srgb_table() -> np.ndarray:
    """Return sRGB values uint8 by the square root of linear light."""
    linear = np.linspace(0, 1, _CURVE_STEPS) ** 2
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * curve).astype(np.uint8)
