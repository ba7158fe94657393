"""How the scene is put together: limits and rules of stage 9."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class AssemblyConfig:
    """Bounds of every move that assembly may make. Friction and mass are never touched."""

    method: Literal["hierarchical", "in-situ", "mcmc"] = "hierarchical"
    """From the floor up in physics, with repairs; or, to compare with, everything left where it was reconstructed, or
    searched for poses without overlap after the fact (docs/assembly.md)."""
    fixed_extent_m: float = 0.6
    """Things on the floor larger than this are furniture: they do not move in the simulation."""
    fixed_mass_kg: float = 15.0
    """Heavier things do not move either."""
    upright_tilt_deg: float = 6.0
    """Poses tilted by less than this are set upright before they are let go."""
    penetration_mm: float = 0.3
    """Overlap that counts as touching."""
    max_give_m: float = 0.012
    """How much of its collision shape each of two things gives up where they overlap sideways, before one is moved."""
    max_lift_m: float = 0.06
    """How far an object is lifted out of what it was reconstructed in."""
    max_shift_m: float = 0.03
    """How far an object is shifted sideways out of its neighbors."""
    max_snap_m: float = 0.02
    """How far furniture is moved down to meet the floor, and a movable thing out of a wall."""
    max_wall_snap_m: float = 0.12
    """How far a hanging thing is moved along a wall's normal to touch it."""
    settle_s: float = 2.0
    """Time an object is given to come to rest."""
    max_turn_deg: float = 8.0
    """An object that turns more has tipped."""
    max_slide_m: float = 0.015
    """An object that slides farther has slipped."""
    max_drop_m: float = 0.05
    """An object that drops farther (from clear of its parent) has missed its parent."""
    max_fall_m: float = 0.15
    """What falls over or down, but no farther than this, is left where it came to rest, and that is said."""
    foot_bands_mm: tuple[float, ...] = (2.0, 5.0, 10.0)
    """Unevenness taken off the underside, tried in this order, when an object does not stand by itself."""
    search_shifts_m: tuple[float, ...] = (0.006, 0.012)
    """Sideways offsets tried when an object still does not stand."""
    joint_settle_s: float = 3.0
    """Time all objects together are given to come to rest."""
    joint_rounds: int = 4
    """How often the whole scene is settled, measured and repaired."""
    mcmc_sweeps: int = 150
    """For `mcmc`: how often a new pose is proposed for every object."""
    seed: int = 0
    """For `mcmc`: seed of the proposals."""
    freeze_unstable: bool = True
    """Make what cannot be made to stand immovable (said in its `repair`), instead of leaving it unstable."""


ASSEMBLY_PRESETS = {
    "fast": AssemblyConfig(joint_rounds=2, search_shifts_m=(0.008,)),
    "default": AssemblyConfig(),
    "quality": AssemblyConfig(joint_rounds=6),
}
