"""Tasks: listing and names, scripts solve them and doing nothing does not, success is measured by contacts and rest."""

import dataclasses
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from made_scenes import BLOCK, CRATE, CUBE, CYLINDER, TABLE

import simrecon_envs
from registry import SceneRegistry, UsageError
from simrecon_envs.oracle import CONTROL_MODE, Oracle
from simrecon_envs.tasks import KINDS, list_specs, parse_task
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.push import Push

EACH_KIND = (
    "reach_crate",
    "pick_cube",
    "pick_crate",  # by one of its walls
    "place_cube_on_shelf",
    "put_cup_in_crate",
    "stack_cup_on_block",
    "push_block",
    "rearrange",
    "put_cube_in_crate-then-pick_cup",
)


@pytest.fixture(scope="module")
def facts(scenes_root: Path) -> SceneFacts:
    """Return the facts of `things` for a Panda."""
    return SceneFacts(SceneRegistry(scenes_root).load("things"), "panda")


def _make(root: Path, task: str, **kwargs: object) -> gym.Env:
    return simrecon_envs.make("things", registry=root, task=task, max_episode_steps=10_000, **kwargs)


def test_every_kind_is_listed_with_names_and_instructions(facts: SceneFacts, scenes_root: Path) -> None:
    names = {spec.name for spec in list_specs(facts)}
    assert set(EACH_KIND[:8]) <= names
    assert not any("table" in name.split("_on_")[0] for name in names)  # it cannot move
    entries = simrecon_envs.list_tasks("things", registry=scenes_root)
    assert {entry.kind for entry in entries} == set(KINDS) - {"navigate"}  # a Panda does not drive
    words = {entry.task: entry.instruction for entry in entries}
    assert words["put_cup_in_crate"] == "Put the cup in the crate."
    assert words["place_cube_on_shelf"] == "Place the cube on the shelf."
    driving = simrecon_envs.list_tasks("things", registry=scenes_root, robot="fetch", kinds="navigate")
    assert "SimRecon/things-navigate_shelf-v0" in {entry.id for entry in driving}


def test_instructions_say_an_object_by_its_name_where_the_bundle_has_names(scenes_root: Path) -> None:
    bundle = SceneRegistry(scenes_root).load("things")
    plain = SceneFacts(bundle, "panda")
    first = plain.movable[0]
    for item in bundle.scene["objects"]:
        if item["id"] == first:
            item["name"] = "small red box on the shelf"
    del bundle.objects  # read again
    named = SceneFacts(bundle, "panda")
    assert named.thing(first) == "small red box on the shelf"
    assert all(named.thing(key) == plain.thing(key) for key in plain.movable[1:])
    assert named.names == plain.names  # ids of tasks stay


def test_the_inside_of_a_crate_is_measured(facts: SceneFacts) -> None:
    assert facts.containers == [CRATE]
    inside = facts.container(CRATE)
    assert inside.floor_m == pytest.approx(0.41, abs=1e-6)
    assert inside.rim_m == pytest.approx(0.47, abs=0.006)
    np.testing.assert_allclose(inside.center[:2], [0.10, 0.95], atol=0.016)
    assert inside.radius_m == pytest.approx(0.09, abs=0.02)


def test_spots_are_level_free_and_on_the_support(facts: SceneFacts) -> None:
    spots = facts.spots(TABLE, CUBE)
    assert len(spots) > 100
    np.testing.assert_allclose(spots[:, 2], 0.4, atol=1e-6)
    radius = 0.9 * facts.radius_m(CUBE)
    assert np.abs(spots[:, 0]).max() < 0.6 - radius + 0.02
    for key, half in ((BLOCK, 0.07), (CRATE, 0.10)):
        aside = np.abs(spots[:, :2] - facts.targets[key].center[:2]).max(axis=1)
        assert aside.min() > half


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("pick_block", "14.0 cm wide"),
        ("pick_table", "table cannot move"),
        ("put_cube_in_block", "no open container"),
        ("put_crate_in_crate", "cannot stand on itself"),
        ("stack_cube_on_crate", "use put"),
        ("place_cube_on_block-then-pick_block", "pick_block: 14.0 cm wide"),
    ],
)
def test_what_can_hardly_be_done_says_why(name: str, why: str, facts: SceneFacts) -> None:
    spec = parse_task(facts, name)
    assert not spec.feasible
    assert why in "; ".join(spec.problems)


@pytest.mark.parametrize(
    "name", ["pick", "pick_", "pick_lamp", "put_cup_on_crate", "-then-", "juggle", "navigate_to"]
)
def test_names_that_mean_nothing_list_what_there_is(name: str, facts: SceneFacts) -> None:
    with pytest.raises(UsageError, match=r"Kinds: reach, pick.*reach_"):
        parse_task(facts, name)


@pytest.mark.parametrize("name", EACH_KIND)
def test_a_script_does_the_task_and_standing_still_does_not(name: str, scenes_root: Path) -> None:
    env = _make(scenes_root, name, control_mode=CONTROL_MODE, reward_mode="dense")
    scene = env.unwrapped
    assert scene.task_note == ""
    env.reset(seed=1)
    still = torch.zeros(env.action_space.shape)
    for _ in range(8):
        _, waiting, terminated, _, _ = env.step(still)
        assert not bool(terminated)
    env.reset(seed=1)
    rewards = []
    for action in Oracle(env).actions():
        obs, reward, terminated, _, info = env.step(action)
        rewards.append(float(reward))
        assert torch.isfinite(obs).all()
        if bool(terminated):
            break
    assert bool(info["success"])
    assert rewards[-1] == pytest.approx(scene.task_object.max_reward)
    assert max(rewards[:-1]) < rewards[-1]
    assert min(rewards) >= 0
    assert float(waiting) < rewards[len(rewards) * 3 // 4] + 1e-6
    env.close()


def test_fetch_drives_to_things(scenes_root: Path) -> None:
    env = _make(scenes_root, "navigate_shelf", robot_uids="fetch", control_mode=CONTROL_MODE)
    for seed in (0, 1):
        env.reset(seed=seed)
        start = env.unwrapped.agent.base_link.pose.p[0].clone()
        for action in Oracle(env).actions():
            *_, terminated, _, info = env.step(action)
            if bool(terminated):
                break
        assert bool(info["success"])
        assert torch.linalg.norm(env.unwrapped.agent.base_link.pose.p[0] - start) > 0.5
    env.close()


def _teleport(env: gym.Env, key: int, position: tuple) -> None:
    from mani_skill.utils.structs.pose import Pose

    actor = env.unwrapped.builder.objects[key].actor
    actor.set_pose(Pose.create_from_pq(torch.tensor([position], dtype=torch.float32)))
    actor.set_linear_velocity(torch.zeros(1, 3))
    actor.set_angular_velocity(torch.zeros(1, 3))


def _settle(env: gym.Env, steps: int) -> dict:
    for _ in range(steps):
        info = env.step(None)[-1]
    return {key: value[0].item() for key, value in info.items()}


def test_success_needs_contact_with_the_support_and_rest(scenes_root: Path) -> None:
    env = _make(scenes_root, "place_cube_on_shelf")
    env.reset(seed=0)
    _teleport(env, CUBE, (0.85, 0.6, 0.55))  # in the air above it
    info = _settle(env, 1)
    assert not info["success"]
    assert not info["is_there"]
    info = _settle(env, 30)
    assert info["success"]
    assert info["is_there"]
    # It falls asleep, and PhysX reports no contacts any more.
    assert _settle(env, 60)["success"]
    _teleport(env, CUBE, (1.4, -0.8, 0.001))
    assert not _settle(env, 30)["is_there"]
    env.close()


def test_what_sleeps_since_the_reset_is_carried_by_what_it_was_captured_on(scenes_root: Path) -> None:
    for task, there in (("place_cube_on_table", True), ("place_cube_on_shelf", False)):
        env = _make(scenes_root, task)
        env.reset(seed=0)
        assert _settle(env, 3)["is_there"] == there
        _teleport(env, CUBE, (0.85, 0.6, 0.55))  # in the air, awake, without contact
        assert not _settle(env, 1)["is_there"]
        env.close()


def test_a_thing_above_the_rim_is_not_in_the_crate(scenes_root: Path) -> None:
    env = _make(scenes_root, "put_cup_in_crate")
    env.reset(seed=0)
    _teleport(env, CYLINDER, (0.10, 0.95, 0.56))
    assert not _settle(env, 1)["is_below_rim"]
    assert _settle(env, 40)["success"]
    _teleport(env, CYLINDER, (0.30, 1.15, 0.401))
    info = _settle(env, 40)
    assert not info["is_within_walls"]
    assert not info["success"]
    env.close()


def test_the_hand_gets_behind_what_it_pushes(scenes_root: Path) -> None:
    env = _make(scenes_root, "push_block").unwrapped
    middle = env.target.center[:2]
    for goal in env.task_object.goals:
        way = (middle - goal[:2]) / np.linalg.norm(middle - goal[:2])
        behind = np.array([*(middle + (env.facts.radius_m(BLOCK) + 0.04) * way), env.target.center[2]])
        assert env.placement.reaches(behind[None], env.facts.traits).all()
    env.close()


def test_what_stands_on_a_narrow_foot_is_not_pushed(scenes_root: Path) -> None:
    facts = SceneFacts(SceneRegistry(scenes_root).load("things"), "panda")
    assert facts.foot_width_m(BLOCK) == pytest.approx(0.14, abs=1e-3)
    assert not Push.problems(facts, BLOCK, None)
    middle = facts.targets[BLOCK].center
    for number, solid in enumerate(facts.solids):
        if solid.owner == BLOCK:
            narrow = solid.vertices.copy()
            low = narrow[:, 2] < middle[2]
            narrow[low, :2] = middle[:2] + 0.1 * (narrow[low, :2] - middle[:2])
            facts.solids[number] = dataclasses.replace(solid, vertices=narrow)
    assert Push.problems(facts, BLOCK, None) == ["so slim that it tips over"]


def test_a_toppled_block_is_not_pushed(scenes_root: Path) -> None:
    env = _make(scenes_root, "push_block")
    env.reset(seed=0)
    goal = env.unwrapped.task_object.goal[0].tolist()
    _teleport(env, BLOCK, (goal[0], goal[1], 0.401))
    assert _settle(env, 30)["success"]
    from mani_skill.utils.structs.pose import Pose

    actor = env.unwrapped.builder.objects[BLOCK].actor
    lying = Pose.create_from_pq(
        torch.tensor([[goal[0], goal[1], 0.475]]), torch.tensor([[0.7071, 0.7071, 0, 0]])
    )
    actor.set_pose(lying)
    info = _settle(env, 30)
    assert not info["is_upright"]
    assert not info["success"]
    env.close()


def test_things_are_moved_about_by_seed_and_may_be_anywhere_but_home(scenes_root: Path) -> None:
    env = _make(scenes_root, "rearrange")
    task = env.unwrapped.task_object

    def places(seed: int) -> np.ndarray:
        env.reset(seed=seed)
        return np.concatenate([env.unwrapped.measures.position(stage.subject) for stage in task.stages])

    first = places(3)
    np.testing.assert_array_equal(first, places(3))
    assert np.abs(first - places(4)).max() > 0.02
    homes = np.array([task.facts.targets[stage.subject].center for stage in task.stages])
    assert np.linalg.norm(first - homes, axis=1).min() > 0.07
    np.testing.assert_allclose(first[:, 2], homes[:, 2], atol=1e-4)
    env.close()


def test_oracles_refuse_what_they_cannot_drive(scenes_root: Path) -> None:
    env = _make(scenes_root, "pick_cube")
    with pytest.raises(UsageError, match="control_mode='pd_ee_delta_pose'"):
        Oracle(env)
    env.close()
    with pytest.raises(UsageError, match="does not drive"):
        _make(scenes_root, "navigate_shelf")
