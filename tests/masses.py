"""Mass properties of what tests build of convex parts."""

import numpy as np
import trimesh


def mass_entry(parts: list[trimesh.Trimesh], mass_kg: float) -> dict:
    """Return the facts on the mass of uniform parts that do not overlap, as an object of a bundle has them."""
    solids = [part for part in parts if part.volume > 1e-9]
    volume = sum(part.volume for part in solids)
    center = sum(part.volume * part.center_mass for part in solids) / volume
    inertia = np.zeros((3, 3))
    for part in solids:
        arm = part.center_mass - center
        inertia += part.moment_inertia + part.volume * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return {
        "density_kg_m3": mass_kg / volume,
        "mass_kg": mass_kg,
        "center_of_mass": center.tolist(),
        "inertia": (0.5 * (inertia + inertia.T) * mass_kg / volume).tolist(),
    }
