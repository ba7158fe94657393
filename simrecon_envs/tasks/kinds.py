"""`KINDS`: all kinds of single tasks by name, in listing order. Other packages add to it by `register_task`."""

import re
from importlib.metadata import entry_points

from registry import UsageError
from simrecon_envs.tasks.base import Task
from simrecon_envs.tasks.navigate import Navigate
from simrecon_envs.tasks.pick import Pick
from simrecon_envs.tasks.place import Place
from simrecon_envs.tasks.push import Push
from simrecon_envs.tasks.put import Put
from simrecon_envs.tasks.reach import Reach
from simrecon_envs.tasks.rearrange import Rearrange
from simrecon_envs.tasks.stack import Stack

ENTRY_POINTS = "simrecon.tasks"  # group of installed packages' entry points; each names a module with tasks

KINDS: dict[str, type[Task]] = {
    kind.kind: kind for kind in (Reach, Pick, Place, Put, Stack, Push, Rearrange, Navigate)
}


def register_task(kind: type[Task]) -> type[Task]:
    """Add a kind of task to `KINDS`; a class decorator.

    A class takes the place of an earlier one from the same module with the same name, so modules can be reloaded.

    Raises:
        UsageError: `kind.kind` is not one lower-case word, is reserved, or is the name of another class.
    """
    name, mine = kind.kind, f"{kind.__module__}.{kind.__qualname__}"
    if not re.fullmatch(r"[a-z][a-z0-9]*", name) or name in ("none", "sequence"):
        raise UsageError(f"{mine}: kind {name!r}: expected one lower-case word other than none and sequence")
    known = KINDS.get(name, kind)
    if (theirs := f"{known.__module__}.{known.__qualname__}") != mine:
        raise UsageError(f"{mine}: kind {name!r} is taken by {theirs}; choose another name")
    KINDS[name] = kind
    return kind


def load_installed() -> None:
    """Import the modules that installed packages list as entry points; they call `register_task`."""
    for entry in entry_points(group=ENTRY_POINTS):
        entry.load()
