"""Grasps across an object, at its neck and at its wall; none without clearance."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from simrecon_envs.grasps import Grasp, find_grasps
from simrecon_envs.hovering import most_room
from simrecon_envs.kept_grasps import KeptGrasps
from simrecon_envs.occupancy import ConvexSolid, convex_solid
from simrecon_envs.robots import TRAITS

HAND = TRAITS["panda"].hand


def _box(owner: int, size: tuple, at: tuple) -> ConvexSolid:
    mesh = trimesh.creation.box(size).apply_translation([at[0], at[1], at[2] + size[2] / 2])
    return convex_solid(owner, "made", np.asarray(mesh.vertices))


def _cylinder(owner: int, radius: float, height: float, bottom: float) -> ConvexSolid:
    mesh = trimesh.creation.cylinder(radius, height, sections=32)
    mesh.apply_translation([0, 0, bottom + height / 2])
    return convex_solid(owner, "made", np.asarray(mesh.vertices))


def _grasps(solids: list[ConvexSolid], mass_kg: float = 0.3) -> list[Grasp]:
    cloud = np.concatenate([s.vertices for s in solids if s.owner == 1])
    center = (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    return find_grasps([_box(0, (2, 2, 0.1), (0, 0, -0.1)), *solids], 1, center, mass_kg, center, HAND)


def test_a_narrow_box_is_gripped_across_its_middle() -> None:
    best = _grasps([_box(1, (0.16, 0.05, 0.10), (0.02, 0.01, 0))])[0]
    assert best.yaw_rad == pytest.approx(np.pi / 2)
    assert best.width_m == pytest.approx(0.05, abs=0.006)
    np.testing.assert_allclose(best.offset[:2], 0, atol=0.008)
    assert best.opening_m <= HAND.opening_m


def test_a_vase_is_gripped_at_its_neck_and_a_plain_one_of_that_width_is_not() -> None:
    body = _cylinder(1, 0.05, 0.12, 0)
    best = _grasps([body, _cylinder(1, 0.02, 0.06, 0.12)])[0]
    assert best.width_m == pytest.approx(0.04, abs=0.008)
    assert best.offset[2] > 0.12 + 0.005 - 0.09  # above its body
    assert _grasps([body]) == []


def test_an_open_box_is_gripped_by_a_wall_with_a_finger_on_each_side() -> None:
    wide, high, thick = 0.20, 0.08, 0.008
    side = (wide - thick) / 2
    parts = [_box(1, (wide, wide, thick), (0, 0, 0))]
    parts += [_box(1, (thick, wide, high), (s * side, 0, 0)) for s in (-1, 1)]
    parts += [_box(1, (wide, thick, high), (0, s * side, 0)) for s in (-1, 1)]
    grasps = _grasps(parts)
    assert {round(g.yaw_rad, 3) for g in grasps} >= {0.0, round(np.pi / 2, 3)}
    for grasp in grasps:
        assert np.abs(grasp.offset[:2]).max() == pytest.approx(side, abs=0.012)
        assert grasp.width_m < 0.03
    assert _grasps(parts, mass_kg=3.0) == []  # the torque is too large
    assert _grasps([_box(1, (wide, wide, high), (0, 0, 0))]) == []  # a solid one has no wall


def test_fingers_and_palm_need_room() -> None:
    box = _box(1, (0.05, 0.05, 0.05), (0, 0, 0))
    assert _grasps([box])
    close = [
        _box(2, (0.05, 0.05, 0.05), (x, y, 0)) for x, y in ((0.06, 0), (-0.06, 0), (0, 0.06), (0, -0.06))
    ]
    assert _grasps([box, *close]) == []
    tall = _box(2, (0.05, 0.4, 0.30), (0.065, 0, 0))  # clearance for a finger along y only; none for the palm
    for grasp in _grasps([box, tall]):
        assert abs(np.cos(grasp.yaw_rad)) < 0.5
    assert _grasps([box, _box(2, (0.3, 0.3, 0.02), (0, 0, 0.10))]) == []  # under a shelf board


def test_a_closed_hand_turns_to_where_there_is_room_or_says_how_much_is_missing() -> None:
    tip = np.array([0.0, 0.0, 0.10])
    gate = [_box(2, (0.02, 0.4, 0.3), (x, 0, 0)) for x in (-0.06, 0.06)]  # 10 cm wide; the palm is 21 by 6 cm
    hover = most_room([_box(1, (0.05, 0.05, 0.05), (0, 0, 0)), *gate], tip, HAND)
    assert hover.yaw_rad == pytest.approx(np.pi / 2)
    assert hover.room_m == pytest.approx(0.05 - HAND.tip_below_m, abs=1e-6)
    shut = [*gate, *(_box(3, (0.4, 0.02, 0.3), (0, y, 0)) for y in (-0.06, 0.06))]
    assert most_room(shut, tip, HAND).room_m == pytest.approx(0.10 + HAND.palm_above_m - 0.3, abs=1e-6)


def test_grasps_are_searched_once_a_machine(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path))
    found = _grasps([_box(1, (0.16, 0.05, 0.10), (0.02, 0.01, 0))])
    first = KeptGrasps("a" * 16, HAND)
    first.of(1, lambda: found)
    first.of(2, list)
    first.save()

    again = KeptGrasps("a" * 16, HAND)

    kept = again.of(1, lambda: pytest.fail("searched again"))
    assert [(*g.offset, g.yaw_rad, g.width_m, g.opening_m, g.cost) for g in kept] == [
        (*g.offset, g.yaw_rad, g.width_m, g.opening_m, g.cost) for g in found
    ]
    assert again.of(2, lambda: pytest.fail("searched again")) == []
    assert KeptGrasps("b" * 16, HAND).of(1, list) == []  # another scene
    assert KeptGrasps("a" * 16, replace(HAND, opening_m=0.05)).of(1, list) == []  # another hand


@pytest.mark.parametrize("content", ["", "[1]", '{"1": [[0, 0]]}', '{"1": 3}', "\x00"])
def test_damaged_files_of_grasps_are_searched_anew(tmp_path, monkeypatch, content) -> None:
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path))
    first = KeptGrasps("a" * 16, HAND)
    first.of(1, list)
    first.save()
    (file,) = (tmp_path / "cache" / "grasps").iterdir()
    file.write_text(content)
    found = _grasps([_box(1, (0.16, 0.05, 0.10), (0.02, 0.01, 0))])

    kept = KeptGrasps("a" * 16, HAND)
    kept.of(1, lambda: found)
    kept.save()

    assert len(KeptGrasps("a" * 16, HAND).of(1, list)) == len(found) > 0


def test_a_user_without_a_home_searches_every_time(monkeypatch) -> None:
    monkeypatch.delenv("SIMRECON_HOME", raising=False)

    def no_home() -> None:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    found = _grasps([_box(1, (0.16, 0.05, 0.10), (0.02, 0.01, 0))])
    kept = KeptGrasps("a" * 16, HAND)

    assert len(kept.of(1, lambda: found)) == len(found) > 0
    kept.save()
    assert KeptGrasps("a" * 16, HAND).of(1, list) == []
