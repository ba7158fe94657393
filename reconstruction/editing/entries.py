"""Validation of the entries of an overrides file, and the stage that applies each of their actions."""

from typing import Any

from reconstruction.editing.addresses import KINDS, parse_address, parse_addresses, parse_parts, vector
from reconstruction.editing.moves import parse_move
from reconstruction.editing.outlines import parse_add
from reconstruction.editing.scene_entries import parse_scene_entry
from reconstruction.editing.sizes import parse_size
from registry.errors import UsageError, did_you_mean

# Actions of an entry, by the stage that applies them.
ACTIONS: dict[str, tuple[str, ...]] = {
    "world": ("scale", "up", "floor"),
    "instances": ("add", "relabel", "drop", "merge", "split", "make_base"),
    "assets": ("mass_kg", "material", "friction", "mesh", "size_m", "move", "drop_to_surface"),
    "scene_graph": ("parent",),
    "assembly": ("dynamic",),
}
_ADDRESS = ("id", "near", "at", "pixel")
_BESIDE = {"parent": ("relation",)}  # keys that belong to an action
_ALONE = ("merge", "add")  # actions without an address, one to an entry
_NOT_WITH = {  # of the first there is no thing left, or several, for the others
    "drop": (
        "make_base",
        "split",
        "relabel",
        "mass_kg",
        "material",
        "friction",
        "mesh",
        "size_m",
        "move",
        "parent",
        "dynamic",
    ),
    "make_base": ("split", "relabel", "mass_kg", "material", "friction", "mesh", "size_m", "move", "dynamic"),
}
_LONGEST_LABEL, _LONGEST_TEXT = 100, 4096


def part_of_stage(entry: dict, stage: str) -> dict:
    """Return the part of an entry that a stage applies: its actions, what belongs to them, and the address."""
    actions = [action for action in ACTIONS.get(stage, ()) if action in entry]
    wanted = {*actions, *_ADDRESS, *(key for action in actions for key in _BESIDE.get(action, ()))}
    return {key: value for key, value in entry.items() if key in wanted} if actions else {}


def check_entry(entry: Any, where: str) -> None:
    """Raise UsageError for an entry that no stage can apply; the message starts with `where`."""
    allowed = [action for actions in ACTIONS.values() for action in actions]
    if not isinstance(entry, dict):
        raise UsageError(f"{where}: expected a mapping such as {{id: 3, relabel: mug}}, got {entry!r}")
    known = {*allowed, *_ADDRESS, *(key for keys in _BESIDE.values() for key in keys)}
    unknown = sorted(map(str, set(entry) - known))
    if unknown:
        raise UsageError(
            f"{where}: unknown {', '.join(map(repr, unknown))}; an entry may have {', '.join(allowed)}"
        )
    if not set(entry) & set(allowed):
        raise UsageError(f"{where}: has no action; use one of {', '.join(allowed)}")
    if set(entry) & set(ACTIONS["world"]):
        parse_scene_entry(entry, where)
        return
    _check_addresses(entry, where)
    _check_values(entry, where)


def _check_values(entry: dict, where: str) -> None:
    """Raise UsageError for an action with a value that it cannot have."""
    for name in ("mass_kg", "friction"):
        value = entry.get(name, 1.0)
        if isinstance(value, bool) or not (isinstance(value, int | float) and 0 < value < 1e5):
            raise UsageError(f"{where}: {name} must be a positive number, got {value!r}")
    for name in ("material", "mesh", "relabel"):
        if name in entry:
            _check_text(
                entry[name], f"{where}: {name}", _LONGEST_LABEL if name == "relabel" else _LONGEST_TEXT
            )
    if "material" in entry:
        _check_material(entry["material"], where)
    if entry.get("drop", True) is not True:
        raise UsageError(f"{where}: drop must be true, got {entry['drop']!r}; leave it out to keep the thing")
    if not isinstance(entry.get("dynamic", True), bool):
        raise UsageError(f"{where}: dynamic must be true or false, got {entry['dynamic']!r}")
    if entry.get("drop_to_surface", True) is not True:
        raise UsageError(
            f"{where}: drop_to_surface must be true, got {entry['drop_to_surface']!r}; leave it out to keep the thing "
            "where it is"
        )
    if "size_m" in entry:
        parse_size(entry["size_m"], f"{where}: size_m")
    if "move" in entry:
        parse_move(entry["move"], f"{where}: move")
    if entry.get("relation", "supported_by") not in ("supported_by", "attached_to"):
        raise UsageError(f"{where}: relation must be supported_by or attached_to")


def _check_addresses(entry: dict, where: str) -> None:
    """Raise UsageError for an entry without a valid address."""
    for action in _ALONE:
        if action in entry and set(entry) != {action}:
            raise UsageError(
                f"{where}: {action} cannot be combined with other keys; use another entry after it"
            )
    clicked = isinstance(entry.get("split"), list)
    if clicked:
        parse_parts(entry["split"], f"{where}: split")
    if "merge" in entry:
        parse_addresses(entry["merge"], f"{where}: merge", fewest=2)
    elif "add" in entry:
        parse_add(entry["add"], f"{where}: add")
    elif not (clicked and not set(entry) & set(KINDS)):
        parse_address(entry, where)
    if "split" in entry and not clicked:
        _check_plane(entry["split"], f"{where}: split")
    if "make_base" in entry:
        _check_base(entry["make_base"], where)
    for action, others in _NOT_WITH.items():
        beside = [other for other in others if action in entry and other in entry]
        if beside:
            raise UsageError(f"{where}: {action} cannot be combined with {beside[0]}; keep one of the two")
    if "parent" in entry:
        parse_address(entry["parent"], f"{where}: parent")


def _check_plane(value: Any, where: str) -> None:
    """Raise UsageError for a split that is no plane."""
    if not isinstance(value, dict) or set(value) != {"point", "normal"}:
        parse_parts(value, where)  # its message shows both forms
    if isinstance(value["point"], dict):
        parse_address(value["point"], f"{where}: point")
    else:
        vector(value["point"], f"{where}: point")
    if not any(vector(value["normal"], f"{where}: normal")):
        raise UsageError(f"{where}: normal {value['normal']!r} has no direction")


def _check_text(value: Any, where: str, longest: int) -> None:
    if not isinstance(value, str):
        raise UsageError(f"{where} must be text (in quotes if YAML reads it otherwise), got {value!r}")
    if not value.strip() or len(value) > longest or not value.isprintable():
        raise UsageError(f"{where} must be one line of at most {longest} characters, got {value!r}")


def _check_base(label: Any, where: str) -> None:
    from reconstruction.instances.base import BASE_LABELS

    if label not in BASE_LABELS:
        raise UsageError(f"{where}: make_base must be one of {', '.join(BASE_LABELS)}, got {label!r}")


def _check_material(name: str, where: str) -> None:
    from reconstruction.assets.physics.materials import MATERIALS

    if name not in MATERIALS:
        raise UsageError(
            f"{where}: no material {name!r}; there are {', '.join(sorted(MATERIALS))}"
            + did_you_mean(name, MATERIALS)
        )
