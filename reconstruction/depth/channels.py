"""Numbers of channels that the depth stage's networks read and say, and what they stand for."""

PLANES, BINS = 96, 48
"""Planes of the sweeps that the aggregation network is trained on, and bins of inverse depth that it reads."""
FEATURES = 13
"""Channels that the mending network reads (`mending.mending_features`)."""
OFFSETS_PX = (1, 4, 12)
"""Distances at which the mending network says whether two pixels are of one thing, to the right and downwards."""
AFFINITIES = 2 * len(OFFSETS_PX)
