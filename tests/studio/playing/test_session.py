"""Physics that a person plays with: falls, drags, pushes, and the way back."""

import numpy as np
import pytest
from made_scenes import BOX, CYLINDER, TABLE, TABLE_TOP_M

from registry.errors import UsageError
from registry.geometry import matrix_from_quat, rigid
from registry.simulation import TIMESTEP_S, specs_from_bundle
from studio.playing.session import PhysicsSession

G = 9.81


@pytest.fixture(scope="module")
def specs(play_registry):
    return specs_from_bundle(play_registry.load("room"))


@pytest.fixture
def session(specs):
    return PhysicsSession(specs)


def test_a_scene_at_rest_sends_nothing(session):
    session.wake()
    session.advance(2.0)
    session.changes()
    assert session.at_rest
    for _ in range(30):
        session.advance(1 / 30)
        assert session.changes() == {}


def test_a_dropped_thing_falls_freely_then_rests_on_the_table(session):
    before = session.pose(BOX)
    session.lift(BOX, 0.2)
    session.advance(0.15)
    fallen = before[2] + 0.2 - session.pose(BOX)[2]
    assert fallen == pytest.approx(0.5 * G * 0.15**2, abs=2 * G * 0.15 * TIMESTEP_S)
    session.advance(2.0)
    assert session.at_rest
    assert session.pose(BOX)[2] == pytest.approx(TABLE_TOP_M, abs=2e-3)


def test_only_what_moves_is_reported(session):
    session.wake()
    session.advance(2.0)
    session.changes()
    session.lift(CYLINDER, 0.1)
    reported = set()
    for _ in range(60):
        session.advance(1 / 30)
        reported |= set(session.changes())
    assert reported == {CYLINDER}


def test_the_last_report_of_a_body_is_where_it_rests(session):
    shown = {key: session.pose(key) for key in session.movable}
    session.lift(BOX, 0.2)
    while not session.at_rest:
        session.advance(1 / 30)
        shown |= session.changes()
    shown |= session.changes()
    assert all(shown[key][:3] == pytest.approx(session.pose(key)[:3], abs=1e-5) for key in session.movable)


def test_a_dragged_thing_follows_the_pointer(session):
    point = session.pose(BOX)[:3] + np.array([0.0, 0.0, 0.06])
    session.grab("me", BOX, point)
    local = np.array([0.0, 0.0, 0.06])
    target = point
    for step in range(60):  # 0.3 m/s up and to the side, in 1 s; then wait
        target = point + min(step / 30, 1.0) * np.array([0.15, -0.1, 0.25])
        session.drag("me", target)
        session.advance(1 / 30)
    pose = session.pose(BOX).astype(np.float64)
    held = matrix_from_quat(pose[3:]) @ local + pose[:3]
    assert np.linalg.norm(held - target) < 0.01
    session.release("me")
    session.advance(2.0)
    assert session.at_rest
    assert session.pose(BOX)[2] < pose[2] - 0.1


def test_a_thing_is_not_dragged_through_the_table(session):
    session.grab("me", BOX, session.pose(BOX)[:3])
    session.drag("me", session.pose(BOX)[:3] - [0.0, 0.0, 0.4])
    session.advance(1.0)
    assert session.pose(BOX)[2] > TABLE_TOP_M - 0.005


def test_a_push_gives_the_speed_that_was_asked_for(session):
    pose = session.pose(BOX)
    center = pose[:3] + np.array([0.0, 0.0, 0.045])
    session.push(BOX, center, np.array([0.0, 0.0, 2.0]), 1.0)  # straight up, through the centre
    highest = 0.0
    for _ in range(48):
        session.step()
        highest = max(highest, float(session.pose(BOX)[2] - pose[2]))
    assert highest == pytest.approx(1.0**2 / (2 * G), abs=1.0 * TIMESTEP_S)


def test_reset_restores_every_pose_to_the_bit(session):
    before = {key: session.pose(key) for key in session.movable}
    for key in session.movable:
        session.lift(key, 0.3)
    session.grab("me", BOX, session.pose(BOX)[:3])
    session.advance(0.7)
    assert not np.array_equal(session.pose(BOX), before[BOX])
    session.reset()
    assert session.at_rest
    assert session.time_s == 0.0
    assert all(np.array_equal(session.pose(key), pose) for key, pose in before.items())
    session.advance(0.5)
    assert all(session.pose(key)[:3] == pytest.approx(pose[:3], abs=1e-3) for key, pose in before.items())


def test_furniture_cannot_be_grabbed_pushed_or_lifted(session):
    for act in (
        lambda: session.grab("me", TABLE, np.zeros(3)),
        lambda: session.push(TABLE, np.zeros(3), np.ones(3), 1.0),
        lambda: session.lift(TABLE, 0.1),
    ):
        with pytest.raises(UsageError, match=f"table {TABLE} does not move"):
            act()


def test_a_thing_that_leaves_the_scene_returns(session):
    before = session.pose(BOX)
    session.place(BOX, rigid(np.eye(3), np.array([0.0, 0.0, -1.0])))
    session.advance(3.0)
    assert session.pose(BOX)[:3] == pytest.approx(before[:3], abs=2e-3)


def test_what_loses_its_support_falls(specs):
    session = PhysicsSession(specs, {TABLE: rigid(np.eye(3), np.array([5.0, 5.0, 0.0]))})
    session.wake()
    session.advance(2.0)
    assert session.pose(BOX)[2] < 0.1
