"""Tasks that the scene graph of a bundle suggests: one class per kind, listed in `KINDS`.

docs/extending.md shows how to add a kind, from this package or from another one.
"""

from simrecon_envs.tasks.base import Task
from simrecon_envs.tasks.kinds import KINDS, load_installed, register_task
from simrecon_envs.tasks.names import list_specs, parse_task, unknown_task
from simrecon_envs.tasks.pick import PickTaskConfig
from simrecon_envs.tasks.sequence import Sequence
from simrecon_envs.tasks.spec import TaskSpec


def kind_of(spec: TaskSpec) -> type[Task]:
    """Return the class of a task."""
    return Sequence if spec.kind == "sequence" else KINDS[spec.kind]


__all__ = [
    "KINDS",
    "PickTaskConfig",
    "Task",
    "TaskSpec",
    "kind_of",
    "list_specs",
    "parse_task",
    "register_task",
    "unknown_task",
]

load_installed()  # last: these modules import this package
