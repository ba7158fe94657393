"""What is read and driven straight through SAPIEN, in NumPy, is what ManiSkill's structs and controllers give."""

import functools
from pathlib import Path

import numpy as np
import pytest
import sapien
import torch

import simrecon_envs
from simrecon_envs import scene_env
from simrecon_envs.direct import DirectDrive, DirectReads, _Tip
from simrecon_envs.measures import Measures
from simrecon_envs.oracle import CONTROL_MODE, Oracle

TASKS = (
    "push_block",
    "put_cube_in_crate-then-pick_cup",
    *(
        pytest.param(task, marks=pytest.mark.slow)
        for task in (
            "reach_crate",
            "place_cube_on_shelf",
            "put_cup_in_crate",
            "stack_cup_on_block",
            "rearrange",
        )
    ),
)


@pytest.mark.parametrize("task", TASKS)
def test_tasks_in_numpy_are_tasks_in_torch(
    scenes_root: Path, monkeypatch: pytest.MonkeyPatch, task: str
) -> None:
    _same_by_both(scenes_root, monkeypatch, task, "panda")


def test_driving_in_numpy_is_driving_in_torch(scenes_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _same_by_both(scenes_root, monkeypatch, "navigate_shelf", "fetch")


def _same_by_both(root: Path, monkeypatch: pytest.MonkeyPatch, task: str, robot: str) -> None:
    make = functools.partial(
        simrecon_envs.make, "things", registry=root, task=task, robot_uids=robot,
        control_mode=CONTROL_MODE, max_episode_steps=10_000,
    )  # fmt: skip
    env = make()
    monkeypatch.setattr(scene_env, "Measures", functools.partial(Measures, direct=False))
    other = make()
    assert isinstance(env.unwrapped.measures.tcp, np.ndarray)
    assert isinstance(other.unwrapped.measures.tcp, torch.Tensor)
    _compare(env.reset(seed=2)[0], other.reset(seed=2)[0])
    seen: dict[str, set] = {}
    for _, action in zip(range(250), Oracle(env).actions(), strict=False):
        (obs, reward, done, _, info), twin = env.step(action), other.step(action)
        _compare(obs, twin[0])
        _compare(reward, twin[1])
        assert info.keys() == twin[4].keys()
        for key, value in info.items():
            _compare(value, twin[4][key])
            seen.setdefault(key, set()).add(float(value[0]))
        if done:
            break
    assert max(len(values) for values in seen.values()) > 5  # something did move
    env.close()
    other.close()


def _compare(ours: torch.Tensor, theirs: torch.Tensor) -> None:
    assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
    # Heights of what is lifted are differences of nearly equal numbers.
    torch.testing.assert_close(ours, theirs, atol=2e-5, rtol=2e-5)


def test_what_moved_is_read_and_computed_anew(scenes_root: Path) -> None:
    env = simrecon_envs.make(
        "things", registry=scenes_root, task="put_cube_in_crate", max_episode_steps=10_000
    )
    scene, shift = env.unwrapped, np.array([0.02, 0.03, 0.0])
    for seed in range(2):  # the second reset has moved everything to another PhysX scene
        env.reset(seed=seed)
        for _ in range(30):
            env.step(np.zeros(env.action_space.shape, np.float32))
        _read_as_sapien_has_them(scene)
        before = {key: value.clone() for key, value in scene.evaluate().items()}
        here = scene.measures.position(scene.target_id).copy()
        entity = scene.builder.objects[scene.target_id].actor._objs[0]
        entity.set_pose(sapien.Pose(shift) * entity.pose)
        assert (scene.measures.position(scene.target_id) == here).all()  # until the next evaluation
        after = scene.evaluate()
        _read_as_sapien_has_them(scene)
        np.testing.assert_allclose(scene.measures.position(scene.target_id) - here, shift[None], atol=1e-6)
        assert float(after["target_to_goal_m"]) != float(before["target_to_goal_m"])
    extra = sapien.Entity()
    scene.scene.sub_scenes[0].add_entity(extra)  # not where it was among the entities that are packed
    scene.evaluate()
    _read_as_sapien_has_them(scene)
    env.close()


def _read_as_sapien_has_them(scene: object) -> None:
    actors = [placed.actor._objs[0] for placed in scene.builder.movable_actors]
    poses = np.array([actor.pose.__getstate__() for actor in actors], np.float32)
    np.testing.assert_array_equal(scene.measures.poses[0], poses)
    tip = scene.agent.tcp._objs[0].entity_pose.__getstate__()
    np.testing.assert_array_equal(scene.measures.tcp[0], np.array(tip, np.float32))


def test_contacts_are_asked_for_only_where_they_decide(
    scenes_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = simrecon_envs.make("things", registry=scenes_root, task="rearrange", max_episode_steps=10_000)
    contacts, asked = DirectReads._contacts, []

    def counted(reads: DirectReads, row: int) -> list:
        asked.append(row)
        return contacts(reads, row)

    monkeypatch.setattr(DirectReads, "_contacts", counted)
    scene, still = env.unwrapped, np.zeros(env.action_space.shape, np.float32)
    env.reset(seed=0)
    stage = scene.task_object.stages[0]
    row = scene.measures._row[stage.subject]
    for _ in range(3):  # what was moved away is awake, and carried wherever it is
        env.step(still)
    assert row not in asked
    body = scene.builder.objects[stage.subject].actor._bodies[0]
    home = next(item for item in scene.bundle.objects if item.id == stage.subject).world_from_object
    body.entity.pose = sapien.Pose(home)
    info = env.step(still)[-1]
    assert row in asked
    assert int(info["things_done"]) == 1
    env.close()


@pytest.mark.parametrize(
    ("robot", "mode", "direct"),
    [
        ("panda", "pd_joint_delta_pos", True),
        ("panda", "pd_joint_pos", True),
        ("panda", "pd_joint_target_delta_pos", False),
        ("panda", "pd_ee_delta_pose", True),
        ("panda", "pd_ee_delta_pos", True),
        ("panda", "pd_ee_target_delta_pose", False),
        ("fetch", "pd_ee_delta_pose", True),
        ("panda", "pd_joint_vel", False),
        ("fetch", "pd_joint_delta_pos", True),
    ],
)
def test_joints_get_the_targets_of_the_controllers(
    scenes_root: Path, robot: str, mode: str, direct: bool
) -> None:
    env = simrecon_envs.make("room", registry=scenes_root, robot_uids=robot, control_mode=mode)
    env.reset(seed=0)
    agent = env.unwrapped.agent
    drive = DirectDrive(agent)
    assert (agent.controller.controllers["arm"] not in [child for _, child in drive.foreign]) == direct
    joints = [joint._objs[0] for joint in agent.robot.active_joints]
    generator = np.random.default_rng(0)
    for _ in range(5):
        scale = 1.5 if mode != "pd_joint_pos" else 0.3
        action = generator.uniform(-scale, scale, agent.single_action_space.shape).astype(np.float32)
        state = agent.controller.get_state()
        agent.controller.set_action(torch.from_numpy(action)[None])
        theirs = _targets(joints)
        agent.controller.set_state(state)
        drive.set_action(torch.from_numpy(action)[None], action.tolist())
        if "_ee_" in mode:
            # The hand goes to the same place, as far as ManiSkill solves for it; the elbow nearly does.
            ours = _targets(joints)
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-2)
            kinematics = agent.controller.controllers["arm"].kinematics
            hands = [_hand(kinematics, targets[:, 0]) for targets in (ours, theirs)]
            np.testing.assert_allclose(*hands, rtol=0, atol=2e-4)
        else:
            # Doubles are rounded once, ManiSkill's floats after every operation.
            np.testing.assert_allclose(_targets(joints), theirs, rtol=5e-7, atol=1e-7)
        env.step(action)
    env.close()


def test_the_hand_gets_where_it_can_in_few_steps(scenes_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = simrecon_envs.make("room", registry=scenes_root, control_mode=CONTROL_MODE)
    env.reset(seed=0)
    agent = env.unwrapped.agent
    drive, arm = DirectDrive(agent), agent.controller.controllers["arm"]
    solve, counts = _Tip._steps, []

    def counted(*args: object, **options: float) -> tuple:
        counts.append(options["max_iterations"])
        return solve(*args, **options)

    monkeypatch.setattr(_Tip, "_steps", counted)
    generator, moved, short = np.random.default_rng(0), [], 0
    for _ in range(60):
        action = generator.uniform(-1, 1, agent.single_action_space.shape).astype(np.float32)
        state = agent.controller.get_state()
        agent.controller.set_action(torch.from_numpy(action)[None])
        theirs = arm._target_qpos.numpy().copy()
        agent.controller.set_state(state)
        counts.clear()
        drive.set_action(torch.from_numpy(action)[None], action.tolist())
        ours, here = arm._target_qpos.numpy(), arm._start_qpos.numpy()
        # Where the hand cannot get, both leave the arm where it is.
        assert np.array_equal(theirs, here) == np.array_equal(ours, here)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=0.05)
        moved.append(not np.array_equal(ours, here))
        short += sum(counts) <= 20
        env.step(action)
    assert sum(moved) > 30
    assert short > 55  # ManiSkill's takes a hundred
    env.close()


def _hand(kinematics: object, qpos: np.ndarray) -> np.ndarray:
    """Return the hand's pose (4, 4) where the joints are at `qpos` (d,)."""
    model = kinematics.pmodel
    model.compute_forward_kinematics(qpos[kinematics.pmodel_active_joint_indices.numpy()])
    return model.get_link_pose(kinematics.end_link_idx).to_transformation_matrix()


def _targets(joints: list) -> np.ndarray:
    return np.array(
        [[float(joint.drive_target[0]), float(joint.drive_velocity_target[0])] for joint in joints]
    )
