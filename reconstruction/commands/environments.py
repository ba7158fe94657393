"""Verbs about environments, whose work lives in `simrecon_envs`: this package parses, that one runs.

`reconstruction` never imports `simrecon_envs`; the command line is the one place where a person crosses over, so
its runners are found by their names, when a verb was chosen.
"""

import argparse
from collections.abc import Callable
from importlib import import_module


def run_by_name(name: str) -> Callable[[argparse.Namespace], int]:
    """Return what runs a verb: the function `module:function`, imported when it is called."""
    module, function = name.split(":")

    def run(arguments: argparse.Namespace) -> int:
        return getattr(import_module(module), function)(arguments)

    return run
