"""The focal length that fundamental matrices vote for."""

import cv2
import numpy as np
import pycolmap
import pytest

from reconstruction.poses.focal_length import estimate_focal_length
from reconstruction.poses.pairs import VerifiedPair

SIZE = (640, 480)


def pairs_of(focal_px: float, count: int, wrong: float = 0.0) -> list[VerifiedPair]:
    """Return pairs of cameras that walk and turn; a share of them has a fundamental matrix of nothing."""
    rng = np.random.default_rng(int(focal_px))
    k = np.array([[focal_px, 0, SIZE[0] / 2], [0, focal_px, SIZE[1] / 2], [0, 0, 1]])
    out = []
    for number in range(count):
        turn = cv2.Rodrigues(rng.normal(0, 0.1, 3))[0]
        x, y, z = rng.normal(0, 0.2, 3)
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        matrix = np.linalg.inv(k).T @ across @ turn @ np.linalg.inv(k)
        if number < wrong * count:
            u, s, v = np.linalg.svd(rng.normal(size=(3, 3)))
            matrix = u @ np.diag([s[0], s[1], 0]) @ v
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED.value
        geometry.F = matrix / np.linalg.norm(matrix)
        out.append(VerifiedPair((number, number + 1), np.zeros((0, 2), np.uint32), geometry))
    return out


@pytest.mark.unit
@pytest.mark.parametrize("share", [0.47, 0.77, 0.94, 1.6])
def test_most_pairs_decide(share):
    found = estimate_focal_length(pairs_of(share * 640, 60, wrong=0.4), *SIZE)
    assert found == pytest.approx(share * 640, rel=0.02)


@pytest.mark.unit
def test_few_pairs_and_planes_tell_nothing():
    pairs = pairs_of(500, 30)
    assert estimate_focal_length(pairs[:5], *SIZE) is None
    for pair in pairs:
        pair.geometry.config = pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC.value
    assert estimate_focal_length(pairs, *SIZE) is None
