"""Verbs that `simrecon_envs` runs.

`reconstruction` does not import `simrecon_envs`: the functions of such verbs are imported by name when the verb runs.
"""

import argparse
from collections.abc import Callable
from importlib import import_module


def run_by_name(name: str) -> Callable[[argparse.Namespace], int]:
    """Return a function that imports `module:function` when it is called, and calls it with the arguments."""
    module, function = name.split(":")

    def run(arguments: argparse.Namespace) -> int:
        return getattr(import_module(module), function)(arguments)

    return run
