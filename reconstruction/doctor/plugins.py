"""Checks of backends that other packages register (`reconstruction.core.plugins`)."""

import dataclasses

from reconstruction.config import PipelineConfig
from reconstruction.core.plugins import GROUP, Plugin, built_in_names, installed_plugins
from reconstruction.doctor.check import Check
from registry.errors import EnvironmentMissing

_TASKS = "tasks"  # kinds of tasks: simrecon_envs/tasks/kinds.py


def plugin_checks() -> list[Check]:
    """Import every installed plugin; return one check for each."""
    return [_check(plugin) for plugin in installed_plugins()]


def _check(plugin: Plugin) -> Check:
    name, detail = f"{plugin.option}={plugin.name}", f"{plugin.distribution}, {plugin.entry.value}"
    if plugin.option == _TASKS:
        return _imported(f"tasks of {plugin.name}", plugin)
    accepting = pluggable_options()
    if plugin.option not in accepting:
        fix = f"its entry points are in the group {GROUP}{plugin.option}; use {GROUP} and one of {', '.join(accepting)}"
        return Check(name, False, f"{detail}: there is no such option", fix, False)
    if plugin.name in accepting[plugin.option]:
        return Check(name, False, f"{detail}: the name is built in", "give it another name", False)
    return _imported(name, plugin)


def _imported(name: str, plugin: Plugin) -> Check:
    try:
        plugin.load()
    except EnvironmentMissing as error:
        return Check(name, False, str(error), f"repair or reinstall {plugin.distribution}", False)
    return Check(name, True, f"{plugin.distribution}, {plugin.entry.value}", "", False)


def pluggable_options() -> dict[str, tuple[str, ...]]:
    """Return the options that accept plugins, with their built-in values."""
    config = PipelineConfig()
    out = {}
    for stage in dataclasses.fields(config):
        options = getattr(config, stage.name)
        for field in dataclasses.fields(options):
            if names := built_in_names(type(options), field.name):
                out[f"{stage.name}.{field.name}"] = names
    return out
