"""Look-alikes at two places, and videos that fall apart into several parts."""

from dataclasses import replace

import numpy as np
import pytest
from notes import Notes

from reconstruction.poses import PosesConfig, estimate_poses
from reconstruction.poses.components import label_parts, propose_bridges
from reconstruction.poses.consistency import reject_look_alikes
from reconstruction.poses.features import Features
from reconstruction.poses.pairs import VerifiedPair
from synthetic.camera_paths import handheld_path, phone_camera
from synthetic.film import film_room, prepare
from synthetic.procedural import RoomSpec, build_procedural_room

SIZE = (640, 480)
POINTS, PERIOD = 60, 20  # point k and point k + PERIOD look alike


def walk(frames: int = 10) -> list[Features]:
    """Every frame shows the same points in a row, a little shifted."""
    x = 10.0 * np.arange(POINTS)
    return [
        Features(
            np.stack([x + 3 * i, 240 + 0 * x], 1).astype(np.float32),
            np.ones(POINTS, np.float32),
            np.zeros((POINTS, 128), np.float32),
        )
        for i in range(frames)
    ]


def pair(i: int, j: int, shift: int = 0) -> VerifiedPair:
    """Match point k of frame i with point k + shift of frame j."""
    k = np.arange(POINTS - shift)
    return VerifiedPair((i, j), np.stack([k, k + shift], 1).astype(np.uint32), None)


def test_a_pair_that_joins_two_points_seen_side_by_side_is_rejected():
    near = [pair(i, i + 1) for i in range(9)]
    found = reject_look_alikes([*near, pair(0, 8), pair(0, 9, PERIOD)], walk(), 4, 20, SIZE)
    assert [p.rows for p in found.pairs] == [*(p.rows for p in near), (0, 8)]
    assert found.rejected == 1


def test_only_the_contradicted_matches_of_a_good_pair_go():
    matches = pair(0, 3).matches.copy()
    matches[:5, 1] += PERIOD
    mixed = VerifiedPair((0, 3), matches, None)
    found = reject_look_alikes([*(pair(i, i + 1) for i in range(3)), mixed], walk(4), 4, 20, SIZE)
    assert found.rejected == 0
    assert np.array_equal(found.pairs[-1].matches, matches[5:])


def test_among_many_look_alikes_a_loop_needs_support():
    chain = [pair(i, i + 1) for i in range(9) if i != 4]  # two halves that no near pair joins
    loop, wrong = pair(0, 9), [pair(i, i + 3, PERIOD) for i in range(2)]
    assert (0, 9) in [p.rows for p in reject_look_alikes([*chain, loop], walk(), 2, 20, SIZE).pairs]
    assert (0, 9) not in [
        p.rows for p in reject_look_alikes([*chain, *wrong, loop], walk(), 2, 20, SIZE).pairs
    ]


def test_parts_and_the_bridges_between_them():
    parts = label_parts(7, [pair(0, 1), pair(2, 3), pair(3, 4), pair(4, 5)])
    assert parts.tolist() == [1, 1, 0, 0, 0, 0, 2]
    parts = label_parts(7, [pair(0, 1), pair(1, 2), pair(3, 4), pair(4, 5), pair(5, 6)])
    scores = np.zeros((7, 7), int)
    scores[0, 6] = scores[6, 0] = 9
    scores[1, 5] = scores[5, 1] = 4
    assert propose_bridges(parts, scores, [(0, 6, True), (1, 5, False)]) == [(1, 5, True)]


@pytest.mark.end_to_end
def test_of_two_rooms_the_longer_part_is_kept_and_the_other_named(small_capture, tmp_path):
    like, images = small_capture.frame_set(), []
    for seed, count in ((1, 14), (2, 9)):
        film_set = prepare(build_procedural_room(RoomSpec(seed=seed, objects=8)), shadow_px=256)
        images.append(film_room(film_set, phone_camera(320, 240), handheld_path(count), seed=seed))
    images = np.concatenate(images)
    n, none = len(images), np.zeros(0, np.int32)
    frames = replace(
        like, images=images, indices=np.arange(n, dtype=np.int32), times_s=np.arange(n) / 2.0,
        sharpness=np.ones(n, np.float32), held_out_images=like.held_out_images[:0], held_out_indices=none,
        held_out_times_s=np.zeros(0),
    )  # fmt: skip

    report = Notes()
    posed = estimate_poses(frames, PosesConfig(), work_dir=tmp_path, progress=report)
    assert posed.indices.tolist() == list(range(14))
    told = [note for note in report.notes if "share no picture" in note]
    assert len(told) == 1
    assert "14-22" in told[0]
    assert "7.0-11.0 s" in told[0]
