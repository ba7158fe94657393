"""Options of environments: randomization, cameras, vectorization, many scenes, invalid actions."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from made_scenes import BLOCK, BOX, CRATE, CUBE, CYLINDER, TABLE, BundleWriter, add_room, box

import simrecon_envs
from registry import SceneNotFound, SceneRegistry, UsageError
from simrecon_envs.layout_randomization import GAP_M, about, gap, group_things
from simrecon_envs.multi import split_of
from simrecon_envs.randomization import Randomization


def _make(root: Path, scene: str = "things", **kwargs: object) -> gym.Env:
    return simrecon_envs.make(scene, registry=root, **kwargs)


def _outline(env: gym.Env, key: int) -> np.ndarray:
    """Return the current outline (h, 2) of an object."""
    scene = env.unwrapped
    item = next(o for o in scene.bundle.objects if o.id == key)
    stacks = [stack for group in scene._randomizer._groups for stack in group.stacks]
    hull = next(stack.hull for stack in stacks if key in stack.members)
    now = scene.builder.objects[key].actor.pose.to_transformation_matrix()[0].numpy()
    move = now @ np.linalg.inv(item.world_from_object)
    return hull @ move[:2, :2].T + move[:2, 3]


def test_poses_stay_on_their_support_and_apart(scenes_root: Path) -> None:
    env = _make(scenes_root, randomize={"shift_m": 0.10, "turn_rad": 1.0})
    keys = (CUBE, CYLINDER, BLOCK, CRATE)
    seen = []
    for seed in range(12):
        env.reset(seed=seed)
        hulls = [_outline(env, key) for key in keys]
        seen.append(np.concatenate(hulls))
        for number, hull in enumerate(hulls):
            assert np.abs(hull - [0, 0.9]).max(axis=0)[0] < 0.6 + 0.01
            assert np.abs(hull - [0, 0.9]).max(axis=0)[1] < 0.4 + 0.01
            assert all(gap(hull, other) >= GAP_M for other in hulls[:number])
        for _ in range(3):
            env.step(None)
        heights = [float(env.unwrapped.measures.position(key)[0, 2]) for key in env.unwrapped.movable_ids]
        expected = [env.unwrapped.facts.targets[key].center[2] for key in env.unwrapped.movable_ids]
        np.testing.assert_allclose(heights, expected, atol=1e-3)
    assert np.std(seen, axis=0).min() > 0.01  # every object moved
    env.close()


def _add_bumpy_table(writer: BundleWriter) -> None:
    """Add a table that is 4 mm higher where x > 0.1 m."""
    table = np.eye(4)
    table[:2, 3] = 0, 0.9
    parts = [box((1.2, 0.8, 0.4)), box((0.5, 0.8, 0.404), at=(0.35, 0.0))]
    writer.add_object(TABLE, "table", parts, table, 1, mass=20, dynamic=False)


def _lamp_on_bumpy_table(folder: Path) -> Path:
    """Publish a scene "lamp": a lamp whose top is over a cube, and a block."""
    writer = BundleWriter(folder / "made")
    add_room(writer)
    _add_bumpy_table(writer)
    post, top, cube, block = (
        np.eye(4),
        [box((0.04, 0.04, 0.2)), box((0.2, 0.2, 0.02), 0.2)],
        np.eye(4),
        np.eye(4),
    )
    post[:3, 3], cube[:3, 3], block[:3, 3] = (-0.3, 0.8, 0.4), (-0.23, 0.8, 0.4), (0.05, 1.0, 0.4)
    writer.add_object(BLOCK, "lamp", top, post, TABLE)
    writer.add_object(CUBE, "cube", [box((0.05, 0.05, 0.06))], cube, TABLE)
    writer.add_object(CYLINDER, "block", [box((0.06, 0.06, 0.08))], block, TABLE)
    writer.seal("lamp")
    SceneRegistry(folder / "registry", create=True).publish(writer.folder, "lamp")
    return folder / "registry"


def test_what_leans_over_another_moves_with_it_and_nothing_is_thrown(tmp_path: Path) -> None:
    config = {"shift_m": 0.15, "turn_rad": 0.5}
    env = _make(_lamp_on_bumpy_table(tmp_path), "lamp", randomize=config, task="none")
    scene = env.unwrapped
    assert [group.members for group in scene._randomizer._groups] == [(CYLINDER,), (BLOCK, CUBE)]
    lamp, cube, block = (scene.movable_ids.index(key) for key in (BLOCK, CUBE, CYLINDER))
    gaps, heights, moved = [], [], []
    for seed in range(20):
        env.reset(seed=seed)
        gaps.append(gap(_outline(env, BLOCK), _outline(env, CUBE)))
        start = scene.measures.poses[0, :, :3].copy()
        heights.append(start[block, 2])
        moved.append(start[[lamp, cube, block], :2])
        for _ in range(10):
            env.step(np.zeros(env.action_space.shape, np.float32))
        scene.measures.refresh()
        assert np.linalg.norm(scene.measures.poses[0, :, :3] - start, axis=1).max() < 0.006
    np.testing.assert_allclose(gaps, gaps[0], atol=2e-4)  # after the settle check
    assert min(heights) == pytest.approx(0.4, abs=1e-4)
    assert max(heights) == pytest.approx(0.404, abs=1e-3)  # where the table is higher
    assert np.std(moved, axis=0).min() > 0.01
    env.close()


def _posts_on_bumpy_table(folder: Path) -> Path:
    """Publish a scene "posts": two posts that tip over on a step of 4 mm."""
    writer = BundleWriter(folder / "made")
    add_room(writer)
    _add_bumpy_table(writer)
    for key, y in ((BLOCK, 0.8), (CUBE, 1.0)):
        start = np.eye(4)
        start[:3, 3] = 0.06, y, 0.4
        writer.add_object(key, f"post {key}", [box((0.03, 0.03, 0.3))], start, TABLE)
    writer.seal("posts")
    SceneRegistry(folder / "registry", create=True).publish(writer.folder, "posts")
    return folder / "registry"


def test_what_would_fall_where_it_is_moved_stands_as_it_was_captured(tmp_path: Path) -> None:
    env = _make(_posts_on_bumpy_table(tmp_path), "posts", randomize={"shift_m": 0.06}, task="none")
    scene = env.unwrapped
    bodies = {placed.id: placed.actor._bodies[0] for placed in scene.builder.movable_actors}
    homes = {item.id: item.world_from_object for item in scene.bundle.objects}
    back, away = 0, 0
    for seed in range(40):
        env.reset(seed=seed)
        assert all(body.is_sleeping for body in bodies.values())
        start = {key: body.entity.pose for key, body in bodies.items()}
        for key, pose in start.items():
            at_home = np.allclose(pose.to_transformation_matrix(), homes[key], atol=1e-6)
            assert at_home or key not in scene._randomizer.returned
            back += key in scene._randomizer.returned
            away += not at_home
        for body in bodies.values():
            body.wake_up()
        for _ in range(20):
            env.step(np.zeros(env.action_space.shape, np.float32))
        for key, body in bodies.items():
            assert np.linalg.norm((start[key].inv() * body.entity.pose).p) < 0.005
    assert back >= 5
    assert away >= 30
    env.close()


def test_what_stands_in_the_place_of_what_fell_goes_back_too(tmp_path: Path) -> None:
    env = _make(_posts_on_bumpy_table(tmp_path), "posts", randomize={"shift_m": 0.06}, task="none")
    randomizer = env.unwrapped._randomizer
    first, second = randomizer._groups
    randomizer._moved = [first, second]
    for there, back in ((first, [first, second]), (second, [first])):
        randomizer._places = {
            id(first): [hull - np.array([0.2, 0]) for hull in first.outlines],
            id(second): [hull + np.array([0.01, 0]) for hull in there.outlines],
        }
        found = randomizer.fallen_groups({first.members[0]})
        assert [group.members for group in found] == [group.members for group in back]
    env.close()


def test_a_settled_start_does_not_depend_on_earlier_episodes(scenes_root: Path) -> None:
    env = _make(scenes_root, randomize="start")
    runs = []
    for seeds in ((5,), (1, 2, 5), (5,)):
        for seed in seeds:
            obs, _ = env.reset(seed=seed)
            env.action_space.seed(seed)
            run = [obs, *(env.step(env.action_space.sample())[0] for _ in range(20))]
        runs.append(torch.cat(run))
    env.close()
    fresh = _make(scenes_root, randomize="start")
    obs, _ = fresh.reset(seed=5)
    fresh.action_space.seed(5)
    runs.append(torch.cat([obs, *(fresh.step(fresh.action_space.sample())[0] for _ in range(20))]))
    fresh.close()
    assert all(torch.equal(run, runs[0]) for run in runs)


def test_nothing_is_moved_to_where_the_robot_is(scenes_root: Path) -> None:
    scene = _make(scenes_root, randomize="start", task="none").unwrapped
    cube, robot = (
        next(s for g in scene._randomizer._groups for s in g.stacks if CUBE in s.members),
        np.zeros((1, 3)),
    )
    robot[0, 2] = cube.height[0] + 0.01
    for side, free in ((0.01, False), (0.05, True)):
        right, middle = cube.hull[:, 0].max(), cube.hull[:, 1].mean()
        robot[0, :2] = right + 0.02 + side, middle
        group = next(g for g in group_things(scene.facts, robot) if CUBE in g.members)
        places = {id(other): other.outlines for other in group.others}
        move = group.move(about(group.center, np.array([0.02, 0]), 0.0), places)
        assert (move is not None) == free
    scene.close()


def test_what_stands_on_a_thing_moves_with_it(scenes_root: Path) -> None:
    env = _make(scenes_root, "room", randomize={"shift_m": 0.05})
    assert [group.members for group in env.unwrapped._randomizer._groups] == [(10,), (11,), (14,)]
    env.close()


def test_mass_and_friction_stay_within_the_ranges_of_the_bundle(scenes_root: Path) -> None:
    env = _make(scenes_root, randomize={"mass": 1.0, "friction": 1.0})
    scene = env.unwrapped
    ranges = {"mass_kg": [0.1, 0.6], "friction": [0.5, 0.9]}
    scene._randomizer._entries[CUBE]["ranges"] = ranges
    body = scene.builder.objects[CUBE].actor._bodies[0]
    inertia = np.array(body.inertia) / body.mass
    masses, frictions = [], []
    for seed in [*range(30), 7]:
        env.reset(seed=seed)
        masses.append(body.mass)
        frictions.append(body.collision_shapes[0].physical_material.static_friction)
        np.testing.assert_allclose(np.array(body.inertia) / body.mass, inertia, rtol=1e-3)
    for values, name in ((masses, "mass_kg"), (frictions, "friction")):
        low, high = ranges[name]
        assert low - 1e-6 <= min(values) < max(values) <= high + 1e-6
        assert max(values) - min(values) > 0.6 * (high - low)
        assert values[7] == values[-1]
    other = scene.builder.objects[BLOCK].actor._bodies[0]
    assert other.mass == pytest.approx(0.8)  # without ranges, it does not change
    env.close()


def test_randomized_runs_are_identical_by_seed(scenes_root: Path) -> None:
    env = _make(scenes_root, randomize="all", task="push_block")
    traces = []
    for _ in range(2):
        trace = [env.reset(seed=5)[0].clone()]
        env.action_space.seed(5)
        trace += [env.step(env.action_space.sample())[0].clone() for _ in range(30)]
        traces.append(torch.stack(trace))
        env.reset(seed=6)  # another episode in between
        for _ in range(30):
            env.step(env.action_space.sample())
    assert torch.equal(*traces)
    assert not torch.equal(traces[0][0], env.reset(seed=6)[0])
    env.close()


@pytest.mark.parametrize(
    "value", ["some", {"shift": 1}, {"mass": 2.0}, {"shift_m": -1}, 3, {"turn_rad": float("nan")}]
)
def test_wrong_randomization_lists_the_fields(value: object) -> None:
    with pytest.raises(UsageError, match=r"shift_m|between 0 and|mass=2|turn_rad"):
        Randomization.parse(value)


def test_wrong_cameras_list_the_names(scenes_root: Path) -> None:
    for value in ("side", ("workspace", "capture:0"), "wrist:2"):
        with pytest.raises(UsageError, match="workspace, overview, wrist, capture"):
            _make(scenes_root, cameras=value)


@pytest.mark.parametrize(
    "action", [np.full(8, np.nan), np.full(8, np.inf), np.zeros(7), np.zeros((2, 8)), np.zeros(())]
)
def test_actions_that_mean_nothing_are_refused(action: np.ndarray, scenes_root: Path) -> None:
    env = _make(scenes_root)
    env.reset(seed=0)
    for wrong in (action, torch.as_tensor(action)):
        with pytest.raises(UsageError, match="action: expected"):
            env.step(wrong)
    env.step(np.full(8, 50.0))  # beyond the bounds: clipped
    env.close()


@pytest.mark.end_to_end
@pytest.mark.render
def test_cameras_show_what_their_names_say_and_randomization_changes_them(scenes_root: Path) -> None:
    env = _make(
        scenes_root, "room", target=BOX, obs_mode="rgb+depth", cameras="wrist,capture:1", randomize="all"
    )  # fmt: skip
    first, _ = env.reset(seed=1)
    cameras = first["sensor_data"]
    assert set(cameras) == {"hand_camera", "capture_0"}
    assert cameras["capture_0"]["rgb"].shape == (1, 128, 171, 3)  # the video's own aspect
    np.testing.assert_allclose(first["sensor_param"]["capture_0"]["intrinsic_cv"][0][:2, :2],
                               np.diag([520 / 480 * 128] * 2), rtol=1e-4)  # fmt: skip
    kept = {name: cameras[name]["rgb"].clone() for name in cameras}
    other, _ = env.reset(seed=2)
    again, _ = env.reset(seed=1)
    for name, picture in kept.items():
        assert torch.equal(again["sensor_data"][name]["rgb"], picture)
        assert (other["sensor_data"][name]["rgb"].float() - picture.float()).abs().mean() > 2
    env.close()


@pytest.mark.parametrize("kind", ["sync", "sb3"])
def test_several_environments_at_once(kind: str, scenes_root: Path) -> None:
    vec = simrecon_envs.make_vec("things", 1, kind=kind, registry=scenes_root, task="reach_cube", seed=3)
    obs = vec.reset() if kind == "sb3" else vec.reset(seed=3)[0]
    single = simrecon_envs.make_cpu("things", registry=scenes_root, task="reach_cube")
    expected, _ = single.reset(seed=3)
    np.testing.assert_array_equal(obs[0], expected)
    out = vec.step(np.zeros((1, *single.action_space.shape), np.float32))
    assert out[0].shape == (1, *single.observation_space.shape)
    vec.close()
    single.close()


@pytest.mark.end_to_end
def test_environments_in_processes_of_their_own(scenes_root: Path) -> None:
    vec = simrecon_envs.make_vec("things", 2, kind="async", registry=scenes_root, task="reach_cube")
    obs, _ = vec.reset(seed=[1, 2])
    assert obs.shape[0] == 2
    vec.close()


def test_wrong_vectors_say_what_is_right(scenes_root: Path) -> None:
    with pytest.raises(UsageError, match="sync, async, sb3"):
        simrecon_envs.make_vec("things", 1, kind="threads", registry=scenes_root)
    with pytest.raises(UsageError, match="at least 1"):
        simrecon_envs.make_vec("things", 0, registry=scenes_root)


def test_many_scenes_in_one_environment(scenes_root: Path) -> None:
    simrecon_envs.register_scenes(scenes_root)
    env = gym.make("SimRecon/Multi-v0", registry=str(scenes_root), task="pick", cache_size=2)
    assert EnvSpec.from_json(env.spec.to_json()).kwargs["task"] == "pick"
    check_env(env.unwrapped, skip_render_check=True)

    def run() -> list[tuple[str, bytes]]:
        resets = [env.reset(seed=4 if number == 0 else None) for number in range(6)]
        return [(info["scene"], obs.tobytes()) for obs, info in resets]

    first = run()
    assert first == run()
    assert {scene for scene, _ in first} == {"room", "things"}
    assert list(env.unwrapped.skipped) == ["bare"]
    assert len(env.unwrapped._made) == 2
    env.unwrapped._size = 1  # then the least recently used one is closed
    env.unwrapped._made.pop("room").close()
    assert env.reset(options={"scene": "room"})[1]["scene"] == "room"
    assert list(env.unwrapped._made) == ["room"]
    assert env.reset(options={"scene": "room"})[1]["scene"] == "room"
    with pytest.raises(UsageError, match="bare: nothing in this scene can move"):
        env.reset(options={"scene": "bare"})
    env.close()
    for kwargs, error, text in (
        ({"split": "dev"}, UsageError, "train, test, all"),
        ({"scenes": "roo"}, SceneNotFound, "room"),
        ({"scenes": ["bare"]}, UsageError, "none of 1 scenes can do the task"),
    ):
        with pytest.raises(error, match=text):
            gym.make("SimRecon/Multi-v0", registry=str(scenes_root), **kwargs)


def test_splits_keep_their_side() -> None:
    names = [f"scene{number:04d}" for number in range(2000)]
    test = [name for name in names if split_of(name) == "test"]
    assert 0.17 < len(test) / len(names) < 0.23
    assert split_of("scene0001") == split_of("scene0001")


def test_the_robot_begins_elsewhere_and_its_fingers_do_not(scenes_root: Path) -> None:
    env = _make(scenes_root, randomize={"joints_rad": 0.05})
    rest = _make(scenes_root).unwrapped
    rest.reset(seed=0)
    home = rest.agent.robot.get_qpos().numpy()[0]
    starts = []
    for seed in (1, 2, 1):
        env.reset(seed=seed)
        starts.append(env.unwrapped.agent.robot.get_qpos().numpy()[0])
        assert 0.01 < np.abs(starts[-1] - home)[:7].max() <= 0.05 + 1e-6
        np.testing.assert_array_equal(starts[-1][7:], home[7:])
    np.testing.assert_array_equal(starts[0], starts[2])
    assert np.abs(starts[0] - starts[1]).max() > 0.01
    np.testing.assert_array_equal(env.unwrapped.movable_ids, rest.movable_ids)
    rest.close()
    env.close()
    assert Randomization.parse("start").joints_rad > 0


def test_a_base_that_drives_begins_where_it_was_placed(scenes_root: Path) -> None:
    env = _make(scenes_root, robot_uids="fetch", task="navigate", randomize="start")
    rest = _make(scenes_root, robot_uids="fetch", task="navigate").unwrapped
    rest.reset(seed=0)
    env.reset(seed=0)
    moved = (env.unwrapped.agent.robot.get_qpos() - rest.agent.robot.get_qpos()).numpy()[0]
    np.testing.assert_array_equal(moved[[0, 1, 2, -2, -1]], 0)
    assert np.abs(moved).max() > 0.01
    rest.close()
    env.close()
