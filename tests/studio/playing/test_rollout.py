"""Rollouts: what the process sends, against the simulator and against a recorded trajectory."""

import threading

import numpy as np
import pytest
from made_scenes import BOX, TABLE_TOP_M

from registry.errors import UsageError
from registry.geometry import matrix_from_quat
from simrecon_envs.training.config import parse_settings
from studio.playing.rollout import RolloutFrame, RolloutHead, RolloutRequest, record, replay
from studio.playing.rollout_process import RolloutProcess, TasksRequest
from studio.playing.tasks import (
    KINDS,
    RANDOM,
    SCRIPT,
    TRAINED,
    policy_names,
    policy_of,
    task_of_run,
    trained_runs,
)

pytestmark = pytest.mark.env


def where(registry):
    return {
        "scene": "room",
        "registry": str(registry.root),
        "revision": registry.load("room").revision,
    }


@pytest.fixture(scope="module")
def pick(play_registry):
    """A pick of the box by the script: head and frames."""
    got = []
    record(RolloutRequest(**where(play_registry), task="pick_box"), got.append)
    return got[0], got[1:]


def test_a_rollout_begins_at_the_bundles_poses_and_ends_with_success(pick, play_registry):
    head, frames = pick
    assert isinstance(head, RolloutHead)
    assert all(isinstance(frame, RolloutFrame) for frame in frames)
    assert head.target_id == BOX
    for item in play_registry.load("room").objects:
        row = head.object_ids.index(item.id)
        assert frames[0].object_poses[row, :3] == pytest.approx(item.world_from_object[:3, 3], abs=1e-5)
    row = head.object_ids.index(BOX)
    assert frames[-1].success
    assert not frames[0].success
    assert frames[-1].object_poses[row, 2] > TABLE_TOP_M + 0.03
    assert frames[0].reward == 0.0
    assert frames[-1].reward > frames[5].reward


def test_contacts_are_those_of_a_grasp(pick):
    _, frames = pick
    forces = np.array([frame.contacts_n for frame in frames])
    assert (forces[:5] == 0).all()
    assert forces[-1, 0] > 2 * 0.2 * 9.81  # two fingers that hold 200 g press with more than its weight


def test_links_move_as_one_robot(pick):
    head, frames = pick
    hand, finger = (head.link_names.index(name) for name in ("panda_hand", "panda_leftfinger"))
    root = head.link_names.index("panda_link0")
    assert frames[0].link_poses[root] == pytest.approx(frames[-1].link_poses[root], abs=1e-5)
    for frame in frames[::10]:
        apart = frame.link_poses[finger, :3] - frame.link_poses[hand, :3]
        rotation = matrix_from_quat(frame.link_poses[hand, 3:].astype(np.float64))
        local = rotation.T @ apart
        assert local[[0, 2]] == pytest.approx(
            [0.0, 0.0584], abs=1e-3
        )  # the joint of the URDF; it slides along y
        assert 0 <= local[1] <= 0.0405


def test_the_robots_meshes_are_those_of_its_urdf(pick):
    head, _ = pick
    points = np.concatenate([part.vertices for part in head.link_parts[head.link_names.index("panda_hand")]])
    assert np.ptp(points, axis=0) == pytest.approx([0.064, 0.205, 0.092], abs=0.004)
    assert 10_000 < sum(len(part.faces) for parts in head.link_parts for part in parts) < 40_000
    assert not head.link_parts[head.link_names.index("panda_hand_tcp")]


def test_a_robot_that_stands_on_the_table_has_no_pedestal(pick):
    head, frames = pick
    assert frames[0].link_poses[head.link_names.index("panda_link0"), 2] == pytest.approx(
        TABLE_TOP_M, abs=0.005
    )
    assert head.pedestal is None


def test_a_trajectory_is_replayed_as_it_was_recorded(play_registry, tmp_path):
    from simrecon_envs.benchmark.demonstrations_maniskill import TrajectoryFile
    from simrecon_envs.benchmark.episodes import run_episode
    from simrecon_envs.benchmark.policies import CONTROL_MODE, OraclePolicy
    from simrecon_envs.registration import make_cpu

    env = make_cpu(
        "room",
        registry=play_registry.root,
        task="reach_box",
        control_mode=CONTROL_MODE,
        obs_mode="state_dict",
    )
    file = TrajectoryFile(env, tmp_path)
    seen, rewards = [], []

    def watch(_obs, _action, result):
        scene = env.unwrapped
        seen.append(np.concatenate([link._objs[0].entity_pose.p for link in scene.agent.robot.links]))
        rewards.append(0.0 if result is None else float(result[1]))

    episode = run_episode(file.env, OraclePolicy(file.env), 3, watch)
    assert episode.success
    file.end_episode(keep=True)
    file.close()
    env.close()
    got = []
    request = RolloutRequest(**where(play_registry), trajectory=str(tmp_path / "trajectory.h5"))
    replay(request, got.append)
    head, frames = got[0], got[1:]
    assert not head.has_contacts
    assert len(frames) == episode.steps + 1
    assert [frame.reward for frame in frames] == pytest.approx(rewards, abs=1e-5)
    assert frames[-1].success
    for frame, links in zip(frames, seen):
        assert frame.link_poses[:, :3].ravel() == pytest.approx(links, abs=1e-4)
    for wrong, text in (
        ({"episode": 7}, "there is no episode 7; it has 1"),
        ({"trajectory": str(tmp_path / "none.h5")}, "no ManiSkill trajectory"),
    ):
        with pytest.raises(UsageError, match=text):
            replay(
                RolloutRequest(**{**where(play_registry), "trajectory": request.trajectory, **wrong}),
                got.append,
            )


@pytest.mark.end_to_end
def test_a_process_lists_tasks_and_says_why_a_rollout_fails(play_registry):
    assert "pick_box" in run(TasksRequest(**where(play_registry), robot="panda"))[0][0]
    got, failure = run(RolloutRequest(**where(play_registry), task="fly_box"))
    assert got == []
    assert "fly_box" in failure
    got, failure = run(RolloutRequest(**where(play_registry), task="reach_box"))
    assert failure == ""
    assert isinstance(got[0], RolloutHead)
    assert got[-1].success


@pytest.mark.end_to_end
def test_a_trained_policy_acts_in_the_task_that_it_was_trained_for(play_registry, tmp_path, monkeypatch):
    from simrecon_envs.training import TrainConfig, load_policy, runs_root, train

    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path))
    folder = runs_root() / "tiny"
    settings = parse_settings("ppo", ["rollout_steps=60", "batch_size=30", "n_epochs=1", "net_arch=16"])
    root = str(play_registry.root)
    config = TrainConfig(scene="room", registry=root, steps=120, eval_episodes=0, settings=settings)
    train(config, folder, video=False)
    name = f"{TRAINED}tiny"
    assert name in policy_names("room")
    task, robot = task_of_run(name, "room")
    assert robot == "panda"
    policy, arguments = policy_of(name, "room")
    request = RolloutRequest(
        **where(play_registry), task=task, robot=robot, policy=policy, arguments=arguments, seed=5
    )
    got = []
    record(request, got.append)
    again = []
    record(request, again.append)
    assert len(got) == len(again) > 10
    moved = np.abs(got[-1].link_poses - got[1].link_poses).max()
    assert moved > 0.01  # an untrained network moves the arm somewhere
    assert got[-1].link_poses == pytest.approx(again[-1].link_poses, abs=1e-6)
    assert load_policy(folder).steps == 120


def run(request):
    got, ended, done = [], [], threading.Event()

    def end(failure):
        ended.append(failure)
        done.set()

    RolloutProcess(request, got.append, end)
    assert done.wait(120)
    return got, ended[0]


def test_kinds_and_policies_of_the_page_exist():
    from simrecon_envs.benchmark.policies import BUILT_IN
    from simrecon_envs.tasks import KINDS as known

    assert set(KINDS) == set(known)
    assert policy_of(SCRIPT, "room")[0] in BUILT_IN
    assert policy_of(RANDOM, "room")[0] in BUILT_IN
    with pytest.raises(UsageError, match="no such training run"):
        policy_of("trained: gone", "room")
    assert trained_runs("no_such_scene") == []
