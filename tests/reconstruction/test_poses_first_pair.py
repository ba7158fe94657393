"""The pair of frames that a model starts from."""

import cv2
import numpy as np
import pycolmap
import pytest

from reconstruction.poses.features import Features
from reconstruction.poses.first_pair import rank_starts
from reconstruction.poses.pairs import VerifiedPair, fit_homography

SIZE, FOCAL = (640, 480), 500.0
CAMERA = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, *SIZE)


def scene(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Return points (k, 3) before the camera: a room, somebody before a wall, or a room far away."""
    points = rng.uniform([-1.5, -1, 2], [1.5, 1, 5], (500 if kind == "wall" else 130, 3))
    if kind == "wall":
        points[:, 2] = 3 + 0.2 * points[:, 0]
        points[:150] = rng.uniform([-0.3, -0.6, 1.9], [0.0, 0.6, 2.1], (150, 3))
    return points * 20 if kind == "far" else points


def pairs_of(kinds: list[str]) -> tuple[list[Features], list[VerifiedPair]]:
    """Return one pair of frames for each kind of scene; .7 pixels of noise, a tenth of the matches wrong."""
    features, pairs = [], []
    for number, kind in enumerate(kinds):
        rng = np.random.default_rng(number)
        points = scene(kind, rng)
        turn = cv2.Rodrigues(np.array([0.02, 0.08, 0.01]))[0]
        for rotation, shift in ((np.eye(3), np.zeros(3)), (turn, np.array([0.3, 0.02, 0.05]))):
            walked = [-0.3, 0, -0.4] if kind == "wall" and len(features) % 2 else [0, 0, 0]
            moved = np.where(np.arange(len(points))[:, None] < 150, points + walked, points)
            pixels = moved @ rotation.T + shift
            pixels = FOCAL * pixels[:, :2] / pixels[:, 2:] + np.array(SIZE) / 2
            pixels += rng.normal(0, 0.7, pixels.shape)
            pixels[::10] += rng.normal(0, 30, (len(pixels[::10]), 2)) * (len(features) % 2)
            none = np.zeros(len(pixels), np.float32)
            features.append(
                Features(pixels.astype(np.float32), none, np.zeros((len(pixels), 128), np.float32))
            )
        same = np.tile(np.arange(len(points), dtype=np.uint32)[:, None], (1, 2))
        pairs.append(VerifiedPair((2 * number, 2 * number + 1), same, pycolmap.TwoViewGeometry()))
    return features, pairs


@pytest.mark.unit
def test_a_room_comes_before_somebody_who_walks_by_a_wall():
    kinds = ["wall", "room", "wall", "room", "wall"]
    features, pairs = pairs_of(kinds)
    off = [int((~fit_homography(features, pair)[1]).sum()) for pair in pairs]
    assert min(off[0], off[2], off[4]) > max(off[1], off[3])
    ranked = rank_starts(features, pairs, CAMERA, 0)
    assert [kinds[a // 2] for a, _ in ranked[:2]] == ["room", "room"]


@pytest.mark.unit
def test_far_points_start_no_model():
    assert rank_starts(*pairs_of(["far", "far"]), CAMERA, 0) == []


@pytest.mark.unit
def test_the_same_order_twice():
    features, pairs = pairs_of(["room", "wall", "room", "room"])
    assert rank_starts(features, pairs, CAMERA, 0) == rank_starts(features, pairs[::-1], CAMERA, 0)
