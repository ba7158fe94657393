"""Noise in the last bits of depth maps, to measure the spread of figures between equal runs."""

import numpy as np

SHARE = 1e-6  # relative; the last bits of a float32 are about 1e-7


def perturbed(depth: np.ndarray, seed: int) -> np.ndarray:
    """Return float32 depth maps (n, h, w) times uniform noise of 1 ± 1e-6, drawn by the seed; 0 stays unknown."""
    generator = np.random.default_rng(seed)
    out = np.empty(depth.shape, np.float32)
    for own, changed in zip(depth, out):
        changed[...] = own * (1.0 + generator.uniform(-SHARE, SHARE, own.shape))
    return out
