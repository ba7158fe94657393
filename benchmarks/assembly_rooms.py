"""Generated rooms as a reconstruction might hand them to assembly: true shapes and relations, poses a little off."""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.types import AssetSet, SceneGraph
from registry.geometry import rigid
from synthetic.procedural import RoomSpec, build_procedural_room
from synthetic.true_assets import true_assets, true_edges

# 1-sigma of what is off: each axis, about level axes, about the vertical.
SHIFT_M, TILT_DEG, YAW_DEG = 0.004, 1.0, 2.0


@dataclass(frozen=True)
class AssemblyTask:
    """What assembly is given, and where things belong."""

    assets: AssetSet
    graph: SceneGraph
    true_poses: dict[int, np.ndarray]  # world_from_object (4, 4)


def room_task(seed: int, objects: int) -> AssemblyTask:
    """Return a generated room with stacks and containers whose objects' poses are off by some millimetres."""
    room = build_procedural_room(RoomSpec(seed=seed, objects=objects, step_m=0.3))
    rng = np.random.default_rng([seed, objects])
    true, edges = true_assets(room), true_edges(room)
    made = tuple(
        replace(
            asset,
            world_from_object=_disturbed(asset.world_from_object, rng),
            support_hint=edges[asset.id].parent,
            attached_hint=edges[asset.id].relation == "attached_to",
        )
        for asset in true.objects
    )
    poses = {asset.id: asset.world_from_object for asset in true.objects}
    return AssemblyTask(AssetSet(true.base, made), SceneGraph(tuple(edges.values())), poses)


def _disturbed(pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    about = np.radians(rng.normal(size=3) * [TILT_DEG, TILT_DEG, YAW_DEG])
    angle = max(float(np.linalg.norm(about)), 1e-12)
    x, y, z = about / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rigid(turn @ pose[:3, :3], pose[:3, 3] + SHIFT_M * rng.normal(size=3))
