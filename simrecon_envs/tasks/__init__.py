"""Tasks that a scene's graph suggests: one module a kind, listed in `KINDS`.

To add a kind: write a class like those here and add it to `KINDS`; ids, listing, errors, the environment, the
oracle and the tests take it from there.
"""

from simrecon_envs.tasks.base import Task
from simrecon_envs.tasks.navigate import Navigate
from simrecon_envs.tasks.pick import Pick, PickTaskConfig
from simrecon_envs.tasks.place import Place
from simrecon_envs.tasks.push import Push
from simrecon_envs.tasks.put import Put
from simrecon_envs.tasks.reach import Reach
from simrecon_envs.tasks.rearrange import Rearrange
from simrecon_envs.tasks.sequence import Sequence
from simrecon_envs.tasks.spec import TaskSpec, list_specs, parse_task, unknown_task
from simrecon_envs.tasks.stack import Stack

KINDS: dict[str, type[Task]] = {
    kind.kind: kind for kind in (Reach, Pick, Place, Put, Stack, Push, Rearrange, Navigate)
}


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
