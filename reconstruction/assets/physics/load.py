"""Loading of the physicist that the config names."""

import os

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.physics.base import Physicist
from reconstruction.core.plugins import load_plugin


def load_physicist(config: AssetsConfig) -> Physicist | None:
    """Return the backend that `config.physics` asks for; None for the table alone.

    Raises:
        EnvironmentMissing: no endpoint or no model is named.
    """
    if config.physics == "table":
        return None
    if config.physics != "vlm":
        return load_plugin("assets.physics", config.physics, AssetsConfig)(config)
    from reconstruction.assets.physics.vlm import VlmPhysicist
    from reconstruction.learned.vlm import Endpoint, VlmClient

    return VlmPhysicist(VlmClient(Endpoint.from_environment("assets.physics", config.physics_model)))


def physics_backend(config: AssetsConfig) -> str:
    """Return the name of the source of materials, for the bundle."""
    if config.physics != "vlm":
        return config.physics
    return f"{config.physics} ({config.physics_model or os.environ.get('SIMRECON_VLM_MODEL', '')})"


def outside_inputs(config: AssetsConfig) -> tuple[str, ...]:
    """Return the inputs outside the config that results depend on: another model must not reuse a result."""
    return () if config.physics != "vlm" else (f"physics {physics_backend(config)}",)
