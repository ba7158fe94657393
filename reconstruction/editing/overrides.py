"""The user's corrections (`--overrides FILE`), read once, checked at once, and applied by the stage that they concern.

The file is a YAML list; each entry says which thing it means, by `id`, `at` or `pixel`
(`reconstruction.editing.addresses`), and what to do with it. See docs/overrides.md.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from registry.errors import UsageError

if TYPE_CHECKING:
    from reconstruction.core.types import (
        AssetSet,
        InstanceSet,
        ObjectAsset,
        SceneGraph,
    )
    from reconstruction.editing.anchors import Pointer

# What an entry may do, by the stage that does it.
ACTIONS: dict[str, tuple[str, ...]] = {
    "instances": ("relabel", "drop", "merge", "split", "make_base"),
    "assets": ("mass_kg", "material", "friction", "mesh"),
    "scene_graph": ("parent",),
    "assembly": ("dynamic",),
}
_ADDRESS = ("id", "near", "at", "pixel", "relation")


@dataclass(frozen=True)
class Overrides:
    """Checked entries of an overrides file."""

    entries: list[dict] = field(default_factory=list)
    folder: Path = Path()

    @classmethod
    def load(cls, path: Path) -> "Overrides":
        """Read and check an overrides file.

        Raises:
            UsageError: the file is missing or malformed; the message names the entry and what is allowed.
        """
        import yaml

        try:
            entries = yaml.safe_load(Path(path).read_text())
        except OSError as error:
            raise UsageError(f"--overrides {path}: {error.strerror or error}") from error
        except yaml.YAMLError as error:
            raise UsageError(f"--overrides {path}: not valid YAML: {error}") from error
        if entries is None:
            entries = []
        if not isinstance(entries, list):
            raise UsageError(
                f"--overrides {path}: expected a list of entries such as `- {{id: 3, relabel: mug}}`"
            )
        for number, entry in enumerate(entries, start=1):
            _check(entry, f"--overrides {path}: entry {number}")
        return cls(entries, Path(path).resolve().parent)

    def of_stage(self, stage: str) -> list[dict]:
        """Return the entries that change this stage's result."""
        actions = ACTIONS.get(stage, ())
        return [entry for entry in self.entries if any(action in entry for action in actions)]

    def fingerprint_of_stage(self, stage: str) -> list:
        """Return what belongs into a stage's fingerprint: its entries, and the bytes of meshes that they name."""
        from reconstruction.cache import digest_input

        entries = self.of_stage(stage)
        files = [self.folder / str(entry["mesh"]) for entry in entries if "mesh" in entry]
        return [*entries, *(digest_input(file) for file in files if file.exists())]

    def apply_to_instances(self, pointer: "Pointer") -> "InstanceSet":
        """Relabel, drop, merge, split, make base what the pointer's cut holds."""
        from reconstruction.editing.instances import apply_overrides

        return apply_overrides(pointer.found, pointer.surface, self.of_stage("instances"), pointer.footage)

    def apply_to_assets(self, assets: "AssetSet", pointer: "Pointer") -> "AssetSet":
        """Set mass, material or friction, or replace a mesh."""
        objects = {item.id: item for item in assets.objects}
        for entry in self.of_stage("assets"):
            item = _addressed(entry, objects, pointer)
            objects[item.id] = _with_physics(self._with_mesh(item, entry), entry)
        return replace(assets, objects=tuple(objects[item.id] for item in assets.objects))

    def apply_to_graph(self, graph: "SceneGraph", assets: "AssetSet", pointer: "Pointer") -> "SceneGraph":
        """Give objects other parents; refuses a parent that does not exist or that makes a cycle."""
        from reconstruction.editing.addresses import parse_address

        objects = {item.id: item for item in assets.objects}
        known = set(objects) | {item.id for item in assets.base}
        edges = {edge.child: edge for edge in graph.edges}
        for entry in self.of_stage("scene_graph"):
            item = _addressed(entry, objects, pointer)
            address = parse_address(entry["parent"], "overrides: parent")
            parent = address.id if address.kind == "id" else pointer.entity(address).id
            if parent not in known:
                raise UsageError(
                    f"overrides: object {item.id} cannot have parent {parent}; ids are {sorted(known)}"
                )
            relation = entry.get("relation", edges[item.id].relation)
            edges[item.id] = replace(
                edges[item.id], parent=parent, relation=relation, confidence=1.0, evidence="user"
            )
            step, seen = parent, {item.id}
            while step in edges:
                if step in seen:
                    raise UsageError(f"overrides: parent {parent} of object {item.id} would make a cycle")
                seen.add(step)
                step = edges[step].parent
        return replace(graph, edges=tuple(edges[edge.child] for edge in graph.edges))

    def movable(self, assets: "AssetSet", graph: "SceneGraph", pointer: "Pointer") -> dict[int, bool]:
        """Return which objects shall be able to move, and which not; refuses it of what is attached to something."""
        objects = {item.id: item for item in assets.objects}
        attached = {edge.child: edge.parent for edge in graph.edges if edge.relation == "attached_to"}
        out: dict[int, bool] = {}
        for entry in self.of_stage("assembly"):
            item = _addressed(entry, objects, pointer)
            if item.id in attached:
                raise UsageError(
                    f"overrides: dynamic of object {item.id}: it is attached to {attached[item.id]} and moves as that "
                    "does; give it a parent with relation: supported_by first"
                )
            out[item.id] = entry["dynamic"]
        return out

    def _with_mesh(self, item: "ObjectAsset", entry: dict) -> "ObjectAsset":
        if "mesh" not in entry:
            return item
        from reconstruction.assets.replace import replace_mesh

        return replace_mesh(item, self.folder / entry["mesh"])


def _check(entry: Any, where: str) -> None:
    """Refuse what no stage would understand."""
    allowed = [action for actions in ACTIONS.values() for action in actions]
    if not isinstance(entry, dict):
        raise UsageError(f"{where}: expected a mapping such as {{id: 3, relabel: mug}}, got {entry!r}")
    unknown = sorted(set(entry) - set(allowed) - set(_ADDRESS))
    if unknown:
        raise UsageError(
            f"{where}: unknown {', '.join(map(repr, unknown))}; an entry may have {', '.join(allowed)}"
        )
    if not set(entry) & set(allowed):
        raise UsageError(f"{where}: says nothing to do; use one of {', '.join(allowed)}")
    _check_addresses(entry, where)
    for name in ("mass_kg", "friction"):
        value = entry.get(name)
        if value is not None and not (isinstance(value, int | float) and 0 < value < 1e5):
            raise UsageError(f"{where}: {name} must be a positive number, got {value!r}")
    if not isinstance(entry.get("dynamic", True), bool):
        raise UsageError(f"{where}: dynamic must be true or false, got {entry['dynamic']!r}")
    if entry.get("relation", "supported_by") not in ("supported_by", "attached_to"):
        raise UsageError(f"{where}: relation must be supported_by or attached_to")


def _check_addresses(entry: dict, where: str) -> None:
    """Refuse an entry that does not say which thing it means."""
    from reconstruction.editing.addresses import KINDS, parse_address, parse_addresses, parse_parts

    clicked = isinstance(entry.get("split"), list)
    if clicked:
        parse_parts(entry["split"], f"{where}: split")
    if "merge" in entry:
        parse_addresses(entry["merge"], f"{where}: merge", fewest=2)
        if set(entry) != {"merge"}:
            raise UsageError(f"{where}: merge stands alone; say the rest in an entry after it")
    elif not (clicked and not set(entry) & set(KINDS)):
        parse_address(entry, where)
    if "parent" in entry:
        parse_address(entry["parent"], f"{where}: parent")


def _addressed(entry: dict, objects: dict[int, "ObjectAsset"], pointer: "Pointer") -> "ObjectAsset":
    from reconstruction.editing.addresses import parse_address

    found = pointer.thing(parse_address(entry, "overrides"))
    if found.id not in objects:
        raise UsageError(f"overrides: {found.label} {found.id} was not built; objects are {sorted(objects)}")
    return objects[found.id]


def _with_physics(item: "ObjectAsset", entry: dict) -> "ObjectAsset":
    physics = item.physics
    if "material" in entry:
        from reconstruction.assets.physics.materials import MATERIALS
        from reconstruction.core.types import PhysicalRanges

        if entry["material"] not in MATERIALS:
            raise UsageError(
                f"overrides: no material {entry['material']!r}; there are {', '.join(sorted(MATERIALS))}"
            )
        chosen = MATERIALS[entry["material"]]
        density = chosen.density_kg_m3
        factor = density.value / physics.density_kg_m3
        mass = physics.mass_kg * factor
        spread = (mass * density.low / density.value, mass * density.high / density.value)
        physics = replace(
            physics,
            material=entry["material"],
            density_kg_m3=density.value,
            friction=chosen.friction.value,
            restitution=chosen.restitution.value,
            mass_kg=mass,
            inertia=physics.inertia * factor,
            ranges=PhysicalRanges(spread, chosen.friction[1:], chosen.restitution[1:]),
        )
    if "mass_kg" in entry:  # what the user says is so, not about so
        mass = float(entry["mass_kg"])
        inertia = physics.inertia * (mass / physics.mass_kg)
        ranges = replace(physics.ranges, mass_kg=(mass, mass))
        physics = replace(physics, mass_kg=mass, inertia=inertia, ranges=ranges)
    if "friction" in entry:
        friction = float(entry["friction"])
        ranges = replace(physics.ranges, friction=(friction, friction))
        physics = replace(physics, friction=friction, ranges=ranges)
    if physics is item.physics:
        return item
    return replace(item, physics=physics, provenance=replace(item.provenance, physics="user"))
