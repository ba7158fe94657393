"""The overrides file (`--overrides FILE`): load and validate its entries, and apply them to the results of stages.

The file is a YAML list. An entry addresses an object by `id`, `at` or `pixel` (`reconstruction.editing.addresses`) and
has one or more actions. See docs/overrides.md.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.editing.addresses import parse_address
from reconstruction.editing.entries import check_entry, part_of_stage
from reconstruction.editing.scene_entries import SCENE_KEYS, SceneEntries, parse_scene_entries
from reconstruction.editing.strict_yaml import read_yaml
from registry.errors import UsageError

if TYPE_CHECKING:
    from reconstruction.config import PipelineConfig
    from reconstruction.core.types import AssetSet, InstanceSet, SceneGraph
    from reconstruction.editing.anchors import Pointer

_LONGEST_MESSAGE = 700


@dataclass(frozen=True)
class Overrides:
    """Validated entries of an overrides file."""

    entries: list[dict] = field(default_factory=list)
    folder: Path = Path()  # of the file; paths of meshes are relative to it
    file: Path | None = None

    @classmethod
    def load(cls, path: Path) -> "Overrides":
        """Read and validate an overrides file.

        Raises:
            UsageError: the file is missing or malformed; the message names the entry and what is allowed.
        """
        try:
            entries = read_yaml(path)
        except OSError as error:
            raise UsageError(f"--overrides {path}: {error.strerror or error}") from error
        except ValueError as error:
            raise UsageError(f"--overrides {path}: {error}") from error
        if entries is None:
            entries = []
        if not isinstance(entries, list):
            raise UsageError(
                f"--overrides {path}: expected a list of entries such as `- {{id: 3, relabel: mug}}`"
            )
        loaded = cls(entries, path.resolve().parent, path)
        try:
            for number, entry in enumerate(entries, start=1):
                check_entry(entry, f"--overrides {path}: entry {number}")
                _check_mesh(entry, loaded.folder, f"--overrides {path}: entry {number}")
            parse_scene_entries(loaded.of_stage("world"), f"--overrides {path}")
        except UsageError as error:
            raise UsageError(_shortened(str(error))) from error
        return loaded

    def of_stage(self, stage: str) -> list[dict]:
        """Return address and actions of each entry that has actions for this stage."""
        parts = (part_of_stage(entry, stage) for entry in self.entries)
        return [part for part in parts if part]

    def scene_entries(self) -> SceneEntries:
        """Return the entries about the whole scene: scale, up, floor."""
        return parse_scene_entries(self.of_stage("world"), "overrides")

    def check_lengths(self, config: "PipelineConfig") -> None:
        """Raise UsageError if both this file and the command line give a length for the scale."""
        given = "--scale" if config.world.scale else "--marker-size" if config.world.marker_size_m > 0 else ""
        if given and self.scene_entries().scale is not None:
            raise UsageError(
                f"overrides: the file has a `scale` entry, and {given} is given on the command line; leave out one of "
                "the two"
            )

    def entries_in_metres(self) -> list[int]:
        """Return the numbers, from 1, of the entries with world coordinates, which another world frame moves."""
        return [n for n, entry in enumerate(self.entries, start=1) if _has_world_coordinates(entry)]

    def fingerprint_of_stage(self, stage: str) -> list:
        """Return the part of a stage's cache key: its entries, and digests of the meshes that they name."""
        from reconstruction.cache import digest_input

        entries = self.of_stage(stage)
        files = [self.folder / str(entry["mesh"]) for entry in entries if "mesh" in entry]
        return [*entries, *(digest_input(file) for file in files if file.exists())]

    def apply_to_instances(self, pointer: "Pointer") -> "InstanceSet":
        """Apply add, relabel, drop, merge, split and make_base to the instances of the pointer."""
        from reconstruction.editing.instances import apply_overrides

        return apply_overrides(pointer.found, pointer.surface, self.of_stage("instances"), pointer.footage)

    def apply_to_assets(
        self, assets: "AssetSet", pointer: "Pointer", progress: Progress = NO_PROGRESS
    ) -> "AssetSet":
        """Apply mass_kg, material, friction, mesh, size_m, move and drop_to_surface."""
        from reconstruction.editing.asset_edits import edited_assets

        return edited_assets(assets, self.of_stage("assets"), self.folder, pointer, progress)

    def apply_to_graph(self, graph: "SceneGraph", assets: "AssetSet", pointer: "Pointer") -> "SceneGraph":
        """Apply parent and relation.

        Raises:
            UsageError: a parent does not exist, or would make a cycle.
        """
        from reconstruction.editing.asset_edits import addressed

        objects = {item.id: item for item in assets.objects}
        known = set(objects) | set(assets.static_labels)
        edges = {edge.child: edge for edge in graph.edges}
        for entry in self.of_stage("scene_graph"):
            item = addressed(entry, objects, pointer)
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
        from reconstruction.editing.asset_edits import addressed

        objects = {item.id: item for item in assets.objects}
        attached = {edge.child: edge.parent for edge in graph.edges if edge.relation == "attached_to"}
        out: dict[int, bool] = {}
        for entry in self.of_stage("assembly"):
            item = addressed(entry, objects, pointer)
            if item.id in attached:
                raise UsageError(
                    f"overrides: dynamic of object {item.id}: it is attached to {attached[item.id]} and moves with "
                    "that; give it a parent with relation: supported_by first"
                )
            out[item.id] = entry["dynamic"]
        return out


def _has_world_coordinates(value: Any) -> bool:
    """Return whether a part of an entry holds a place, a shift or a direction in world axes."""
    if isinstance(value, list):
        return any(map(_has_world_coordinates, value))
    if not isinstance(value, dict) or set(value) & set(SCENE_KEYS):
        return False
    move = value.get("move")
    posed = isinstance(move, dict) and bool(set(move) & {"by", "to", "wxyz"})
    plane = isinstance(value.get("split"), dict)
    return (
        posed
        or plane
        or bool({"at", "near"} & set(value))
        or any(map(_has_world_coordinates, value.values()))
    )


def _check_mesh(entry: dict, folder: Path, where: str) -> None:
    """Raise UsageError if the mesh of an entry is no file."""
    if "mesh" not in entry:
        return
    path = folder / entry["mesh"]
    if "\0" in entry["mesh"] or not path.is_file():
        raise UsageError(
            f"{where}: mesh: there is no file {path}; paths are relative to the folder of this file"
        )


def _shortened(message: str) -> str:
    """Cut out the middle of a message that quotes a long value."""
    half = _LONGEST_MESSAGE // 2
    return message if len(message) <= _LONGEST_MESSAGE else f"{message[:half]} ... {message[-half:]}"
