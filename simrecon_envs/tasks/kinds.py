"""The kinds of single tasks, by name, in the order in which they are listed."""

from simrecon_envs.tasks.base import Task
from simrecon_envs.tasks.navigate import Navigate
from simrecon_envs.tasks.pick import Pick
from simrecon_envs.tasks.place import Place
from simrecon_envs.tasks.push import Push
from simrecon_envs.tasks.put import Put
from simrecon_envs.tasks.reach import Reach
from simrecon_envs.tasks.rearrange import Rearrange
from simrecon_envs.tasks.stack import Stack

KINDS: dict[str, type[Task]] = {
    kind.kind: kind for kind in (Reach, Pick, Place, Put, Stack, Push, Rearrange, Navigate)
}
