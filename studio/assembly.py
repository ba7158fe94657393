"""The assembly of a scene as steps: floor and walls first, then each object after the object that carries it.

A bundle stores no steps. The order follows from its scene graph, as in `reconstruction.assembly`: by depth, then by
height.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from registry import SceneBundle
from registry.geometry import rigid

APPROACH_M = 0.30  # that an object comes from above its place, or out of the wall that it hangs on
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class AssemblyStep:
    """One object that is placed."""

    object_id: int
    label: str
    parent: int
    parent_label: str
    relation: str  # "supported_by" | "attached_to"
    depth: int  # in the scene graph; 1: on floor or wall
    pose: np.ndarray  # float64 (4, 4) `world_from_object`, where it ends
    approach: np.ndarray  # float64 (3,) unit, from its place towards where it comes from
    evidence: str  # of the edge of the scene graph
    settling: str  # difference to the reconstructed pose, and repairs


def assembly_steps(
    bundle: SceneBundle, poses: Mapping[int, np.ndarray] | None = None
) -> tuple[AssemblyStep, ...]:
    """Return the steps of a bundle's assembly, in order.

    Args:
        bundle: The scene.
        poses: `world_from_object` (4, 4) by id where objects were moved; None: those of the bundle.
    """
    poses = poses or {}
    parents = {edge.child: edge for edge in bundle.edges}
    labels = {item.id: item.label for item in (*bundle.base, *bundle.objects)}
    normals = {base.id: base.plane[:3] for base in bundle.base if base.plane is not None}
    told = {item["id"]: item.get("assembly", {}) for item in bundle.scene["objects"]}
    steps = []
    for item in bundle.objects:
        edge = parents[item.id]
        hangs = edge.relation == "attached_to" and edge.parent in normals
        steps.append(
            AssemblyStep(
                item.id,
                item.label,
                edge.parent,
                labels[edge.parent],
                edge.relation,
                _depth(item.id, parents),
                np.asarray(poses.get(item.id, item.world_from_object), np.float64),
                np.asarray(normals[edge.parent] if hangs else _UP, np.float64),
                str(edge.evidence or ""),
                _settling(told[item.id]),
            )
        )
    return tuple(sorted(steps, key=lambda s: (s.depth, float(s.pose[2, 3]), s.object_id)))


def pose_at(step: AssemblyStep, number: int, progress: float) -> np.ndarray | None:
    """Return the pose (4, 4) of the object of the step `number` (from 0) at a time of the replay; None: not there yet.

    Args:
        step: The step.
        number: Its place in the order.
        progress: Time in steps: step n runs from n to n + 1; the integer part counts the finished steps.
    """
    share = progress - number
    if share <= 0:
        return None
    left = (1.0 - min(share, 1.0)) ** 2  # slows down towards the end
    return rigid(step.pose[:3, :3], step.pose[:3, 3] + APPROACH_M * left * step.approach)


def _depth(object_id: int, parents: Mapping) -> int:
    depth = 0
    while object_id in parents and depth <= len(parents):
        object_id, depth = parents[object_id].parent, depth + 1
    return depth


def _settling(told: Mapping) -> str:
    parts = []
    if "moved_m" in told:
        moved, turned = 1000 * float(told["moved_m"]), float(told["turned_deg"])
        parts.append(f"came to rest {moved:.1f} mm and {turned:.1f} degrees from where it was seen")
    if told.get("repair"):
        parts.append(str(told["repair"]))
    return "; ".join(parts)
