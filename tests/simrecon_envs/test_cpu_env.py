"""`cpu_env` and `inverse_kinematics` give the numbers of ManiSkill's structs and controllers."""

import functools
from pathlib import Path

import numpy as np
import pytest
import sapien
import scipy.linalg
import torch
from scipy.spatial.transform import Rotation

import simrecon_envs
from simrecon_envs import inverse_kinematics, scene_env
from simrecon_envs.cpu_env import _PHASES, DirectDrive, DirectReads
from simrecon_envs.measures import Measures
from simrecon_envs.oracle import CONTROL_MODE, Oracle
from simrecon_envs.tasks.put import Put

TASKS = (
    "push_block",
    "put_cube_in_crate-then-pick_cup",
    *(
        pytest.param(task, marks=pytest.mark.end_to_end)
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
    assert max(len(values) for values in seen.values()) > 5  # objects moved
    env.close()
    other.close()


def _compare(ours: torch.Tensor, theirs: torch.Tensor) -> None:
    assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
    # Lift heights are differences of nearly equal numbers.
    torch.testing.assert_close(ours, theirs, atol=2e-5, rtol=2e-5)


def test_what_moved_is_read_and_computed_anew(scenes_root: Path) -> None:
    env = simrecon_envs.make(
        "things", registry=scenes_root, task="put_cube_in_crate", max_episode_steps=10_000
    )
    scene, shift = env.unwrapped, np.array([0.02, 0.03, 0.0])
    for seed in range(2):  # the second reset moves all bodies to a new PhysX scene
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
    scene.scene.sub_scenes[0].add_entity(extra)  # changes the order of the packed entities
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
    for _ in range(3):  # moved objects are awake and supported
        env.step(still)
    assert row not in asked
    body = scene.builder.objects[stage.subject].actor._bodies[0]
    home = next(item for item in scene.bundle.objects if item.id == stage.subject).world_from_object
    body.entity.pose = sapien.Pose(home)
    info = env.step(still)[-1]
    assert row in asked
    assert int(info["things_done"]) == 1
    env.close()


def test_what_sleeps_far_from_the_hand_is_judged_once(
    scenes_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = simrecon_envs.make(
        "things", registry=scenes_root, task="put_cube_in_crate", max_episode_steps=10_000
    )
    scene, still, judged = env.unwrapped, np.zeros(env.action_space.shape, np.float32), []
    judge = Put._judge
    monkeypatch.setattr(Put, "_judge", lambda task: judged.append(1) or judge(task))
    subject = scene.builder.objects[scene.task_object.subject].actor._bodies[0]
    place = scene.builder.objects[scene.task_object.spec.place].actor._bodies[0]

    def judgements() -> tuple[int, dict]:
        judged.clear()
        for _ in range(3):
            info = env.step(still)[-1]
        return len(judged), info

    env.reset(seed=0)
    env.step(still)
    for body in (subject, place):
        body.put_to_sleep()
    assert judgements()[0] <= 1
    for body in (subject, place):  # not where they were told, and not both
        body.wake_up()
        assert judgements()[0] == 3
        body.put_to_sleep()
    env.step(still)
    subject.entity.pose = sapien.Pose([0, 0, 1]) * subject.entity.pose
    subject.put_to_sleep()
    count, info = judgements()
    assert count >= 1
    assert float(info["target_to_goal_m"]) > 0.8
    tip = scene.agent.tcp._objs[0].entity_pose.p
    subject.entity.pose = sapien.Pose(tip)  # within reach of the hand
    subject.put_to_sleep()
    monkeypatch.setattr(scene, "_sim_steps_per_control", 0)
    assert judgements()[0] == 3
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
        drive.set_action(torch.from_numpy(action)[None], action, action.tolist())
        if "_ee_" in mode:
            # Equal hand poses within ManiSkill's tolerance; nearly equal elbow.
            ours = _targets(joints)
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-2)
            kinematics = agent.controller.controllers["arm"].kinematics
            hands = [_hand(kinematics, targets[:, 0]) for targets in (ours, theirs)]
            np.testing.assert_allclose(*hands, rtol=0, atol=2e-4)
        else:
            # Doubles are rounded once, ManiSkill's floats in every operation.
            np.testing.assert_allclose(_targets(joints), theirs, rtol=5e-7, atol=1e-7)
        env.step(action)
    env.close()


def test_the_hand_gets_where_it_can_in_few_steps(scenes_root: Path) -> None:
    env = simrecon_envs.make("room", registry=scenes_root, control_mode=CONTROL_MODE)
    env.reset(seed=0)
    agent = env.unwrapped.agent
    drive, arm = DirectDrive(agent), agent.controller.controllers["arm"]
    tip = drive._tips[0]
    generator, moved, short = np.random.default_rng(0), [], 0
    for _ in range(60):
        action = generator.uniform(-1, 1, agent.single_action_space.shape).astype(np.float32)
        state = agent.controller.get_state()
        agent.controller.set_action(torch.from_numpy(action)[None])
        theirs = arm._target_qpos.numpy().copy()
        agent.controller.set_state(state)
        drive.set_action(torch.from_numpy(action)[None], action, action.tolist())
        ours, here = arm._target_qpos.numpy(), arm._start_qpos.numpy()
        # Out of reach, both hold the arm.
        assert np.array_equal(theirs, here) == np.array_equal(ours, here)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=0.05)
        moved.append(not np.array_equal(ours, here))
        few = [_PHASES * [[1], [1], [0]] if part is _PHASES else part for part in tip._arm]
        found = inverse_kinematics.follow(*few, drive._robot.qpos, action[tip._share], np.zeros(7))
        short += found == moved[-1]
        env.step(action)
    assert sum(moved) > 30
    assert short > 55  # ManiSkill's takes a hundred
    env.close()


@pytest.mark.parametrize("robot", ["panda", "fetch"])
def test_arms_are_those_of_the_robots_model(scenes_root: Path, robot: str) -> None:
    env = simrecon_envs.make("room", registry=scenes_root, robot_uids=robot, control_mode=CONTROL_MODE)
    env.reset(seed=0)
    agent = env.unwrapped.agent
    kinematics = agent.controller.controllers["arm"].kinematics
    model, hand, mask = kinematics.pmodel, kinematics.end_link_idx, kinematics.qmask.numpy()
    tip = DirectDrive(agent)._tips[0]
    screws, moving, free, home, _, _, _, known = tip._arm
    here = agent.robot._objs[0].qpos
    generator, base_from, tips = np.random.default_rng(0), np.empty((len(screws) + 1, 3, 4)), np.empty((3, 4))
    off = []
    for _ in range(50):
        qpos = here + generator.normal(0, 0.3, len(here))
        inverse_kinematics.place(moving, qpos[known], base_from)
        inverse_kinematics.product(base_from[-1], home, tips)
        angles = qpos[kinematics.pmodel_active_joint_indices.numpy()]
        model.compute_forward_kinematics(angles)
        pose = model.get_link_pose(hand)
        np.testing.assert_allclose(tips, pose.to_transformation_matrix()[:3], rtol=0, atol=1e-6)

        matrix = np.empty((6, len(screws)))
        inverse_kinematics.jacobian(screws, np.ones(len(screws), bool), base_from, tips, matrix)
        for joint in range(len(screws)):
            turned, after = qpos[known] + 1e-5 * (np.arange(len(screws)) == joint), np.empty((3, 4))
            inverse_kinematics.place(moving, turned, base_from)
            inverse_kinematics.product(base_from[-1], home, after)
            np.testing.assert_allclose(matrix[:, joint], 1e5 * _screw(tips, after), rtol=0, atol=1e-4)

        # Steps equal those of ManiSkill's solver.
        action = generator.uniform(-1, 1, 6).astype(np.float32)
        turn = 0.2 * action[3:] / max(np.linalg.norm(action[3:]), 1)
        goal = sapien.Pose(0.1 * action[:3]) * pose
        goal.q = (sapien.Pose(q=_euler(turn)) * sapien.Pose(q=pose.q)).q
        scale = np.array([np.zeros(3), np.full(3, 0.1), np.full(3, 0.2)])
        for share, steps in ((0.5, 30), (1.0, 12), (0.1, 200)):
            theirs, found, _ = model.compute_inverse_kinematics(
                hand, goal, initial_qpos=angles, active_qmask=mask, eps=1e-6, dt=share, max_iterations=steps
            )
            phases, ours = np.array([[share, steps, 1e-6], [share, 0, 0]]), np.empty(len(known))
            same = inverse_kinematics.follow(
                screws, moving, free, home, phases, 0.0, scale, known, qpos.astype(np.float32), action, ours
            )
            assert same == found
            if found:
                solved = kinematics.pmodel_controlled_joint_indices.numpy()
                off.append(np.abs(ours[tip._found] - theirs[solved]).max())
    assert len(off) > 100
    assert np.max(off) < 1e-3
    assert np.median(off) < 1e-6
    env.close()


def test_the_way_to_a_goal_leads_there() -> None:
    generator, way = np.random.default_rng(0), np.empty(6)
    for angle in (0.0, 1e-9, 9e-5, 1.1e-4, 0.01, 1.0, 3.0):
        axis = generator.normal(size=3)
        screw = np.concatenate([generator.normal(size=3), angle * axis / np.linalg.norm(axis)])
        here = np.column_stack(
            [Rotation.from_rotvec(generator.normal(size=3)).as_matrix(), generator.normal(size=3)]
        )
        # Apply the twist, in base axes at the pose.
        local = np.zeros((4, 4))
        local[:3, :3], local[:3, 3] = np.cross(np.eye(3), screw[3:]), screw[:3]
        motion = scipy.linalg.expm(local)
        goal = np.column_stack([motion[:3, :3] @ here[:, :3], here[:, 3] + motion[:3, 3]])
        size = inverse_kinematics.away(here, goal, way)
        np.testing.assert_allclose(way, screw, rtol=0, atol=1e-8)
        assert size == pytest.approx(np.linalg.norm(screw), abs=1e-8)
    half = np.column_stack([np.diag([1.0, -1.0, -1.0]), np.zeros(3)])
    assert inverse_kinematics.away(np.eye(4)[:3], half, way) == np.inf  # not taken for converged


def _euler(turn: np.ndarray) -> np.ndarray:
    """Return the quaternion wxyz of rotations about base z, then y, then x (3,) (rad)."""
    return np.roll(Rotation.from_euler("XYZ", turn).as_quat(), 1)


def _screw(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the small twist (6,) between two poses (3, 4), in base axes."""
    turned = Rotation.from_matrix(after[:, :3] @ before[:, :3].T).as_rotvec()
    return np.concatenate([after[:, 3] - before[:, 3], turned])


def _hand(kinematics: object, qpos: np.ndarray) -> np.ndarray:
    """Return the hand's pose (4, 4) at joint positions `qpos` (d,)."""
    model = kinematics.pmodel
    model.compute_forward_kinematics(qpos[kinematics.pmodel_active_joint_indices.numpy()])
    return model.get_link_pose(kinematics.end_link_idx).to_transformation_matrix()


def _targets(joints: list) -> np.ndarray:
    return np.array(
        [[float(joint.drive_target[0]), float(joint.drive_velocity_target[0])] for joint in joints]
    )
