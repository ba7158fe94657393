"""Settings of the assembly stage."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class AssemblyConfig:
    """Bounds of all changes by assembly; friction and mass stay as they are."""

    method: Literal["hierarchical", "in-situ", "mcmc"] = "hierarchical"
    """`hierarchical`: bottom up in physics, with repairs. Baselines (docs/assembly.md): `in-situ`, reconstructed poses;
    `mcmc`, a search for collision-free poses."""
    fixed_extent_m: float = 0.6
    """Larger objects on the floor are furniture: static in the simulation."""
    fixed_mass_kg: float = 15.0
    """Heavier objects are static too."""
    upright_tilt_deg: float = 6.0
    """Largest tilt of a pose that is set upright before simulation."""
    penetration_mm: float = 0.3
    """Penetration depth that counts as contact."""
    max_give_m: float = 0.012
    """Largest depth by which each of two collision shapes that overlap sideways is cut, before one is moved."""
    max_lift_m: float = 0.06
    """Largest lift out of a penetration."""
    max_shift_m: float = 0.03
    """Largest sideways shift out of a penetration."""
    max_snap_m: float = 0.02
    """Largest move of furniture down to the floor, and of a dynamic object out of a wall."""
    max_wall_snap_m: float = 0.12
    """Largest move of an attached object along the wall's normal to touch it."""
    settle_s: float = 2.0
    """Simulated time in which an object must come to rest."""
    max_turn_deg: float = 8.0
    """Largest rotation of an object while it settles; it has tipped if it turns more."""
    max_slide_m: float = 0.015
    """Largest horizontal displacement of an object while it settles."""
    max_drop_m: float = 0.05
    """Largest drop of an object while it settles, from a pose clear of its parent."""
    max_fall_m: float = 0.15
    """Largest displacement of an object that tips or falls, and still is left where it came to rest."""
    foot_bands_mm: tuple[float, ...] = (2.0, 5.0, 10.0)
    """Bands of the underside to flatten, tried in this order, if an object does not stand by itself."""
    search_shifts_m: tuple[float, ...] = (0.006, 0.012)
    """Sideways offsets to try if an object still does not stand."""
    joint_settle_s: float = 3.0
    """Simulated time in which all objects together must come to rest."""
    joint_rounds: int = 4
    """Largest number of rounds of joint settling, measuring and repair."""
    mcmc_sweeps: int = 150
    """For `mcmc`: number of proposals per object."""
    seed: int = 0
    """For `mcmc`: seed of the proposals."""
    freeze_unstable: bool = True
    """Make objects that no repair stabilizes static (noted in their `repair`), instead of leaving them unstable."""


ASSEMBLY_PRESETS = {
    "fast": AssemblyConfig(joint_rounds=2, search_shifts_m=(0.008,)),
    "default": AssemblyConfig(),
    "quality": AssemblyConfig(joint_rounds=6),
}
