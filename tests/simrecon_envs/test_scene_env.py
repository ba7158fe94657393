"""`SceneEnv` on a handmade room: API, physics at rest, determinism, the pick task, errors."""

import dataclasses
import functools
import itertools
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from made_scenes import BOOK, BOX, CYLINDER, KNOB, PICTURE, TABLE, TABLE_TOP_M

import simrecon_envs
from registry import EnvironmentMissing, SceneNotFound, SceneRegistry, UsageError
from registry.geometry import matrix_from_quat
from simrecon_envs import SceneAssetsMissing
from simrecon_envs.cameras import room_view
from simrecon_envs.oracle import CONTROL_MODE, Oracle

ROBOTS = ("panda", "fetch")
PENETRATION_M = 0.001
REST_SHIFT_M = 0.002


def _make(root: Path, scene: str = "room", **kwargs: object) -> gym.Env:
    return simrecon_envs.make(scene, registry=root, **kwargs)


@pytest.fixture(scope="module", params=ROBOTS)
def env(request: pytest.FixtureRequest, scenes_root: Path) -> gym.Env:
    """Return environments of the room with each robot and state observations."""
    made = _make(scenes_root, robot_uids=request.param)
    yield made
    made.close()


@pytest.mark.parametrize("robot", ROBOTS)
def test_checker_passes_on_the_cpu_wrapper(robot: str, scenes_root: Path) -> None:
    env = simrecon_envs.make_cpu("room", registry=scenes_root, robot_uids=robot)
    with warnings.catch_warnings():
        # The checker advises against unbounded boxes, which all of ManiSkill's observations are.
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)
    env.close()


def test_thousand_random_steps_have_no_nan(env: gym.Env) -> None:
    env.reset(seed=3)
    env.action_space.seed(3)
    for _ in range(1000):
        obs, reward, _, _, info = env.step(env.action_space.sample())
        assert torch.isfinite(obs).all()
        assert torch.isfinite(reward).all()
    assert 0 <= float(reward) <= 1
    assert torch.isfinite(info["lift_m"]).all()


@pytest.mark.parametrize(("robot", "task"), [("panda", "push_block"), ("fetch", "pick_cup")])
def test_seeded_runs_are_identical_whatever_was_before(robot: str, task: str, scenes_root: Path) -> None:
    make = functools.partial(
        _make, scenes_root, "things", robot_uids=robot, task=task, control_mode=CONTROL_MODE
    )
    env, new = make(), make()
    env.reset(seed=11)
    actions = [action for action in itertools.islice(Oracle(env).actions(), 140) if env.step(action)]
    first = _trace(env, actions, 11)
    for episode in range(3):
        _trace(env, actions[: 140 - 20 * episode], None)
    again, elsewhere = _trace(env, actions, 11), _trace(new, actions, 11)
    assert torch.equal(first, again)
    assert torch.equal(first, elsewhere)
    poses = 7 * len(env.unwrapped.movable_ids)  # the last numbers of the state
    assert (first[-1, 0, -poses:] - first[0, 0, -poses:]).abs().max() > 0.05  # the robot moved an object
    env.close()
    new.close()


def _trace(env: gym.Env, actions: list[np.ndarray], seed: int | None) -> torch.Tensor:
    """Return the observations (n, 1, k) of an episode."""
    return torch.stack(
        [env.reset(seed=seed)[0].clone(), *(env.step(action)[0].clone() for action in actions)]
    )


def test_nothing_penetrates_at_reset_and_all_rests(env: gym.Env) -> None:
    env.reset(seed=0)
    scene_env = env.unwrapped
    start = {key: scene_env.builder.objects[key].actor.pose.p.clone() for key in scene_env.movable_ids}
    deepest = 0.0
    robot = {link._objs[0].entity.name for link in scene_env.agent.robot.get_links()}
    still = torch.zeros(env.action_space.shape)
    for _ in range(40):
        env.step(still)
        for contact in scene_env.scene.get_contacts():
            names = {body.entity.name for body in contact.bodies}
            if names <= robot:
                continue
            deepest = max(deepest, *(-point.separation for point in contact.points), 0.0)
    assert deepest < PENETRATION_M
    for key, position in start.items():
        shift = torch.linalg.norm(scene_env.builder.objects[key].actor.pose.p - position)
        assert shift < REST_SHIFT_M, f"object {key} moved by {float(shift):.4f} m"


def test_actors_are_as_the_bundle_says(env: gym.Env) -> None:
    env.reset(seed=0)
    builder = env.unwrapped.builder
    kinds = {key: placed.dynamic for key, placed in builder.objects.items()}
    # The picture is "dynamic" in the bundle, but hangs on a wall; the knob is welded to the book.
    assert kinds == {BOX: True, CYLINDER: True, BOOK: True, KNOB: True, TABLE: False, PICTURE: False}
    assert builder.objects[KNOB].actor is builder.objects[BOOK].actor
    assert env.unwrapped.movable_ids == (BOX, CYLINDER, BOOK)
    box = builder.objects[BOX].actor._objs[0].find_component_by_type(_rigid())
    source = next(o for o in env.unwrapped.bundle.objects if o.id == BOX)
    assert box.mass == pytest.approx(source.mass_kg)
    np.testing.assert_allclose(box.cmass_local_pose.p, source.center_of_mass, atol=1e-6)
    axes = matrix_from_quat(box.cmass_local_pose.q)
    np.testing.assert_allclose(axes @ np.diag(box.inertia) @ axes.T, source.inertia, rtol=1e-3, atol=1e-8)
    shape = box.collision_shapes[0]
    assert shape.physical_material.static_friction == pytest.approx(source.friction)


def test_welded_objects_share_mass_and_inertia(scenes_root: Path) -> None:
    from simrecon_envs.scene_builder import bodies_of, merged_mass

    body = next(b for b in bodies_of(SceneRegistry(scenes_root).load("room")) if b.root == BOOK)
    merged = merged_mass(body)
    assert merged.mass_kg == pytest.approx(0.45)
    # Book 3 cm high and 0.4 kg, knob 3 cm high and 0.05 kg on it.
    assert merged.center_of_mass[2] == pytest.approx((0.4 * 0.015 + 0.05 * 0.045) / 0.45)
    lever = 0.4 * (merged.center_of_mass[2] - 0.015) ** 2 + 0.05 * (0.045 - merged.center_of_mass[2]) ** 2
    own = 0.4 / 12 * (0.15**2 + 0.03**2) + 0.05 / 12 * (2 * 0.03**2)
    assert merged.inertia[0, 0] == pytest.approx(own + lever, rel=1e-6)


def _rigid() -> type:
    from sapien.physx import PhysxRigidDynamicComponent

    return PhysxRigidDynamicComponent


def test_the_room_is_seen_from_before_or_beside_the_robot(env: gym.Env) -> None:
    scene = env.unwrapped
    there = scene.placement
    away = float(np.linalg.norm((there.position - there.target.center)[:2]))
    for angle in np.arange(4) * np.pi / 2:  # around the target, facing it
        ahead = np.array([np.cos(angle), np.sin(angle)])
        position = np.array([*(there.target.center[:2] - away * ahead), there.position[2]])
        placement = dataclasses.replace(there, position=position, yaw_rad=float(angle))
        view = room_view(scene.bundle, scene.facts.solids, placement, scene.robot_points)
        aside = (view.eye - position)[:2]
        assert ahead @ aside > -0.3 * np.linalg.norm(aside)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_script_can_do_the_task(robot: str, scenes_root: Path) -> None:
    env = _make(scenes_root, robot_uids=robot, target=BOX, control_mode="pd_ee_delta_pose")
    env.reset(seed=0)
    script, rewards, info = Oracle(env), [], {}
    for _ in range(150):
        _, reward, terminated, _, info = env.step(script.action())
        rewards.append(float(reward))
        if bool(terminated):
            break
    assert bool(info["success"])
    assert rewards[-1] == pytest.approx(1.0)
    assert float(info["lift_m"]) >= env.unwrapped.task_config.lift_m
    # The reward increases from reaching to grasping to lifting.
    assert rewards[0] < rewards[len(rewards) // 2] < rewards[-1]
    env.close()


def test_standing_still_is_no_success(scenes_root: Path) -> None:
    env = _make(scenes_root, reward_mode="sparse")
    env.reset(seed=0)
    for _ in range(10):
        _, reward, terminated, _, _ = env.step(torch.zeros(env.action_space.shape))
        assert float(reward) == 0.0
        assert not bool(terminated)
    env.close()


@pytest.mark.parametrize(
    ("target", "key"), [(BOX, BOX), (str(BOX), BOX), ("cup", CYLINDER), ("Cup", CYLINDER)]
)
def test_targets_are_named_by_id_or_label(target: str | int, key: int, scenes_root: Path) -> None:
    env = _make(scenes_root, target=target)
    assert env.unwrapped.target_id == key
    label = next(o.label for o in env.unwrapped.bundle.objects if o.id == key)
    assert env.unwrapped.instruction == f"Pick up the {label}."
    env.close()


def test_a_hard_target_is_possible_but_noted(scenes_root: Path) -> None:
    env = _make(scenes_root, target="book")
    assert "something stands on it" in env.unwrapped.task_note
    env.close()


@pytest.mark.parametrize(
    ("kwargs", "text"),
    [
        ({"target": "table"}, "cannot move.*10 \\(box\\)"),
        ({"target": "lamp"}, "no such object.*11 \\(cup\\)"),
        ({"task": "juggle"}, "has no task 'juggle'.*Kinds: reach, pick.*pick_box"),
        ({"task": "pik"}, "Did you mean 'pick'"),
        ({"robot_uids": "pandaa"}, "Did you mean 'panda'.*fetch"),
        ({"obs_mode": "rgbb"}, "obs_mode 'rgbb': expected state, .*rgbd.*Did you mean 'rgb'"),
        (
            {"control_mode": "pd_ee_delta_poses"},
            "control_mode 'pd_ee_delta_poses': expected one of pd_joint_delta_pos, .*of robot 'panda'. "
            "Did you mean 'pd_ee_delta_pose'",
        ),
        ({"reward_mode": "shaped"}, "reward_mode 'shaped': expected one of normalized_dense, dense"),
    ],
)
def test_wrong_arguments_list_the_right_ones(kwargs: dict, text: str, scenes_root: Path) -> None:
    with pytest.raises(UsageError, match=text):
        _make(scenes_root, **kwargs)


def test_what_nobody_moved_sleeps_until_something_moves(scenes_root: Path) -> None:
    env = simrecon_envs.make("things", registry=scenes_root, task="rearrange")
    scene = env.unwrapped
    bodies = {placed.id: placed.actor._bodies[0] for placed in scene.builder.movable_actors}
    for seed in range(2):
        env.reset(seed=seed)
        moved = {stage.subject for stage in scene.task_object.stages}
        assert {key for key, body in bodies.items() if not body.is_sleeping} == moved
        before = scene.measures.poses.copy()
        for _ in range(5):
            env.step(np.zeros(env.action_space.shape, np.float32))
        for row, key in enumerate(bodies):
            same = np.array_equal(scene.measures.poses[0, row], before[0, row])
            assert same or key in moved
    env.close()


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_several_environments_without_cuda_name_what_does_it(scenes_root: Path) -> None:
    with pytest.raises(EnvironmentMissing, match=r"make_vec\('room', 4\)"):
        _make(scenes_root, num_envs=4)


def test_robot_without_files_raises_instead_of_asking(scenes_root: Path) -> None:
    with pytest.raises(EnvironmentMissing, match="download_asset xarm6_robotiq"):
        _make(scenes_root, robot_uids="xarm6_robotiq")


def test_scene_where_nothing_moves_still_steps(scenes_root: Path) -> None:
    env = _make(scenes_root, "bare")
    assert env.unwrapped.task == "none"
    assert "nothing in this scene can move" in env.unwrapped.task_note
    obs, _ = env.reset(seed=0)
    for _ in range(20):
        obs, reward, terminated, _, _ = env.step(env.action_space.sample())
    assert torch.isfinite(obs).all()
    assert float(reward) == 0.0
    assert not bool(terminated)
    env.close()


def test_pose_noise_moves_objects_by_seed(scenes_root: Path) -> None:
    env = _make(scenes_root, pose_noise=(0.01, 0.2))
    actor = env.unwrapped.builder.objects[BOX].actor

    def position(seed: int) -> np.ndarray:
        env.reset(seed=seed)
        return actor.pose.p[0].numpy().copy()

    assert np.array_equal(position(1), position(1))
    assert not np.array_equal(position(1), position(2))
    assert np.linalg.norm(position(1)[:2] - [-0.35, 0.85]) < 0.03
    assert position(1)[2] == pytest.approx(TABLE_TOP_M)
    env.close()


def test_time_limit_truncates_every_environment(scenes_root: Path) -> None:
    env = _make(scenes_root, max_episode_steps=3)
    env.reset(seed=0)
    truncated = [env.step(env.action_space.sample())[3] for _ in range(3)]
    assert [bool(x) for x in truncated] == [False, False, True]
    assert truncated[0].shape == (1,)
    assert env.spec.max_episode_steps == 3
    again = EnvSpec.from_json(env.spec.to_json())
    assert gym.make(again).spec.max_episode_steps == 3
    env.close()


def test_replaced_revision_is_said(scenes_root: Path) -> None:
    simrecon_envs.register_scenes(scenes_root)
    with pytest.warns(UserWarning, match="was replaced by"):
        env = gym.make("SimRecon/bare", revision="f" * 16)
    assert "f" * 16 in env.unwrapped.revision_note
    env.close()
    with pytest.raises(SceneAssetsMissing, match="register_scenes"):
        gym.make("SimRecon/bare", revision="f" * 16, strict_revision=True)


def test_damaged_and_removed_scenes_say_what_to_do(scenes_root: Path, tmp_path: Path) -> None:
    registry = SceneRegistry(tmp_path, create=True)
    record = registry.publish(SceneRegistry(scenes_root).get("bare").path, "lost")
    simrecon_envs.register_scenes(tmp_path)
    shutil.rmtree(record.path / "objects")
    with pytest.raises(SceneAssetsMissing, match="simrecon reconstruct VIDEO --scene lost"):
        gym.make("SimRecon/lost")
    registry.remove("lost")
    with pytest.raises(SceneNotFound, match="register_scenes"):
        gym.make("SimRecon/lost")


_BLIND = """
import sys, warnings
warnings.simplefilter("ignore")
import torch, simrecon_envs
from registry import EnvironmentMissing
env = simrecon_envs.make("room", registry=sys.argv[1])
obs, _ = env.reset(seed=0)
for _ in range(10):
    obs, *_ = env.step(env.action_space.sample())
assert torch.isfinite(obs).all()
try:
    simrecon_envs.make("room", registry=sys.argv[1], obs_mode="rgb")
except EnvironmentMissing as error:
    print(error)
"""


def test_state_works_without_vulkan_and_pictures_name_the_doctor(scenes_root: Path, tmp_path: Path) -> None:
    hidden = dict.fromkeys(("VK_ICD_FILENAMES", "VK_DRIVER_FILES"), str(tmp_path / "none.json"))
    run = subprocess.run(
        [sys.executable, "-c", _BLIND, str(scenes_root)],
        env={**os.environ, **hidden},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr
    assert "simrecon doctor" in run.stdout


def test_stable_baselines_learns_a_few_steps(scenes_root: Path) -> None:
    from stable_baselines3 import PPO

    env = simrecon_envs.make_cpu("room", registry=scenes_root)
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(64)
    action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
    assert env.action_space.contains(action)
    env.close()
