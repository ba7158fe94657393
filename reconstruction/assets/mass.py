"""Mass, centre of mass and inertia of a closed mesh of some material."""

import numpy as np

from reconstruction.assets.materials import MATERIALS, MaterialChoice
from reconstruction.assets.solid import Solid
from reconstruction.types import PhysicalAttributes

_MIN_KG, _MAX_KG = 0.005, 250.0


def physical_attributes(solid: Solid, choice: MaterialChoice) -> PhysicalAttributes:
    """Compute physics in the solid's own space; hollow things weigh what their walls weigh, packages their contents.

    Args:
        solid: Closed mesh in object space.
        choice: Of `materials.choose_material`.

    Returns:
        Attributes whose inertia is positive definite.
    """
    material = MATERIALS[choice.name]
    volume, center, inertia = mass_properties(solid)
    extents = np.maximum(solid.extents, 1e-3)
    if volume <= 1e-9:
        volume = float(extents.prod()) * 0.5
        center = (solid.vertices.min(axis=0) + solid.vertices.max(axis=0)) / 2
        inertia = volume * np.diag([extents @ extents - e * e for e in extents]) / 12
    matter = volume
    if choice.filled_density_kg_m3 > 0:
        mass = volume * choice.filled_density_kg_m3
    else:
        if choice.hollow:
            matter = min(volume, surface_area(solid) * material.wall_m)
        mass = matter * material.density_kg_m3
    mass = float(np.clip(mass, _MIN_KG, _MAX_KG))
    inertia = inertia * (mass / volume)
    if choice.hollow and choice.filled_density_kg_m3 == 0 and matter < volume:
        # Matter at the walls is farther from the centre: 5/3 for a thin spherical shell, the same order for boxes.
        inertia = inertia * (1 + (1 - matter / volume) * 2 / 3)
    inertia = (inertia + inertia.T) / 2
    # No thinner than a 2 mm plate of that size: tiny principal moments make solvers blow up.
    floor = mass * (0.1 * extents.max()) ** 2 / 12
    values, axes = np.linalg.eigh(inertia)
    inertia = (axes * np.maximum(values, floor)) @ axes.T
    return PhysicalAttributes(
        material=choice.name,
        density_kg_m3=material.density_kg_m3,
        mass_kg=mass,
        center_of_mass=np.asarray(center, np.float64),
        inertia=inertia,
        friction=material.friction,
        restitution=material.restitution,
    )


def mass_properties(solid: Solid) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume, centroid (3,) and second moment about it as inertia of unit density (3, 3), exactly."""
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
    inertia = np.trace(covariance) * np.eye(3) - covariance
    return volume, center + shift, inertia


def surface_area(solid: Solid) -> float:
    """Return the area of a mesh in square metres."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
