"""What is left to see of things that were half seen: their closed shape, and views of it."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
import avo_room as room

from reconstruction.views import AvoConfig, make_target
from reconstruction.views.cameras import look_at, square_camera
from reconstruction.views.closure import close_shape
from reconstruction.views.coverage import Coverage, Unseen

CAMERA = square_camera(64, 50.0)
FRONT, BEHIND = (room.BOX_CENTER + np.array([0.0, side * 0.9, 0.4]) for side in (-1, 1))


@pytest.fixture(scope="module")
def half():
    """The open room, in which of the box only front and top were seen; nobody looked behind them."""
    scene = room.room(with_panel=False)
    low, high = room.BOX_CENTER - 0.5 * room.BOX_SIDE, room.BOX_CENTER + 0.5 * room.BOX_SIDE
    means = scene.packed[:, :3]
    seen = (scene.instance != room.BOX) | (means[:, 1] < low[1] + 0.01) | (means[:, 2] > high[2] - 0.01)
    state = scene.space.state.copy()
    centers = scene.space.origin + (np.stack(np.indices(state.shape), -1) + 0.5) * room.CELL
    state[((centers > low) & (centers < high + 0.5 * room.CELL)).all(axis=-1)] = 0
    space = replace(scene.space, state=state)
    kept = {name: getattr(scene, name)[seen] for name in ("packed", "instance", "points", "point_instance")}
    return replace(scene, **kept, space=space)


def closed(scene, *ids):
    return close_shape(scene, make_target(scene, ids or (room.BOX,), AvoConfig()))


def sees(shape, eye, toward=room.BOX_CENTER):
    return shape.seen(look_at(eye, toward, 80.0)[None], CAMERA)[0] > 0.0


def test_what_is_seen_askew_waits_for_a_better_view(half):
    shape = closed(half)
    back = shape.normals[:, 1] > 0.99
    squarely, askew = (
        shape.seen(look_at(room.BOX_CENTER + np.array(away), room.BOX_CENTER, 80.0)[None], CAMERA)[0][back]
        for away in ([0.0, 0.9, 0.0], [0.9, 0.35, 0.0])
    )
    assert squarely.mean() > 0.9
    assert 0.1 < askew[askew > 0].mean() < 0.7


def test_a_gap_beside_a_neighbor_stays_open(half):
    """A wall stands 5 cm behind the box, nearer than a cell of the scene's grid: from above one sees past it."""
    back = room.BOX_CENTER[1] + 0.5 * room.BOX_SIDE + 0.05
    wall = room.plate([0, back, 0.15], [0.3, 0, 0], [0, 0, 0.15], [0, -1, 0], [0.5, 0.5, 0.5])
    wall[:, 7:9] += np.log(1.5)  # without holes
    scene = replace(
        half,
        packed=np.concatenate([half.packed, wall]),
        instance=np.append(half.instance, np.zeros(len(wall), int)),
    )
    above = room.BOX_CENTER + np.array([0.0, 0.4, 0.9])
    upper = {}
    for name, one in (("open", half), ("walled", scene)):
        shape = closed(one)
        back = (shape.normals[:, 1] > 0.9) & (shape.points[:, 2] > 0.27)
        upper[name] = sees(shape, above)[back].mean()
    assert upper["open"] > 0.9
    assert upper["walled"] > 0.5
    low = (closed(scene).normals[:, 1] > 0.9) & (closed(scene).points[:, 2] < 0.2)
    assert not sees(closed(scene), BEHIND)[low].any()


def test_a_half_seen_box_is_closed(half):
    shape = closed(half)
    assert shape.solid.sum() * shape.cell_m**3 == pytest.approx(room.BOX_SIDE**3, rel=0.15)
    assert np.abs(np.linalg.norm(shape.normals, axis=1) - 1).max() < 1e-6
    assert shape.areas.sum() == pytest.approx(1.0)


def test_its_back_is_seen_from_behind_alone(half):
    shape = closed(half)
    back = shape.normals[:, 1] > 0.9
    assert shape.areas[back].sum() == pytest.approx(1 / 6, abs=0.06)
    from_front, from_behind = sees(shape, FRONT), sees(shape, BEHIND)
    assert not from_front[back].any()
    assert from_behind[back].mean() > 0.9
    under = shape.normals[:, 2] < -0.9
    assert not (from_front | from_behind)[under].any()
    assert not sees(shape, BEHIND, toward=BEHIND + np.array([0.0, 1.0, 0.0])).any()  # it looks away


def test_what_stands_before_it_hides_it():
    hidden, free = (closed(room.room(with_panel=panel)) for panel in (True, False))
    low = np.array([0.0, -1.2, 0.1])
    assert sees(hidden, low).sum() < 0.5 * sees(free, low).sum()
    assert sees(hidden, BEHIND).sum() > 0.8 * sees(free, BEHIND).sum()


def test_space_that_rays_passed_through_is_not_filled(half):
    state = half.space.state.copy()
    centers = half.space.origin + (np.stack(np.indices(state.shape), -1) + 0.5) * room.CELL
    looked = (centers[..., 1] > room.BOX_CENTER[1] + 0.05) & (centers[..., 2] < 0.2)
    state[looked & (state == 0)] = 1
    shape = closed(replace(half, space=replace(half.space, state=state)))
    assert shape.solid.sum() * shape.cell_m**3 < 0.8 * room.BOX_SIDE**3


def test_things_of_a_region_are_closed_one_by_one(half):
    both = closed(half, room.BOX, room.BALL)
    between = both.origin + (np.stack(np.indices(both.solid.shape), -1) + 0.5) * both.cell_m
    gap = (between[..., 0] > 0.25) & (between[..., 0] < 0.55)
    assert gap.any()
    assert not both.solid[gap].any()
    assert both.solid[between[..., 0] > 0.6].any()


def test_a_flat_thing_is_what_was_seen_of_it():
    scene = room.room()
    shape = closed(scene, room.PANEL)
    assert shape.solid.sum() > 50
    assert sees(shape, np.array([0.0, -1.2, 0.3]), np.array([0.0, room.PANEL_Y, 0.1])).any()


def test_the_unseen_half_is_left_when_all_gaussians_were_shown():
    most = np.full((2, 4), 10.0)
    coverage = Coverage(np.ones(4), most, 0.5)
    sights = np.array([[1.0] * 3 + [0.0] * 3, [0.0] * 3 + [1.0] * 2 + [0.0]])
    start = Unseen.of(coverage, np.full(6, 1 / 6), sights)
    assert start.remaining == pytest.approx(1.0)
    front = start.after(most, sights[0])
    assert front.coverage.remaining == pytest.approx(0.0)
    assert front.remaining == pytest.approx(0.4 * 2 / 5)  # what no start sees does not count
    assert front.gain(0 * most, sights[1]) == pytest.approx(front.remaining)
    scores = start.worth_of(np.stack([most, 0.5 * most]), sights)
    assert scores[0] == pytest.approx(1.0)
    assert 0.0 < scores[1] < 1.0


def test_views_are_revised_where_others_show_more_together():
    shown = np.zeros((3, 2, 6))
    for row, seen in enumerate(([0, 1, 2, 3], [0, 1, 4], [2, 3, 5])):
        shown[row, 0, seen] = 10.0
    sights = np.zeros((3, 2))
    start = Unseen.of(Coverage(np.ones(6), shown.max(axis=0), 0.5), np.full(2, 0.5), sights)
    assert np.argmax(start.worth_of(shown, sights)) == 0
    assert sorted(start.revised([0, 1], shown, sights)) == [1, 2]
    assert start.revised([1, 2], shown, sights) == [1, 2]
