"""A small bundle with everything that an export must tell apart, and where its meshes are in the world."""

from pathlib import Path

import numpy as np
import trimesh
from masses import mass_entry

from reconstruction.assets.gltf import read_glb, write_glb, write_obj
from reconstruction.core.types import ConvexPart, TexturedMesh
from reconstruction.exports.scene import ExportBody, ExportScene, closed_part, safe_name, uniform_inertia
from registry import SceneBundle, seal_bundle
from registry.geometry import matrix_from_quat, rigid, transform_points
from registry.simulation import read_obj_points, standing_primitive
from synthetic.checks import bodies
from synthetic.procedural import RoomSpec, build_procedural_room

FLOOR, WALL, TABLE, MUG, BOOK, KNOB, PICTURE, CABINET, LEAF, HANDLE = range(1, 11)
MOVING = {TABLE, MUG, BOOK, KNOB, LEAF}
FREE = MOVING - {KNOB}  # the knob is fixed to the book
_TOP_M = 0.7


def box(size: tuple, center: tuple) -> trimesh.Trimesh:
    """Return a box of a size (3,) about a center (3,)."""
    return trimesh.creation.box(size).apply_translation(center)


def _about_z(degrees: float, place: tuple) -> np.ndarray:
    half = np.radians(degrees) / 2
    return rigid(matrix_from_quat(np.array([np.cos(half), 0, 0, np.sin(half)])), np.array(place))


def _textured(mesh: trimesh.Trimesh) -> TexturedMesh:
    vertices = np.asarray(mesh.vertices, np.float32)
    low, size = vertices.min(axis=0), np.maximum(np.ptp(vertices, axis=0), 1e-6)
    rows = np.arange(16, dtype=np.uint8)
    texture = np.stack(np.broadcast_arrays(16 * rows[:, None], 16 * rows[None], np.uint8(90)), axis=-1)
    uvs = ((vertices - low) / size)[:, :2]
    return TexturedMesh(vertices, np.asarray(mesh.faces, np.int32), uvs, np.ascontiguousarray(texture))


class _Writer:
    def __init__(self, folder: Path) -> None:
        self.folder, self.base, self.objects, self.edges = folder, [], [], []

    def _write(self, stem: str, visual: str, parts: list[trimesh.Trimesh]) -> list[str]:
        (self.folder / stem).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / visual).parent.mkdir(parents=True, exist_ok=True)
        write_glb(_textured(trimesh.util.concatenate(parts)), self.folder / visual)
        names = [f"{stem}collision_{k:03d}.obj" for k in range(len(parts))]
        for name, part in zip(names, parts, strict=True):
            vertices, faces = part.vertices.astype(np.float32), part.faces.astype(np.int32)
            write_obj(ConvexPart(vertices, faces), self.folder / name)
        return names

    def add_base(self, key: int, label: str, slab: trimesh.Trimesh, plane: list) -> None:
        visual = f"base/{key:03d}.glb"
        names = self._write(f"base/{key:03d}_", visual, [slab])
        entry = {"id": key, "label": label, "mesh": visual, "plane": plane, "observed": True}
        self.base.append({**entry, "collision": names})

    def add(self, key: int, label: str, parts: list, pose: np.ndarray, edge: tuple, **facts: object) -> None:
        stem = f"objects/{key:03d}/"
        names = self._write(stem, f"{stem}visual.glb", parts)
        entry = {
            "id": key,
            "label": label,
            "label_confidence": 0.9,
            "world_from_object": pose.tolist(),
            "scale": trimesh.util.concatenate(parts).extents.tolist(),
            "visual": f"{stem}visual.glb",
            "collision": names,
            "material": "wood",
            **mass_entry(parts, facts.pop("mass", 0.4)),
            "friction": 0.6,
            "restitution": 0.1,
            "dynamic": True,
            "relation_fixed": edge[0] == "attached_to",
            "provenance": {"geometry": "a", "appearance": "a", "physics": "a", "observed_fraction": 1.0},
            "views": [0],
        }
        self.objects.append({**entry, **facts})
        relation, parent = edge
        self.edges.append(
            {"child": key, "relation": relation, "parent": parent, "confidence": 1.0, "evidence": "made"}
        )


def make_room(folder: Path, scene_id: str = "room", *, backdrop: bool = False) -> SceneBundle:
    """Write and open a room: a table with a mug and a book on it, a fixed cabinet, things that hang, a backdrop."""
    writer = _Writer(folder)
    writer.add_base(FLOOR, "floor", box((4, 3, 0.1), (0, 0, -0.05)), [0, 0, 1, 0])
    writer.add_base(WALL, "wall", box((4, 0.1, 2.4), (0, 1.55, 1.2)), [0, -1, 0, 1.5])
    legs = [box((0.06, 0.06, 0.66), (x, y, 0.33)) for x in (-0.5, 0.5) for y in (-0.3, 0.3)]
    table = [box((1.1, 0.7, 0.04), (0, 0, 0.68)), *legs]
    on_table, on_floor, on_wall = ("supported_by", TABLE), ("supported_by", FLOOR), ("attached_to", WALL)
    writer.add(TABLE, "table", table, _about_z(20, (0.2, 0.3, 0)), on_floor, mass=14.0)
    cylinder = trimesh.creation.cylinder(0.04, 0.1, sections=20).apply_translation((0, 0, 0.05))
    ear = box((0.03, 0.012, 0.06), (0.052, 0.0, 0.05))
    mug = _about_z(130, (0.1, 0.3, _TOP_M))
    writer.add(MUG, "mug / cup", [cylinder, ear], mug, on_table, mass=0.31, friction=0.4)
    book = _about_z(-35, (0.4, 0.4, _TOP_M))
    writer.add(BOOK, "book", [box((0.22, 0.15, 0.03), (0, 0, 0.015))], book, on_table, mass=0.5)
    knob = book @ _about_z(10, (0.05, 0.02, 0.03))
    knob_part = box((0.03, 0.03, 0.02), (0, 0, 0.01))
    writer.add(KNOB, "knob", [knob_part], knob, ("attached_to", BOOK), mass=0.02, dynamic=False)
    picture = _about_z(0, (0.9, 1.48, 1.3))
    writer.add(PICTURE, "picture", [box((0.4, 0.04, 0.3), (0, 0, 0.15))], picture, on_wall, mass=0.8)
    cabinet = _about_z(4, (-1.4, 1.2, 0))
    cabinet_part = box((0.6, 0.4, 1.0), (0, 0, 0.5))
    writer.add(CABINET, "cabinet", [cabinet_part], cabinet, on_floor, mass=30.0, dynamic=False)
    # A piece without thickness: physics gives it 1 mm.
    leaf = box((0.2, 0.2, 0.0), (0, 0, 0.0))
    writer.add(
        LEAF, "42", [box((0.1, 0.1, 0.02), (0, 0, 0.0105)), leaf], _about_z(0, (-1.4, 1.2, 1.0005)),
        ("supported_by", CABINET), mass=0.1, friction=0.8,
    )  # fmt: skip
    handle = _about_z(4, (-1.386, 1.0, 0.6))
    handle_part = box((0.1, 0.02, 0.02), (0, -0.01, 0.01))
    writer.add(HANDLE, "handle", [handle_part], handle, ("attached_to", CABINET), mass=0.1)
    scene = _scene(scene_id, writer)
    if backdrop:
        around = box((8, 8, 5), (0, 0, 2))
        around.invert()
        write_glb(_textured(around), folder / "backdrop.glb")
        scene["backdrop"] = {"mesh": "backdrop.glb", "observed_fraction": 0.5}
    seal_bundle(folder, scene)
    return SceneBundle.open(folder)


def _scene(scene_id: str, writer: _Writer) -> dict:
    frame = {"index": 0, "time_s": 0.0, "world_from_camera": np.eye(4).tolist()}
    camera = {"model": "PINHOLE", "width": 64, "height": 48, "params": [50.0, 50.0, 32.0, 24.0]}
    source = {"file": "made.mp4", "sha256": "0" * 64, "width": 64, "height": 48, "fps": 30.0}
    return {
        "schema": "simrecon.scene/1",
        "id": scene_id,
        "source": {**source, "frame_count": 1, "duration_s": 0.1},
        "scale": {"method": "marker", "uncertainty": 0.01},
        "cameras": {**camera, "frames": [frame]},
        "base": writer.base,
        "objects": writer.objects,
        "graph": {"edges": writer.edges},
        "report": {"physics": {}, "timings_s": {}, "backends": {}, "config": {}},
    }


def names(bundle: SceneBundle) -> dict[int, str]:
    """Return {id: name in the exports}."""
    return {item.id: safe_name(item.label, item.id) for item in (*bundle.base, *bundle.objects)}


def world_box(bundle: SceneBundle, item: object) -> np.ndarray:
    """Return the world box (2, 3) of the looks of an object or base surface, from the bundle's own files."""
    file = item.mesh if hasattr(item, "mesh") else item.visual
    return _bounds(transform_points(_pose(item), read_glb(bundle.resolve(file)).vertices))


def solid_box(bundle: SceneBundle, item: object, space: str = "world") -> np.ndarray:
    """Return the box (2, 3) of the collision pieces, in the world or in object space."""
    points = np.concatenate([read_obj_points(bundle.resolve(path)) for path in item.collision])
    return _bounds(transform_points(_pose(item), points) if space == "world" else points)


def are_boxes(bundle: SceneBundle, item: object) -> list[bool]:
    """Tell which collision pieces of an object are boxes; all of this room with eight corners that are not flat."""
    points = [read_obj_points(bundle.resolve(path)) for path in item.collision]
    return [len(corners) == 8 and np.ptp(corners, axis=0).min() > 0 for corners in points]


def _pose(item: object) -> np.ndarray:
    return getattr(item, "world_from_object", np.eye(4))


def _bounds(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def generated_room(folder: Path, seed: int, objects: int) -> ExportScene:
    """Return a procedural room with stacks and containers as it is exported; all that stands in it is free."""
    room = build_procedural_room(RoomSpec(seed=seed, objects=objects, step_m=0.3))
    exported = []
    for spec in bodies(room, {entity.id: entity.mesh() for entity in room.entities}):
        parts = tuple(closed_part(points, spec.name) for points in spec.parts)
        hull = trimesh.convex.convex_hull(np.concatenate([part.vertices for part in parts]))
        write_glb(_textured(hull), folder / f"{spec.id}.glb")
        exported.append(
            ExportBody(
                id=spec.id,
                label=spec.name,
                name=safe_name(spec.name, spec.id),
                base=spec.base,
                moves=spec.dynamic,
                weld=None,
                relation=None,
                world_from_object=spec.world_from_object,
                visual=folder / f"{spec.id}.glb",
                parts=parts,
                primitives=tuple(None if spec.base else standing_primitive(points) for points in spec.parts),
                mass_kg=spec.mass_kg,
                center_of_mass=spec.center_of_mass,
                inertia=np.zeros((3, 3)) if spec.base else uniform_inertia(parts, spec.mass_kg),
                friction=spec.friction,
                restitution=spec.restitution,
            )
        )
    return ExportScene(f"generated_{seed}", "", tuple(exported), ())
