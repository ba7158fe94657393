"""A small hand-made room, written as bundles piece by piece; the ids of what is in it."""

from pathlib import Path

import numpy as np
import trimesh
from masses import mass_entry

from reconstruction.gaussians import write_ply
from reconstruction.gaussians.model import from_packed
from registry import SceneRegistry, seal_bundle
from registry.geometry import GLTF_FROM_WORLD

ROOM_M = (4.0, 3.0, 2.4)
TABLE_TOP_M = 0.60
BOX, CYLINDER, PICTURE, TABLE, BOOK, KNOB = 10, 11, 12, 13, 14, 15
CRATE, BLOCK, CUBE, SHELF = 20, 21, 22, 23
STRUCTURE_ID = 99


def _glb(mesh: trimesh.Trimesh, path: Path, color: tuple[int, int, int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh = mesh.copy().apply_transform(GLTF_FROM_WORLD)
    mesh.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(
            baseColorFactor=[*color, 255], metallicFactor=0.0, roughnessFactor=1.0
        )
    )
    path.write_bytes(trimesh.Scene(mesh).export(file_type="glb"))


def _obj(mesh: trimesh.Trimesh, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices]
    rows += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces]
    path.write_text("\n".join(rows) + "\n")


def box(size: tuple, bottom: float = 0.0, at: tuple = (0.0, 0.0)) -> trimesh.Trimesh:
    """Return a box of a size (3,) whose bottom centre is at (x, y, bottom)."""
    mesh = trimesh.creation.box(size)
    return mesh.apply_translation([at[0], at[1], bottom + size[2] / 2])


def _translation(x: float, y: float, z: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = (x, y, z)
    return pose


class BundleWriter:
    """Writes a bundle piece by piece; `seal` finishes it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.base, self.objects, self.edges = [], [], []
        self.surfaces: list[tuple[int, trimesh.Trimesh]] = []  # id and mesh, world space
        self.gaussians: dict | None = None
        self.backdrop: dict | None = None

    def add_base(
        self, key: int, label: str, mesh: trimesh.Trimesh, plane: list | None, *, collision: bool = True
    ) -> None:
        """Add a floor or wall, a slab in world space whose front lies on the plane, or the structure, without one."""
        _glb(
            mesh, self.folder / f"base/{key:03d}.glb", (200, 196, 188) if label == "wall" else (150, 120, 90)
        )
        entry = {"id": key, "label": label, "mesh": f"base/{key:03d}.glb", "observed": True}
        entry |= {} if plane is None else {"plane": plane}
        if collision:
            _obj(mesh, self.folder / f"base/{key:03d}_collision.obj")
            entry["collision"] = [f"base/{key:03d}_collision.obj"]
        self.base.append(entry)
        self.surfaces.append((key, mesh))

    def add_object(
        self,
        key: int,
        label: str,
        parts: list[trimesh.Trimesh],
        world_from_object: np.ndarray,
        parent: int,
        *,
        color: tuple = (180, 60, 50),
        mass: float = 0.2,
        dynamic: bool = True,
        relation: str = "supported_by",
        friction: float = 0.7,
    ) -> None:
        """Add an object of convex parts in object space."""
        stem = f"objects/{key:03d}"
        whole = trimesh.util.concatenate(parts)
        self.surfaces.append((key, whole.copy().apply_transform(world_from_object)))
        _glb(whole, self.folder / f"{stem}/visual.glb", color)
        names = []
        for number, part in enumerate(parts):
            names.append(f"{stem}/collision_{number:03d}.obj")
            _obj(part, self.folder / names[-1])
        self.objects.append(
            {
                "id": key,
                "label": label,
                "label_confidence": 0.9,
                "world_from_object": np.asarray(world_from_object).tolist(),
                "scale": whole.extents.tolist(),
                "visual": f"{stem}/visual.glb",
                "collision": names,
                "material": "wood",
                **mass_entry(parts, mass),
                "friction": friction,
                "restitution": 0.05,
                "dynamic": dynamic,
                "relation_fixed": relation == "attached_to",
                "provenance": {
                    "geometry": "made",
                    "appearance": "made",
                    "physics": "made",
                    "observed_fraction": 1.0,
                },
                "views": [0],
            }
        )
        self.edges.append(
            {"child": key, "relation": relation, "parent": parent, "confidence": 1.0, "evidence": "made"}
        )

    def cover_with_gaussians(self, color: tuple = (0.1, 0.2, 0.9)) -> None:
        """Write gaussians.ply: opaque disks of one color on all surfaces, smaller ones on small things."""
        points, normals, ids, sizes = [], [], [], []
        for key, mesh in self.surfaces:
            spacing_m = 0.005 if mesh.area < 0.1 else 0.02
            count = int(mesh.area / spacing_m**2)
            found, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
            points.append(found)
            normals.append(mesh.face_normals[faces])
            ids.append(np.full(count, key))
            sizes.append(np.full((count, 2), np.log(0.75 * spacing_m)))
        points, normals = np.concatenate(points), np.concatenate(normals)
        # The rotation that takes z to the normal.
        quats = np.column_stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))])
        quats[normals[:, 2] < -0.999] = (0, 1, 0, 0)
        sh = (np.array(color) - 0.5) / 0.2820948
        columns = [
            points,
            quats,
            np.concatenate(sizes),
            np.full((len(points), 1), 4.0),
            np.tile(sh, (len(points), 1)),
        ]
        write_ply(
            from_packed(np.concatenate(columns, axis=1)), self.folder / "gaussians.ply", np.concatenate(ids)
        )
        self.gaussians = {"file": "gaussians.ply", "count": len(points)}

    def add_backdrop(self, color: tuple[int, int, int] = (250, 20, 240)) -> None:
        """Write backdrop.glb: a box of one color around the room, faces inward."""
        mesh = box((8, 8, 5), -0.5)
        mesh.invert()
        _glb(mesh, self.folder / "backdrop.glb", color)
        self.backdrop = {"mesh": "backdrop.glb", "observed_fraction": 0.5}

    def seal(self, scene_id: str) -> None:
        """Write scene.json and the manifest."""
        # A camera in a corner of the room that looks at its middle, OpenCV axes.
        eye, target = np.array([1.6, -1.2, 1.6]), np.array([-0.3, 0.3, 0.6])
        forward = (target - eye) / np.linalg.norm(target - eye)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = eye
        seal_bundle(
            self.folder,
            {
                "schema": "simrecon.scene/1",
                "id": scene_id,
                "source": {
                    "file": "made.mp4",
                    "sha256": "0" * 64,
                    "width": 640,
                    "height": 480,
                    "fps": 30.0,
                    "frame_count": 1,
                    "duration_s": 0.1,
                },
                "scale": {"method": "marker", "uncertainty": 0.01},
                "cameras": {
                    "model": "PINHOLE",
                    "width": 640,
                    "height": 480,
                    "params": [520.0, 520.0, 320.0, 240.0],
                    "frames": [{"index": 0, "time_s": 0.0, "world_from_camera": pose.tolist()}],
                },
                "base": self.base,
                "objects": self.objects,
                "graph": {"edges": self.edges},
                **({} if self.gaussians is None else {"gaussians": self.gaussians}),
                **({} if self.backdrop is None else {"backdrop": self.backdrop}),
                "report": {
                    "physics": {},
                    "timings_s": {},
                    "peak_memory_mb": 1.0,
                    "backends": {},
                    "config": {},
                },
            },
        )


def add_room(writer: BundleWriter) -> None:
    """Add a floor (1), two walls (2 with collision parts, 3 without)."""
    x, y, z = ROOM_M
    writer.add_base(1, "floor", box((x, y, 0.1), -0.1), [0, 0, 1, 0])
    writer.add_base(2, "wall", box((x, 0.1, z), at=(0, y / 2 + 0.05)), [0, -1, 0, y / 2])
    writer.add_base(3, "wall", box((0.1, y, z), at=(-x / 2 - 0.05, 0)), [1, 0, 0, x / 2], collision=False)


def add_furniture(writer: BundleWriter) -> None:
    """Add a table with a box, a cylinder and a book with a knob on it, and a picture on the wall."""
    legs = [box((0.05, 0.05, 0.57), at=(sx * 0.5, sy * 0.3)) for sx in (-1, 1) for sy in (-1, 1)]
    table = [box((1.1, 0.7, 0.03), 0.57), *legs]
    at_table = (-0.3, 1.05)
    writer.add_object(
        TABLE, "table", table, _translation(*at_table, 0.0), 1, mass=12, dynamic=False, color=(140, 100, 60)
    )
    top = TABLE_TOP_M
    writer.add_object(BOX, "box", [box((0.05, 0.045, 0.09))], _translation(-0.35, 0.85, top), TABLE)
    cylinder = trimesh.creation.cylinder(0.022, 0.10, sections=24).apply_translation([0, 0, 0.05])
    writer.add_object(
        CYLINDER, "cup", [cylinder], _translation(0.0, 0.9, top), TABLE, mass=0.15, color=(50, 90, 170)
    )
    writer.add_object(
        BOOK,
        "book",
        [box((0.22, 0.15, 0.03))],
        _translation(-0.65, 1.05, top),
        TABLE,
        mass=0.4,
        color=(60, 140, 70),
    )
    writer.add_object(
        KNOB,
        "knob",
        [box((0.03, 0.03, 0.03))],
        _translation(-0.65, 1.05, top + 0.03),
        BOOK,
        mass=0.05,
        relation="attached_to",
        color=(220, 200, 60),
    )
    writer.add_object(
        PICTURE,
        "picture",
        [box((0.4, 0.02, 0.3))],
        _translation(-0.3, ROOM_M[1] / 2 - 0.01, 1.4),
        2,
        relation="attached_to",
        mass=0.8,
        color=(120, 70, 150),
    )


def add_things_to_do(writer: BundleWriter) -> None:
    """Add a table with a cube, a cup, a block to stack on and an open crate, and a low shelf beside it."""
    writer.add_object(
        TABLE, "table", [box((1.2, 0.8, 0.4))], _translation(0, 0.9, 0), 1, mass=20, dynamic=False
    )
    shelf = [box((0.4, 0.4, 0.3))]
    writer.add_object(SHELF, "shelf", shelf, _translation(0.85, 0.6, 0), 1, mass=9, dynamic=False)
    top = 0.4
    writer.add_object(CUBE, "cube", [box((0.05, 0.05, 0.06))], _translation(0.30, 0.62, top), TABLE)
    cup = trimesh.creation.cylinder(0.025, 0.08, sections=24).apply_translation([0, 0, 0.04])
    writer.add_object(CYLINDER, "cup", [cup], _translation(0.10, 0.70, top), TABLE, color=(50, 90, 170))
    writer.add_object(
        BLOCK, "block", [box((0.14, 0.14, 0.05))], _translation(0.45, 0.90, top), TABLE, mass=0.8
    )
    wide, high, thick = 0.20, 0.07, 0.01
    side = (wide - thick) / 2
    walls = [box((thick, wide, high), at=(s * side, 0)) for s in (-1, 1)]
    walls += [box((wide, thick, high), at=(0, s * side)) for s in (-1, 1)]
    crate = [box((wide, wide, thick)), *walls]
    writer.add_object(CRATE, "crate", crate, _translation(0.10, 0.95, top), TABLE, mass=0.7)


def add_counter(writer: BundleWriter) -> None:
    """Add a counter's top that is of no object, as structure, with a cube and a cup on it."""
    writer.add_base(STRUCTURE_ID, "structure", box((1.2, 0.6, 0.02), TABLE_TOP_M - 0.02, at=(0, 0.9)), None)
    cube = [box((0.05, 0.05, 0.06))]
    writer.add_object(CUBE, "cube", cube, _translation(0.25, 0.8, TABLE_TOP_M), STRUCTURE_ID)
    cup = trimesh.creation.cylinder(0.025, 0.08, sections=24).apply_translation([0, 0, 0.04])
    writer.add_object(CYLINDER, "cup", [cup], _translation(-0.1, 0.75, TABLE_TOP_M), STRUCTURE_ID)


def publish(registry: SceneRegistry, scene_id: str, folder: Path) -> None:
    """Write and publish `room` (furniture), `bare` (nothing moves), `things` (all tasks) or `counter` (structure)."""
    writer = BundleWriter(folder)
    add_room(writer)
    if scene_id == "room":
        add_furniture(writer)
    elif scene_id == "things":
        add_things_to_do(writer)
    elif scene_id == "counter":
        add_counter(writer)
    else:
        writer.add_object(
            PICTURE,
            "picture",
            [box((0.4, 0.02, 0.3))],
            _translation(0, 1.49, 1.4),
            2,
            relation="attached_to",
            dynamic=False,
        )
    writer.seal(scene_id)
    registry.publish(writer.folder, scene_id)


def publish_with_gaussians(registry: SceneRegistry, scene_id: str, folder: Path) -> None:
    """Write `room` with Gaussians on all surfaces and publish it."""
    writer = BundleWriter(folder)
    add_room(writer)
    add_furniture(writer)
    writer.cover_with_gaussians()
    writer.seal(scene_id)
    registry.publish(writer.folder, scene_id)
