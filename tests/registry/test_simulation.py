"""Physics report card on cases with analytically known results."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from registry.errors import BundleError, SimReconError
from registry.geometry import rigid
from registry.report_card import failures, physics_report, spawn_contacts
from registry.simulation import BodySpec, build_physics, pose_change, specs_from_bundle


def corners(x: float, y: float, z: float) -> np.ndarray:
    """A box with its bottom center at the origin."""
    return np.array([[i * x / 2, j * y / 2, k * z] for i in (-1, 1) for j in (-1, 1) for k in (0, 1)])


def body(number: int, points: np.ndarray, position, **options) -> BodySpec:
    values = dict(
        mass_kg=0.5, center_of_mass=points.mean(0), inertia=None, friction=0.5, restitution=0.0, dynamic=True
    )
    pose = rigid(None, np.asarray(position, float))
    return BodySpec(number, f"body_{number}", (points,), world_from_object=pose, **(values | options))


FLOOR = body(1, corners(8, 8, 0.2) - [0, 0, 0.2], (0, 0, 0), dynamic=False, base=True)
CUBE = corners(0.2, 0.2, 0.1)


def test_stack_at_rest_is_stable_and_touches_nothing_else():
    report = physics_report([FLOOR, *(body(2 + k, CUBE, (0, 0, 0.1 * k)) for k in range(3))])
    assert report["stable_rate"] == 1.0
    assert report["floating_rate"] == 0.0
    assert report["spawn_penetration_mm"] < 0.01
    assert report["dynamic_objects"] == 3
    assert max(o["moved_m"] for o in report["objects"]) < 1e-4
    json.dumps(report, allow_nan=False)


def test_object_in_the_air_floats_and_lands():
    report = physics_report([FLOOR, body(2, CUBE, (0, 0, 0.06)), body(3, CUBE, (1, 0, 0))], duration_s=2)
    floating = report["objects"][0]
    assert report["floating_rate"] == 0.5
    assert floating["drop_m"] == pytest.approx(0.06, abs=1e-3)
    assert not floating["stable"]
    assert floating["stable_10cm_0.1rad"]  # the looser threshold accepts 6 cm
    assert not floating["stable_5cm_drop_5deg"]


def test_spawn_penetration_counts_static_dynamic_and_fixed_pairs():
    sunk = body(2, CUBE, (0, 0, -0.004))
    overlapping = [body(3, CUBE, (1, 0, 0)), body(4, CUBE, (1.193, 0, 0))]
    fixed = body(5, CUBE, (2, 0, -0.012), dynamic=False)
    assert physics_report([FLOOR, sunk], duration_s=1)["spawn_penetration_mm"] == pytest.approx(4, abs=0.1)
    report = physics_report([FLOOR, *overlapping], duration_s=1)
    assert report["spawn_penetration_mm"] == pytest.approx(7, abs=0.1)
    report = physics_report([FLOOR, sunk, *overlapping, fixed], duration_s=1)
    assert report["spawn_penetration_mm"] == pytest.approx(12, abs=0.1)
    assert sorted(report["spawn_penetration_between"]) == ["body_1", "body_5"]


def test_contact_normal_points_from_second_to_first():
    contact = min(spawn_contacts([FLOOR, body(2, CUBE, (0, 0, -0.004))]), key=lambda c: c.separation_m)
    upwards = 1.0 if contact.first == 2 else -1.0
    assert contact.normal[2] * upwards == pytest.approx(1.0, abs=1e-3)


def test_friction_decides_whether_a_block_slides():
    angle = np.radians(20)  # tan = 0.36
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    ramp = replace(FLOOR, world_from_object=rigid(turn))
    for friction, stays in ((0.6, True), (0.1, False)):
        # PhysX averages the two materials.
        block = replace(
            body(2, corners(0.2, 0.2, 0.04), (0, 0, 0), friction=friction), world_from_object=rigid(turn)
        )
        report = physics_report([replace(ramp, friction=friction), block], duration_s=2)
        assert bool(report["objects"][0]["stable"]) is stays


def test_nothing_damps_a_flying_body():
    physics = build_physics([body(2, CUBE, (0, 0, 0))])
    physics.step(240)
    # Semi-implicit Euler falls g t (t + dt) / 2.
    assert -physics.pose(2)[2, 3] == pytest.approx(9.81 * (1 + 1 / 240) / 2, rel=1e-3)


def test_fixed_child_follows_its_dynamic_parent():
    parent = body(2, CUBE, (0, 0, 0.3))
    child = body(3, corners(0.05, 0.05, 0.05), (0.2, 0, 0.35), fixed_to=2, mass_kg=0.05)
    physics = build_physics([FLOOR, parent, child])
    physics.step(480)
    between = np.linalg.inv(physics.pose(2)) @ physics.pose(3)
    expected = np.linalg.inv(parent.world_from_object) @ child.world_from_object
    assert pose_change(expected, between)[0] < 2e-3


@pytest.mark.parametrize("child_kg", [0.02, 0.5, 3.0])
def test_a_fixed_child_stays_fixed_and_at_rest(child_kg):
    arm = body(3, corners(0.1, 0.03, 0.03), (0, 0.115, 0.05), fixed_to=2, mass_kg=child_kg)
    report = physics_report([FLOOR, body(2, CUBE, (0, 0, 0), mass_kg=8.0), arm])
    assert report["stable_rate"] == report["at_rest_rate"] == 1.0
    assert max(o["turned_deg"] for o in report["objects"]) < 0.1
    assert max(o["moved_m"] for o in report["objects"]) < 1e-4


def test_flat_pieces_and_many_vertices_can_be_used():
    flat = corners(0.2, 0.2, 0.0)
    sphere = np.random.default_rng(0).normal(size=(2000, 3))
    sphere *= 0.1 / np.linalg.norm(sphere, axis=1, keepdims=True)
    physics = build_physics([FLOOR, body(2, flat, (0, 0, 0.01)), body(3, sphere, (1, 0, 0.3))])
    physics.step(240)
    assert abs(physics.pose(2)[2, 3]) < 0.002
    assert physics.pose(3)[2, 3] == pytest.approx(0.1, abs=0.003)


def test_wrong_bodies_are_refused_by_name():
    with pytest.raises(SimReconError, match=r"body_2.*mass"):
        build_physics([body(2, CUBE, (0, 0, 0), mass_kg=0.0)])
    with pytest.raises(SimReconError, match="two bodies"):
        build_physics([FLOOR, replace(FLOOR)])
    with pytest.raises(SimReconError, match="fixed to 9"):
        build_physics([FLOOR, body(2, CUBE, (0, 0, 0), fixed_to=9)])


def test_report_is_the_same_twice():
    specs = [FLOOR, *(body(2 + k, CUBE, (0.01 * k, 0, 0.1 * k)) for k in range(4))]
    assert physics_report(specs, duration_s=2) == physics_report(specs, duration_s=2)


def test_bundle_round_trip(tmp_path):
    def write(name: str, points: np.ndarray) -> str:
        (tmp_path / name).write_text("".join(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in points))
        return name

    base = {"id": 1, "label": "floor", "collision": [write("floor.obj", FLOOR.parts[0])]}
    item = {
        "id": 2,
        "label": "box",
        "collision": [write("box.obj", CUBE)],
        "mass_kg": 0.5,
        "center_of_mass": [0, 0, 0.05],
        "friction": 0.4,
        "restitution": 0.1,
        "dynamic": True,
        "world_from_object": rigid(None, np.array([0, 0, 0.0])).tolist(),
    }
    graph = {"edges": [{"child": 2, "relation": "supported_by", "parent": 1}]}
    scene = {"id": "scene0001", "base": [base], "objects": [item], "graph": graph}
    specs = specs_from_bundle(SimpleNamespace(scene=scene, resolve=lambda path: tmp_path / path))
    assert [s.id for s in specs] == [1, 2]
    assert physics_report(specs, duration_s=1)["stable_rate"] == 1.0
    del base["collision"]
    with pytest.raises(BundleError, match="no collision slab"):
        specs_from_bundle(SimpleNamespace(scene=scene, resolve=lambda path: tmp_path / path))


def edge(child: int, parent: int, relation: str = "supported_by") -> SimpleNamespace:
    return SimpleNamespace(child=child, relation=relation, parent=parent)


def test_edges_are_held_against_who_carries_whom():
    stack = [FLOOR, *(body(2 + k, CUBE, (0, 0, 0.1 * k)) for k in range(3))]
    true = [edge(2, 1), edge(3, 2), edge(4, 3)]
    contacts = physics_report(stack, true, duration_s=1)["contacts"]
    assert contacts["support_edges_real"] == contacts["support_edges"] == contacts["main_supports"] == 3
    assert contacts["edges_without_contact"] == contacts["supports_without_edge"] == []
    contacts = physics_report(stack, [edge(2, 1), edge(3, 2), edge(4, 1)], duration_s=1)["contacts"]
    assert contacts["support_edges_real"] == 2
    (unreal,) = contacts["edges_without_contact"]
    assert (unreal["child"], unreal["parent"], unreal["gap_mm"]) == (4, 1, None)
    assert contacts["supports_without_edge"] == [{"child": 4, "carrier": 3, "share": 1.0}]


def test_a_bridge_has_one_parent_and_a_lesser_carrier():
    plank = corners(1.0, 0.1, 0.05)
    piers = [body(2, CUBE, (-0.4, 0, 0)), body(3, CUBE, (0.25, 0, 0))]
    specs = [FLOOR, *piers, body(4, plank, (0, 0, 0.1))]
    report = physics_report(specs, [edge(2, 1), edge(3, 1), edge(4, 3)], duration_s=1)
    assert report["stable_rate"] == 1.0
    assert report["contacts"]["support_edges_real"] == 3
    assert report["contacts"]["supports_without_edge"] == []
    assert report["contacts"]["lesser_supports"] == 1  # it also rests on the other pier


def test_what_cannot_move_must_be_near_its_parent():
    hung = body(2, CUBE, (0, 0, 0.0015), dynamic=False)
    far = body(3, CUBE, (1, 0, 0.006), dynamic=False)
    edges = [edge(2, 1), edge(3, 1, "attached_to")]
    contacts = physics_report([FLOOR, hung, far], edges, duration_s=0.5)["contacts"]
    assert (contacts["support_edges_real"], contacts["attached_edges_real"]) == (1, 0)
    assert contacts["edges_without_contact"][0]["gap_mm"] == pytest.approx(6, abs=0.1)


def test_energy_is_that_of_the_motion():
    physics = build_physics([body(2, CUBE, (0, 0, 1.0), mass_kg=0.5)])
    physics.set_gravity(2, False)
    before = physics.pose(2)
    assert physics.energy_of_motion(2, before, 0.1) == 0.0
    physics._bodies[2].set_linear_velocity(np.array([0.3, 0, 0.4]))
    physics._bodies[2].set_angular_velocity(np.array([0, 0, 2.0]))
    physics.step(24)
    about_z = 0.5 / 12 * (0.2**2 + 0.2**2)
    expected = 0.5 * 0.5 * 0.25 + 0.5 * about_z * 4
    assert physics.energy_of_motion(2, before, 0.1) == pytest.approx(expected, rel=1e-3)


def test_a_card_says_what_it_falls_short_of():
    rests = physics_report([FLOOR, body(2, CUBE, (0, 0, 0))], duration_s=1)
    assert failures(rests) == []
    assert rests["energy_at_rest_j"] < 1e-6
    falls = physics_report([FLOOR, body(2, CUBE, (0, 0, 50.0)), body(3, CUBE, (1, 0, -0.005))], duration_s=1)
    lines = failures(falls)
    assert [o["at_rest"] for o in falls["objects"]] == [False, True]
    assert any("body_2 does not stay put" in line for line in lines)
    assert any("body_2 floats" in line for line in lines)
    assert any("overlap by 5.0 mm" in line for line in lines)
