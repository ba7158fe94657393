"""How colors of things are compared."""

import numpy as np

# Of CIELAB: shading changes lightness within one thing; two things mostly differ in hue or strongly in lightness.
LIGHTNESS_WEIGHT = np.array([0.5, 1.0, 1.0], np.float32)
