"""Backends from installed packages: the name that an option has in, the callable registered under that name out.

A package registers a backend as an entry point of the group `simrecon.<option>`, such as `simrecon.instances.masks`.
Options that accept registered names have the type `Literal[<built-in names>] | str`. docs/extending.md lists them, with
the arguments of each callable.
"""

import dataclasses
import hashlib
import typing
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from registry.errors import EnvironmentMissing, UsageError, did_you_mean

GROUP = "simrecon."


@dataclass(frozen=True)
class Plugin:
    """A backend that an installed package registers."""

    option: str  # stage.field
    name: str  # value of the option
    distribution: str  # name and version
    entry: EntryPoint

    def __str__(self) -> str:
        return f"{self.option}={self.name} of {self.distribution}"

    def load(self) -> Callable[..., Any]:
        """Import the callable.

        Raises:
            EnvironmentMissing: the import fails.
        """
        try:
            return self.entry.load()
        except Exception as error:
            raise EnvironmentMissing(
                f"{self}: {self.entry.value} cannot be imported ({type(error).__name__}: {error}). Repair or reinstall "
                f"that package, or choose another value of {self.option}"
            ) from error

    def digest(self) -> str:
        """Return the SHA-256 of the Python files of the package that holds the callable; "" if there is none."""
        spec = find_spec(self.entry.module.partition(".")[0])
        if spec is None:
            return ""
        folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
        files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
        digest = hashlib.sha256()
        for file in files or [Path(str(spec.origin))]:
            digest.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
        return digest.hexdigest()


def installed_plugins() -> list[Plugin]:
    """Return the plugins of all installed packages, by option and name."""
    found = [
        Plugin(entry.group.removeprefix(GROUP), entry.name, _distribution(entry), entry)
        for group in entry_points().groups
        if group.startswith(GROUP)
        for entry in entry_points(group=group)
    ]
    return sorted(found, key=str)


def built_in_names(config_type: type, field: str) -> tuple[str, ...]:
    """Return the built-in values of a config field that accepts plugins; empty if it accepts none."""
    hint = typing.get_type_hints(config_type).get(field)
    members = typing.get_args(hint)
    literals = [member for member in members if typing.get_origin(member) is Literal]
    return typing.get_args(literals[0]) if literals and str in members else ()


def find_plugin(option: str, name: str, config_type: type) -> Plugin | None:
    """Return the plugin that is registered under a name; None where the name is built in.

    Args:
        option: stage.field.
        name: its value.
        config_type: the config with the field.

    Raises:
        UsageError: the name is neither built in nor registered, or several packages register it.
    """
    built_in = built_in_names(config_type, option.partition(".")[2])
    if name in built_in:
        return None
    others = [plugin for plugin in installed_plugins() if plugin.option == option]
    found = [plugin for plugin in others if plugin.name == name]
    if len(found) == 1:
        return found[0]
    if found:
        owners = " and ".join(plugin.distribution for plugin in found)
        raise UsageError(f"{option}={name} is registered by {owners}; uninstall all but one of them")
    registered = ", ".join(f"{plugin.name} ({plugin.distribution})" for plugin in others)
    raise UsageError(
        f"{option}={name}: there is no such backend. Built in: {', '.join(built_in)}. From installed packages: "
        f"{registered or 'none'}.{did_you_mean(name, [*built_in, *(plugin.name for plugin in others)])}"
    )


def load_plugin(option: str, name: str, config_type: type) -> Callable[..., Any]:
    """Return the callable that an installed package registers for a value of an option that is not built in.

    Args:
        option: stage.field.
        name: its value.
        config_type: the config with the field.

    Raises:
        UsageError: no installed package registers the name, or several do.
        EnvironmentMissing: the package that does cannot be imported.
    """
    plugin = find_plugin(option, name, config_type)
    assert plugin is not None, f"{option}={name} is built in"
    return plugin.load()


def plugins_of(stage: str, config: Any) -> list[Plugin]:
    """Return the plugins that the options of a stage name.

    Raises:
        UsageError: an option names a backend that is neither built in nor registered.
    """
    out = []
    for field in dataclasses.fields(config):
        if built_in_names(type(config), field.name):
            plugin = find_plugin(f"{stage}.{field.name}", getattr(config, field.name), type(config))
            out += [] if plugin is None else [plugin]
    return out


def _distribution(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown package"
