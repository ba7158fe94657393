"""Tasks and policies that the page offers for a scene."""

from pathlib import Path

from registry import SceneBundle, open_registry
from registry.errors import UsageError

KINDS: tuple[str, ...] = ("pick", "reach", "place", "put", "stack", "push", "rearrange", "navigate")
"""Kinds of tasks, without the import of the simulator; the scene's easiest task of a kind is taken."""
ROBOTS: tuple[str, ...] = ("panda", "panda_wristcam", "fetch", "so100", "koch-v1.1")
SCRIPT, STILL, RANDOM = "script", "nothing (still)", "random"
TRAINED = "trained: "
_POLICIES = {SCRIPT: "oracle", STILL: "still", RANDOM: "random"}


def tasks_of(scene: str, registry: str, revision: str, robot: str) -> tuple[str, ...]:
    """Return the names of the tasks that a robot can likely do in a scene, the easiest of each kind first.

    Imports torch: call it in a process of its own.
    """
    from simrecon_envs.robots import check_robot
    from simrecon_envs.tasks import list_specs
    from simrecon_envs.tasks.facts import scene_facts

    check_robot(robot)
    folder = open_registry(registry).scenes_folder / scene / revision
    facts = scene_facts(SceneBundle.open(folder, check_hashes=False), robot)
    return tuple(spec.name for spec in list_specs(facts) if not spec.problems)


def policy_names(scene: str) -> tuple[str, ...]:
    """Return the policies that the page offers: the script, none, random, and trained ones of the scene."""
    return (*_POLICIES, *(f"{TRAINED}{path.name}" for path in trained_runs(scene)))


def policy_of(name: str, scene: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return the name and arguments of a policy for `simrecon benchmark run`, by its name in the page.

    Raises:
        UsageError: the training run no longer exists.
    """
    if name in _POLICIES:
        return _POLICIES[name], ()
    for path in trained_runs(scene):
        if name == f"{TRAINED}{path.name}":
            return "simrecon_envs.training:trained", (("run", str(path)),)
    raise UsageError(f"{name}: there is no such training run of {scene} any more")


def task_of_run(name: str, scene: str) -> tuple[str, str] | None:
    """Return (task, robot) that a trained policy was trained for; None for other policies."""
    from simrecon_envs.training.folder import RunFolder

    for path in trained_runs(scene):
        if name == f"{TRAINED}{path.name}":
            config = RunFolder.open(path).read_config()["config"]
            return str(config["task"]), str(config["robot"])
    return None


def trained_runs(scene: str) -> list[Path]:
    """Return the folders of training runs of a scene that have a checkpoint, the latest first."""
    from simrecon_envs.training.folder import RunFolder, runs_root

    found = []
    for path in runs_root().glob("*"):
        try:
            entry = RunFolder(path).read_config()
            if entry["config"]["scene"] == scene and RunFolder(path).checkpoints():
                found.append((entry["began"], path))
        except (UsageError, KeyError):  # not a run, or of another version
            continue
    return [path for _, path in sorted(found, reverse=True)]
