"""Rollouts: poses of objects and robot links, reward and contacts of every step of an episode.

`record` makes one with a policy, `replay` reads one from a ManiSkill trajectory. Both need the simulator and run in a
process of their own (`rollout_process`): torch and ManiSkill stay out of the page's process.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from registry.errors import UsageError
from registry.geometry import matrix_from_quat, quat_from_matrix, rigid
from studio.playing.robot_meshes import LinkPart

_PEDESTAL_COLOR = (0.22, 0.23, 0.25)  # as in `simrecon_envs.scene_builder`
CONTACTS = ("on the target (N)", "on others (N)")


@dataclass(frozen=True)
class RolloutRequest:
    """A rollout to make: of a policy, or of a recorded demonstration."""

    scene: str
    registry: str
    revision: str
    task: str = "pick"
    robot: str = "panda"
    policy: str = "oracle"  # as for `simrecon benchmark run`
    arguments: tuple[tuple[str, str], ...] = ()  # of the policy
    seed: int = 0
    trajectory: str = ""  # a file trajectory.h5: replay it instead
    episode: int = 0  # its row in the file


@dataclass(frozen=True)
class RolloutHead:
    """Facts of a rollout that do not change with time."""

    title: str
    instruction: str
    fps: int
    steps: int  # greatest number of steps
    object_ids: tuple[int, ...]
    target_id: int | None
    link_names: tuple[str, ...]
    link_parts: tuple[tuple[LinkPart, ...], ...]
    pedestal: LinkPart | None  # what the robot stands on, world space; None: the floor or furniture
    has_contacts: bool  # False: a trajectory stores none
    note: str = ""


@dataclass(frozen=True)
class RolloutFrame:
    """State after a step; the first one is that of the reset."""

    object_poses: np.ndarray  # float32 (n, 7): `world_from_object`, position and quaternion wxyz
    link_poses: np.ndarray  # float32 (l, 7): `world_from_link`
    reward: float  # of the step; 0 at the reset
    success: bool
    contacts_n: tuple[float, float]  # contact forces of the robot on the target and on other bodies, newtons


Send = Callable[[Any], None]


def record(request: RolloutRequest, send: Send) -> None:
    """Run a policy for one episode; send the head, then a frame per step.

    Raises:
        SimReconError: there is no such task, policy or run; or the robot's files are missing.
    """
    from simrecon_envs.benchmark.episodes import run_episode
    from simrecon_envs.benchmark.policies import PolicySpec
    from simrecon_envs.registration import episode_steps, make_cpu

    policy = PolicySpec(request.policy, dict(request.arguments))
    steps = episode_steps(request.task)
    env = make_cpu(
        request.scene,
        registry=request.registry,
        revision=request.revision,
        task=request.task,
        robot_uids=request.robot,
        max_episode_steps=steps,
        **_options_of(policy, request),
    )
    try:
        scene: Any = env.unwrapped
        if scene.task_object is None:
            raise UsageError(
                f"task {request.task}: {scene.task_note or 'there is nothing to do in this scene'}"
            )
        actor = policy.make(env)
        watcher = _Watcher(scene)
        name = f"{request.policy}, seed {request.seed}"
        send(watcher.head(f"{scene.task} by {name}", steps, has_contacts=True))

        def on_step(_observation: Any, _action: Any, result: tuple | None) -> None:
            reward = 0.0 if result is None else float(result[1])
            success = result is not None and bool(np.ravel(result[4]["success"])[0])
            send(watcher.frame(reward, success, watcher.contacts_n() if result is not None else (0.0, 0.0)))

        run_episode(env, actor, request.seed, on_step)
    finally:
        env.close()


def replay(request: RolloutRequest, send: Send) -> None:
    """Send the head and the frames of an episode of a ManiSkill trajectory.

    Raises:
        UsageError: the file is absent or damaged, has no such episode or no states, or is of another scene.
    """
    file = Path(request.trajectory).expanduser()
    info, episode, states, rewards, success = _read_trajectory(file, request.episode)
    from simrecon_envs.registration import make_cpu

    kwargs = {key: value for key, value in info.get("env_kwargs", {}).items() if key != "obs_mode"}
    of_scene = str(info.get("env_id", "")).rpartition("/")[2].partition("-")[0]
    if of_scene != request.scene:
        raise UsageError(f"{file}: it was recorded in scene {of_scene!r}, this is {request.scene!r}")
    env = make_cpu(request.scene, registry=request.registry, revision=request.revision, **kwargs)
    try:
        env.reset(seed=int(episode.get("episode_seed") or 0))
        scene: Any = env.unwrapped
        watcher = _Watcher(scene)
        title = f"{scene.task}, demonstration {request.episode} of {file.parent.name}"
        send(watcher.head(title, len(states) - 1, has_contacts=False, note="a trajectory stores no contacts"))
        for step, state in enumerate(states):
            scene.set_state_dict(state)
            reward = float(rewards[step - 1]) if step and rewards is not None else 0.0
            send(watcher.frame(reward, bool(step and success is not None and success[step - 1]), (0.0, 0.0)))
    finally:
        env.close()


def episodes_of(trajectory: Path) -> int:
    """Return the number of episodes in a trajectory.

    Raises:
        UsageError: it is absent or damaged.
    """
    return len(_read_index(Path(trajectory))["episodes"])


class _Watcher:
    """Reads poses and contacts of an environment on the CPU."""

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._placed = list(scene.builder.objects.values())
        self._links = list(scene.agent.robot.links) if scene.agent is not None else []
        self._robot = {_key(link._objs[0]) for link in self._links}
        target = scene.builder.objects.get(scene.target_id) if scene.target_id is not None else None
        self._target = set() if target is None else {_key(body) for body in target.actor._bodies}

    def head(self, title: str, steps: int, *, has_contacts: bool, note: str = "") -> RolloutHead:
        from studio.playing.robot_meshes import link_parts

        scene = self._scene
        return RolloutHead(
            title=title,
            instruction=scene.instruction,
            fps=int(scene.control_freq),
            steps=steps,
            object_ids=tuple(placed.id for placed in self._placed),
            target_id=scene.target_id,
            link_names=tuple(link.name for link in self._links),
            link_parts=tuple(link_parts(scene.agent)) if self._links else (),
            pedestal=_pedestal(scene),
            has_contacts=has_contacts,
            note="; ".join(text for text in (note, scene.task_note) if text),
        )

    def frame(self, reward: float, success: bool, contacts_n: tuple[float, float]) -> RolloutFrame:
        objects = [_of_object(placed) for placed in self._placed]
        links = [_seven(link._objs[0].entity_pose) for link in self._links]
        return RolloutFrame(
            np.array(objects, np.float32).reshape(-1, 7),
            np.array(links, np.float32).reshape(-1, 7),
            reward,
            success,
            contacts_n,
        )

    def contacts_n(self) -> tuple[float, float]:
        """Return the summed contact forces (N) of the robot on the target and on all other bodies, in the last step."""
        physics = self._scene.scene.px
        on_target = on_others = 0.0
        for contact in physics.get_contacts():
            keys = [_key(body) for body in contact.bodies]
            mine = [key in self._robot for key in keys]
            if mine[0] != mine[1]:
                impulse = np.sum([point.impulse for point in contact.points], axis=0)
                force = float(np.linalg.norm(impulse)) / physics.timestep
                if keys[mine.index(False)] in self._target:
                    on_target += force
                else:
                    on_others += force
        return on_target, on_others


def _options_of(policy: Any, request: RolloutRequest) -> dict[str, Any]:
    """Return the arguments of `gym.make` that a policy asks for."""
    from types import SimpleNamespace

    task: Any = SimpleNamespace(
        name=request.task, scene=request.scene, task=request.task, robot=request.robot
    )
    return policy.options(task)


def _read_index(file: Path) -> dict[str, Any]:
    index = file.with_suffix(".json")
    if file.suffix != ".h5" or not file.is_file() or not index.is_file():
        raise UsageError(
            f"{file}: there is no ManiSkill trajectory; name a file trajectory.h5 with its .json, as written by "
            "`simrecon benchmark demos --maniskill`"
        )
    try:
        found = json.loads(index.read_text(encoding="utf-8"))
        if not isinstance(found["episodes"], list):
            raise TypeError
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{index}: it is not the index of a ManiSkill trajectory") from error
    return found


def _read_trajectory(file: Path, row: int) -> tuple[dict, dict, list[dict], Any, Any]:
    """Return env_info, the entry of an episode, its states, rewards and success."""
    import h5py
    from mani_skill.trajectory.utils import dict_to_list_of_dicts

    index = _read_index(file)
    episodes = index["episodes"]
    if not 0 <= row < len(episodes):
        raise UsageError(f"{file}: there is no episode {row}; it has {len(episodes)}, counted from 0")
    try:
        with h5py.File(file, "r") as stored:
            group: Any = stored[f"traj_{episodes[row]['episode_id']}"]
            states = list(_batched(dict_to_list_of_dicts(group["env_states"])))
            rewards = np.array(group["rewards"]) if "rewards" in group else None
            success = np.array(group["success"]) if "success" in group else None
    except (OSError, KeyError) as error:
        raise UsageError(f"{file}: episode {row} cannot be read, or has no states ({error})") from error
    return index.get("env_info", {}), episodes[row], states, rewards, success


def _batched(states: list[dict]) -> Iterator[dict]:
    """Add the axis of parallel environments to states of one environment."""
    import torch

    for state in states:
        yield {
            kind: {name: torch.as_tensor(np.asarray(value))[None] for name, value in group.items()}
            for kind, group in state.items()
        }


def _of_object(placed: Any) -> np.ndarray:
    pose = placed.actor._objs[0].pose
    actor = rigid(matrix_from_quat(np.asarray(pose.q, np.float64)), np.asarray(pose.p, np.float64))
    world_from_object = actor @ placed.actor_from_object
    return np.concatenate([world_from_object[:3, 3], quat_from_matrix(world_from_object[:3, :3])])


def _pedestal(scene: Any) -> LinkPart | None:
    """Return the box of the robot's pedestal, world space; it has no mesh where nothing is rendered."""
    import trimesh

    actor = scene.scene.actors.get("pedestal")
    if actor is None:
        return None
    body = actor._bodies[0]
    shape = body.collision_shapes[0]
    pose = (body.entity.pose * shape.local_pose).to_transformation_matrix()
    box = trimesh.creation.box(2 * np.asarray(shape.half_size), transform=pose)
    return LinkPart(np.asarray(box.vertices, np.float32), np.asarray(box.faces, np.uint32), _PEDESTAL_COLOR)


def _seven(pose: Any) -> np.ndarray:
    return np.concatenate([pose.p, pose.q])


def _key(body: Any) -> int:
    return int(body.entity.per_scene_id)
