"""Tasks that a scene's graph suggests: one module a kind, listed in `kinds.KINDS`.

To add a kind: write a class like those here and add it to `KINDS`; ids, listing, errors, the environment, the
oracle and the tests take it from there.
"""

from simrecon_envs.tasks.base import Task
from simrecon_envs.tasks.kinds import KINDS
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
    "unknown_task",
]
