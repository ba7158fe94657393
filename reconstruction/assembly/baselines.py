"""Assembly baselines of the paper: reconstructed poses as they are, and MCMC search for collision-free poses.

Both keep collision shapes and make the same objects dynamic as assembly does. Nothing is simulated or repaired; the
report card measures the result.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assembly.config import AssemblyConfig
from reconstruction.assembly.placement import Placement, base_specs, moves_by_rule
from reconstruction.assembly.workbench import Workbench, object_spec
from reconstruction.core.progress import Progress
from reconstruction.core.types import AssetSet, Edge
from registry.geometry import matrix_from_quat
from registry.simulation import Contact, pose_change

_REACH_M = 0.015  # largest gap that is measured; wider ones count as this
_GAP_WEIGHT, _MOVED_WEIGHT = 1.0, 0.3  # energy of a metre of gap and of displacement; of penetration it is 1
_TURN_M = 0.1  # displacement that a radian of rotation counts as
_HOT_M, _COLD_M = 5e-4, 1e-5  # first and last temperature of the annealing
_STEP_M, _STEP_RAD = (5e-3, 3e-4), (0.02, 1e-3)  # 1-sigma of proposals, hot and cold
_TILT_SHARE = 0.3  # of the rotation, about horizontal axes


def in_situ(
    assets: AssetSet, edges: Sequence[Edge], movable: dict[int, bool], config: AssemblyConfig
) -> dict[int, Placement]:
    """Place every object at its reconstructed pose.

    Args:
        assets: base surfaces and objects.
        edges: parents before children.
        movable: by object id, whether it is dynamic, where the user says so.
        config: rules on furniture.
    """
    objects, base = {o.id: o for o in assets.objects}, {b.id for b in assets.base}
    out: dict[int, Placement] = {}
    for edge in edges:
        asset = objects[edge.child]
        carrier = out.get(edge.parent)
        parent_moves = carrier is not None and carrier.dynamic
        moves = moves_by_rule(asset, edge, edge.parent in base, parent_moves, config)
        pose = np.asarray(asset.world_from_object, np.float64)
        parts = asset.collision
        if edge.relation != "attached_to":
            moves = movable.get(asset.id, moves)
        out[asset.id] = Placement(asset, edge, pose, parts, parts, moves, 0.0, (), True)
    return out


@dataclass(frozen=True)
class _Neighbors:
    parent: int
    children: tuple[int, ...]


def mcmc(
    assets: AssetSet,
    edges: Sequence[Edge],
    movable: dict[int, bool],
    config: AssemblyConfig,
    progress: Progress,
) -> dict[int, Placement]:
    """Search collision-free poses near the reconstructed ones by annealed Metropolis-Hastings over SE(3).

    The energy sums penetration depths, gaps to parent and children, and displacement. The number of proposals is fixed,
    so that results do not depend on the speed of the machine. Arguments as in `in_situ`.
    """
    placed = in_situ(assets, edges, movable, config)
    bench = Workbench(base_specs(assets))
    for item in placed.values():
        bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
    children: dict[int, list[int]] = {}
    for edge in edges:
        children.setdefault(edge.parent, []).append(edge.child)
    around = {e.child: _Neighbors(e.parent, tuple(children.get(e.child, ()))) for e in edges}
    poses = {i: item.pose for i, item in placed.items()}
    rng = np.random.default_rng(config.seed)
    progress.start(config.mcmc_sweeps, "searching poses")
    for sweep in range(config.mcmc_sweeps):
        cooled = sweep / max(config.mcmc_sweeps - 1, 1)
        for i in placed:
            seen = placed[i].pose
            now = _energy(bench.probe(i, poses[i], -_REACH_M), around[i], seen, poses[i])
            proposal = _proposal(rng, poses[i], cooled)
            then = _energy(bench.probe(i, proposal, -_REACH_M), around[i], seen, proposal)
            temperature = _HOT_M * (_COLD_M / _HOT_M) ** cooled
            # Drawn in any case: the random sequence must not depend on the last bits of energies.
            chance = rng.uniform()
            if then < now or chance < np.exp((now - then) / temperature):
                poses[i] = proposal
            bench.freeze(i, poses[i])
        progress.advance()
    return {i: replace(item, pose=poses[i]) for i, item in placed.items()}


def _energy(contacts: list[Contact], around: _Neighbors, seen: np.ndarray, pose: np.ndarray) -> float:
    """Return the energy (metres) of an object's pose (4, 4); `seen` is the reconstructed one."""
    nearest: dict[int, float] = {}
    for c in contacts:
        nearest[c.second] = min(nearest.get(c.second, np.inf), c.separation_m)
    depth = sum(max(-gap, 0.0) for gap in nearest.values())
    gaps = sum(max(nearest.get(i, _REACH_M), 0.0) for i in (around.parent, *around.children))
    moved, turned = pose_change(seen, pose)
    return depth + _GAP_WEIGHT * gaps + _MOVED_WEIGHT * (moved + _TURN_M * np.radians(turned))


def _proposal(rng: np.random.Generator, pose: np.ndarray, cooled: float) -> np.ndarray:
    """Draw a pose nearby, rotated about the object's origin; `cooled` is the progress of annealing, 0 to 1."""
    step, turn = (hot * (cold / hot) ** cooled for hot, cold in (_STEP_M, _STEP_RAD))
    axis = rng.normal(size=3) * turn * np.array([_TILT_SHARE, _TILT_SHARE, 1.0])
    angle = max(float(np.linalg.norm(axis)), 1e-12)
    quat = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis / angle])
    out = pose.copy()
    out[:3, :3] = matrix_from_quat(quat) @ pose[:3, :3]
    out[:3, 3] += rng.normal(size=3) * step
    return out
