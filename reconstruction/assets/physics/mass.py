"""Mass, center of mass and inertia of a closed mesh of a given material."""

import numpy as np

from reconstruction.assets.physics.materials import MaterialChoice
from reconstruction.assets.solid import Solid
from reconstruction.core.types import PhysicalAttributes, PhysicalRanges

_MIN_KG, _MAX_KG = 0.005, 250.0


def physical_attributes(solid: Solid, choice: MaterialChoice) -> PhysicalAttributes:
    """Compute the physics of an object: hollow ones weigh as much as their walls, packages include their contents.

    Args:
        solid: closed mesh in object space.
        choice: its material, see `materials.choose_material`.

    Returns:
        Attributes with positive definite inertia. The mass range spans material, wall thickness and, for packages,
        empty to full, for this very shape. Errors of the shape or of the scene's scale come on top (mass grows with
        the third power of length).
    """
    material = choice.material
    volume, center, inertia = mass_properties(solid)
    extents = np.maximum(solid.extents, 1e-3)
    if volume <= 1e-9:
        volume = float(extents.prod()) * 0.5
        center = (solid.vertices.min(axis=0) + solid.vertices.max(axis=0)) / 2
        inertia = volume * np.diag([extents @ extents - e * e for e in extents]) / 12
    area, shell_center, shell_inertia = shell_properties(solid)

    def walls(density: float, wall_m: float) -> float:
        return density * min(volume, area * wall_m)

    density, wall = material.density_kg_m3, material.wall_m
    mass, low, high = (density.value * volume, density.low * volume, density.high * volume)
    solid_share = 1.0  # share of the mass in the volume; the rest is in the walls
    if choice.hollow or choice.filled_kg_m3:
        mass, low, high = (walls(d, w) for d, w in zip(density, wall))
        solid_share = mass / (density.value * volume)
    if choice.filled_kg_m3:
        usual, heavy = choice.filled_kg_m3
        mass, high, solid_share = usual * volume, max(heavy * volume, mass), 1.0
    if choice.mass_kg:
        low, high = choice.mass_kg
        mass = float(np.sqrt(low * high))
    mass, low, high = (float(np.clip(x, _MIN_KG, _MAX_KG)) for x in (mass, min(low, mass), max(high, mass)))
    middle = solid_share * center + (1 - solid_share) * shell_center
    inertia = mass * (
        solid_share * (inertia / volume + _offset(center - middle))
        + (1 - solid_share) * (shell_inertia / max(area, 1e-12) + _offset(shell_center - middle))
    )
    return PhysicalAttributes(
        material=choice.name,
        density_kg_m3=density.value,
        mass_kg=mass,
        center_of_mass=np.asarray(middle, np.float64),
        inertia=_solvable(inertia, mass, extents),
        friction=material.friction.value,
        restitution=material.restitution.value,
        ranges=PhysicalRanges((low, high), material.friction[1:], material.restitution[1:]),
    )


def _offset(shift: np.ndarray) -> np.ndarray:
    """Return the inertia (3, 3) of unit mass displaced by `shift` (3,) (parallel axis theorem)."""
    return shift @ shift * np.eye(3) - np.outer(shift, shift)


def _solvable(inertia: np.ndarray, mass: float, extents: np.ndarray) -> np.ndarray:
    """Raise the moments of inertia (3, 3) to a fraction of a plate's of that size: solvers diverge on tiny ones."""
    floor = mass * (0.1 * extents.max()) ** 2 / 12
    values, axes = np.linalg.eigh((inertia + inertia.T) / 2)
    return (axes * np.maximum(values, floor)) @ axes.T


def mass_properties(solid: Solid) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume, centroid (3,) and inertia about it at unit density (3, 3), exactly."""
    shift = solid.vertices.mean(axis=0)
    a, b, c = (solid.vertices[solid.faces[:, k]] - shift for k in range(3))
    six = np.einsum("nk,nk->n", a, np.cross(b, c))
    volume = float(six.sum() / 6)
    if volume <= 1e-12:
        return 0.0, shift, np.zeros((3, 3))
    center = np.einsum("n,nk->k", six, a + b + c) / 24 / volume
    total = a + b + c
    second = sum(np.einsum("n,ni,nj->ij", six, p, p) for p in (a, b, c, total)) / 120
    covariance = second - volume * np.outer(center, center)
    return volume, center + shift, np.trace(covariance) * np.eye(3) - covariance


def shell_properties(solid: Solid) -> tuple[float, np.ndarray, np.ndarray]:
    """Return area, centroid (3,) of the surface and inertia about it at 1 kg/m2 (3, 3), exactly."""
    shift = solid.vertices.mean(axis=0)
    a, b, c = (solid.vertices[solid.faces[:, k]] - shift for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    area = float(areas.sum())
    if area <= 1e-12:
        return 0.0, shift, np.zeros((3, 3))
    total = a + b + c
    center = np.einsum("n,nk->k", areas, total) / 3 / area
    second = sum(np.einsum("n,ni,nj->ij", areas, p, p) for p in (a, b, c, total)) / 12
    covariance = second - area * np.outer(center, center)
    return area, center + shift, np.trace(covariance) * np.eye(3) - covariance
