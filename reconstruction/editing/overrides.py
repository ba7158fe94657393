"""The overrides file (`--overrides FILE`): load and validate its entries, and apply them to the results of stages.

The file is a YAML list. An entry addresses an object by `id`, `at` or `pixel` (`reconstruction.editing.addresses`) and
has one or more actions. See docs/overrides.md.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reconstruction.editing.addresses import KINDS, parse_address, parse_addresses, parse_parts
from registry.errors import UsageError

if TYPE_CHECKING:
    from reconstruction.core.types import AssetSet, InstanceSet, ObjectAsset, SceneGraph
    from reconstruction.editing.anchors import Pointer

# Actions of an entry, by the stage that applies them.
ACTIONS: dict[str, tuple[str, ...]] = {
    "instances": ("relabel", "drop", "merge", "split", "make_base"),
    "assets": ("mass_kg", "material", "friction", "mesh"),
    "scene_graph": ("parent",),
    "assembly": ("dynamic",),
}
_ADDRESS = ("id", "near", "at", "pixel", "relation")


@dataclass(frozen=True)
class Overrides:
    """Validated entries of an overrides file."""

    entries: list[dict] = field(default_factory=list)
    folder: Path = Path()  # of the file; paths of meshes are relative to it

    @classmethod
    def load(cls, path: Path) -> "Overrides":
        """Read and validate an overrides file.

        Raises:
            UsageError: the file is missing or malformed; the message names the entry and what is allowed.
        """
        import yaml

        try:
            entries = yaml.safe_load(path.read_text())
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
        return cls(entries, path.resolve().parent)

    def of_stage(self, stage: str) -> list[dict]:
        """Return the entries with an action of this stage."""
        actions = ACTIONS.get(stage, ())
        return [entry for entry in self.entries if any(action in entry for action in actions)]

    def fingerprint_of_stage(self, stage: str) -> list:
        """Return the part of a stage's cache key: its entries, and digests of the meshes that they name."""
        from reconstruction.cache import digest_input

        entries = self.of_stage(stage)
        files = [self.folder / str(entry["mesh"]) for entry in entries if "mesh" in entry]
        return [*entries, *(digest_input(file) for file in files if file.exists())]

    def apply_to_instances(self, pointer: "Pointer") -> "InstanceSet":
        """Apply relabel, drop, merge, split and make_base to the instances of the pointer."""
        from reconstruction.editing.instances import apply_overrides

        return apply_overrides(pointer.found, pointer.surface, self.of_stage("instances"), pointer.footage)

    def apply_to_assets(self, assets: "AssetSet", pointer: "Pointer") -> "AssetSet":
        """Apply mass_kg, material, friction and mesh."""
        objects = {item.id: item for item in assets.objects}
        for entry in self.of_stage("assets"):
            item = _addressed(entry, objects, pointer)
            objects[item.id] = _with_physics(self._with_mesh(item, entry), entry)
        return replace(assets, objects=tuple(objects[item.id] for item in assets.objects))

    def apply_to_graph(self, graph: "SceneGraph", assets: "AssetSet", pointer: "Pointer") -> "SceneGraph":
        """Apply parent and relation.

        Raises:
            UsageError: a parent does not exist, or would make a cycle.
        """
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
            edge = replace(edges[item.id], parent=parent, relation=relation)
            edges[item.id] = replace(edge, confidence=1.0, evidence="user")
            step, seen = parent, {item.id}
            while step in edges:
                if step in seen:
                    raise UsageError(f"overrides: parent {parent} of object {item.id} would make a cycle")
                seen.add(step)
                step = edges[step].parent
        return replace(graph, edges=tuple(edges[edge.child] for edge in graph.edges))

    def movable(self, assets: "AssetSet", graph: "SceneGraph", pointer: "Pointer") -> dict[int, bool]:
        """Return by object id whether it is dynamic, for the objects whose entries say so.

        Raises:
            UsageError: an object is attached to another one.
        """
        objects = {item.id: item for item in assets.objects}
        attached = {edge.child: edge.parent for edge in graph.edges if edge.relation == "attached_to"}
        out: dict[int, bool] = {}
        for entry in self.of_stage("assembly"):
            item = _addressed(entry, objects, pointer)
            if item.id in attached:
                raise UsageError(
                    f"overrides: dynamic of object {item.id}: it is attached to {attached[item.id]} and moves with "
                    "that; give it a parent with relation: supported_by first"
                )
            out[item.id] = entry["dynamic"]
        return out

    def _with_mesh(self, item: "ObjectAsset", entry: dict) -> "ObjectAsset":
        if "mesh" not in entry:
            return item
        from reconstruction.assets.replace import replace_mesh

        return replace_mesh(item, self.folder / entry["mesh"])


def _check(entry: Any, where: str) -> None:
    """Raise UsageError for an entry that no stage can apply."""
    allowed = [action for actions in ACTIONS.values() for action in actions]
    if not isinstance(entry, dict):
        raise UsageError(f"{where}: expected a mapping such as {{id: 3, relabel: mug}}, got {entry!r}")
    unknown = sorted(set(entry) - set(allowed) - set(_ADDRESS))
    if unknown:
        raise UsageError(
            f"{where}: unknown {', '.join(map(repr, unknown))}; an entry may have {', '.join(allowed)}"
        )
    if not set(entry) & set(allowed):
        raise UsageError(f"{where}: has no action; use one of {', '.join(allowed)}")
    _check_addresses(entry, where)
    for name in ("mass_kg", "friction"):
        value = entry.get(name, 1.0)
        if isinstance(value, bool) or not (isinstance(value, int | float) and 0 < value < 1e5):
            raise UsageError(f"{where}: {name} must be a positive number, got {value!r}")
    for name in ("material", "mesh"):
        if not isinstance(entry.get(name, ""), str):
            raise UsageError(f"{where}: {name} must be text, got {entry[name]!r}")
    if not isinstance(entry.get("dynamic", True), bool):
        raise UsageError(f"{where}: dynamic must be true or false, got {entry['dynamic']!r}")
    if entry.get("relation", "supported_by") not in ("supported_by", "attached_to"):
        raise UsageError(f"{where}: relation must be supported_by or attached_to")


def _check_addresses(entry: dict, where: str) -> None:
    """Raise UsageError for an entry without a valid address."""
    clicked = isinstance(entry.get("split"), list)
    if clicked:
        parse_parts(entry["split"], f"{where}: split")
    if "merge" in entry:
        parse_addresses(entry["merge"], f"{where}: merge", fewest=2)
        if set(entry) != {"merge"}:
            raise UsageError(f"{where}: merge cannot be combined with other keys; use another entry after it")
    elif not (clicked and not set(entry) & set(KINDS)):
        parse_address(entry, where)
    if "parent" in entry:
        parse_address(entry["parent"], f"{where}: parent")


def _addressed(entry: dict, objects: dict[int, "ObjectAsset"], pointer: "Pointer") -> "ObjectAsset":
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
            physics, material=entry["material"], density_kg_m3=density.value, friction=chosen.friction.value,
            restitution=chosen.restitution.value, mass_kg=mass, inertia=physics.inertia * factor,
            ranges=PhysicalRanges(spread, chosen.friction[1:], chosen.restitution[1:]),
        )  # fmt: skip
    if "mass_kg" in entry:  # values by the user have a range of zero width
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
