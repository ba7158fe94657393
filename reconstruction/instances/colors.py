"""Weights of the color distance between surface points."""

import numpy as np

# Of L, a, b. Shading changes the lightness within one object; two objects mostly differ in hue, or much in lightness.
LIGHTNESS_WEIGHT = np.array([0.5, 1.0, 1.0], np.float32)
