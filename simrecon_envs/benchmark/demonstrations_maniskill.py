"""Demonstrations as trajectories of ManiSkill: written by its own `RecordEpisode`, so that all its tools read them.

    python -m mani_skill.trajectory.replay_trajectory --traj-path demos/TASK/trajectory.h5

The id of the environment names the package (`simrecon_envs:SimRecon/room`, with the task as an argument), so that
Gymnasium imports it by itself; the scene is looked for in the default registry of whoever replays (`SIMRECON_HOME`), as
no path is written.
"""

import json
from pathlib import Path

import gymnasium as gym
from mani_skill.utils.wrappers.record import RecordEpisode

from registry import UsageError
from simrecon_envs.files import write_json
from simrecon_envs.registration import env_id

_NAME = "trajectory"
_MACHINE = ("registry", "scene_id", "revision", "render_backend")  # in the id, or of this machine


class TrajectoryFile:
    """The trajectories of one task; `env` records."""

    def __init__(self, env: gym.Env, folder: Path) -> None:
        """Begin `folder`/trajectory.h5 and .json.

        Raises:
            UsageError: there is a trajectory already.
        """
        self._h5, self._json = folder / f"{_NAME}.h5", folder / f"{_NAME}.json"
        if self._h5.exists():
            raise UsageError(f"{self._h5} exists; choose another folder, or remove it")
        self.env = RecordEpisode(
            env,
            str(folder),
            trajectory_name=_NAME,
            save_video=False,
            save_on_reset=False,
            source_type="script",
            source_desc="simrecon_envs.Oracle, a scripted policy that sees the simulation's state",
        )

    def end_episode(self, keep: bool) -> None:
        """Keep or drop the episode that ended."""
        self.env.flush_trajectory(save=keep)

    def close(self) -> list[str]:
        """Finish the files; return them, none where no episode was kept."""
        self.env._h5_file.close()
        if not self._json.exists():
            self._h5.unlink()
            return []
        body = json.loads(self._json.read_text())
        info = body["env_info"]
        info["env_id"] = f"simrecon_envs:{env_id(self.env.unwrapped.scene_id)}"
        kwargs = {key: value for key, value in info["env_kwargs"].items() if key not in _MACHINE}
        info["env_kwargs"] = {**kwargs, "max_episode_steps": info["max_episode_steps"]}
        write_json(self._json, body)
        return [str(self._h5)]
