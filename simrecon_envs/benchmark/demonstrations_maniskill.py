"""Write demonstrations as ManiSkill trajectories, by its `RecordEpisode`. Its tools can replay them.

    python -m mani_skill.trajectory.replay_trajectory --traj-path demos/TASK/trajectory.h5

The environment id names the package (`simrecon_envs:SimRecon/room`, with the task as an argument), so Gymnasium imports
it. No registry path is written: whoever replays needs the scene in the default registry (`SIMRECON_HOME`).
"""

import json
from pathlib import Path

import gymnasium as gym
from mani_skill.utils.wrappers.record import RecordEpisode

from registry import UsageError
from simrecon_envs.files import write_json
from simrecon_envs.registration import env_id
from simrecon_envs.unwrapped import scene_of

_NAME = "trajectory"
_MACHINE = (
    "registry",
    "scene_id",
    "revision",
    "render_backend",
)  # not written: part of the id, or specific to this machine


class TrajectoryFile:
    """The trajectory file of one task; step its `env` to record."""

    def __init__(self, env: gym.Env, folder: Path) -> None:
        """Create `folder`/trajectory.h5 and .json.

        Raises:
            UsageError: the folder has a trajectory already.
        """
        self._h5, self._json = folder / f"{_NAME}.h5", folder / f"{_NAME}.json"
        if self._h5.exists():
            raise UsageError(f"{self._h5} exists; choose another folder, or remove it")
        self.env = RecordEpisode(
            env,  # pyright: ignore[reportArgumentType] - any wrapper of a BaseEnv will do
            str(folder),
            trajectory_name=_NAME,
            save_video=False,
            save_on_reset=False,
            source_type="script",
            source_desc="simrecon_envs.Oracle, a scripted policy that sees the simulation's state",
        )

    def end_episode(self, keep: bool) -> None:
        """Write or drop the episode that ended."""
        self.env.flush_trajectory(save=keep)

    def close(self) -> list[str]:
        """Finish the files; return the HDF5 file's path, or nothing where no episode was kept."""
        self.env._h5_file.close()
        if not self._json.exists():
            self._h5.unlink()
            return []
        body = json.loads(self._json.read_text())
        info = body["env_info"]
        info["env_id"] = f"simrecon_envs:{env_id(scene_of(self.env).scene_id)}"
        kwargs = {key: value for key, value in info["env_kwargs"].items() if key not in _MACHINE}
        info["env_kwargs"] = {**kwargs, "max_episode_steps": info["max_episode_steps"]}
        write_json(self._json, body)
        return [str(self._h5)]
