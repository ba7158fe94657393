"""Who says what things are made of: what the config asks for, loaded."""

import os

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.physics.base import Physicist


def load_physicist(config: AssetsConfig) -> Physicist | None:
    """Return the backend that `config.physics` asks for; None for the table alone.

    Raises:
        EnvironmentMissing: no endpoint or no model is named.
    """
    if config.physics == "table":
        return None
    from reconstruction.assets.physics.vlm import VlmPhysicist
    from reconstruction.learned.vlm import Endpoint, VlmClient

    return VlmPhysicist(VlmClient(Endpoint.from_environment("assets.physics", config.physics_model)))


def physics_backend(config: AssetsConfig) -> str:
    """Say who decides, for the bundle."""
    if config.physics == "table":
        return "table"
    return f"{config.physics} ({config.physics_model or os.environ.get('SIMRECON_VLM_MODEL', '')})"


def outside_inputs(config: AssetsConfig) -> tuple[str, ...]:
    """Return what stands behind the names in the config: another model must not reuse a result."""
    return () if config.physics == "table" else (f"physics {physics_backend(config)}",)
