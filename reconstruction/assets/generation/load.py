"""Loading of the generator that the config names."""

import os
from pathlib import Path

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.generation.base import GenerationBackend
from reconstruction.assets.generation.records import Records
from reconstruction.assets.generation.service import ServiceLimits
from reconstruction.core.plugins import load_plugin
from registry import default_registry_root

RECORDS_VARIABLE = "SIMRECON_GENERATION_RECORDS"


def load_generator(config: AssetsConfig) -> GenerationBackend | None:
    """Return the configured generator; None for the embedded completion alone.

    Nothing is sent, and models are loaded with the first object.

    Raises:
        UsageError: its address is not valid.
    """
    if config.generator == "none":
        return None
    limits = ServiceLimits(config.generator_timeout_s, int(config.generator_max_mb * (1 << 20)))
    if config.generator == "rodin":
        from reconstruction.assets.generation.rodin import Rodin

        return Rodin(config.generator_url, config.generator_model, config.seed, limits)
    if config.generator == "hunyuan3d":
        from reconstruction.assets.generation.hunyuan import Hunyuan3D

        return Hunyuan3D(
            config.generator_url, config.generator_model, textured=config.generator_texture,
            poll=config.generator_poll, seed=config.seed, limits=limits,
        )  # fmt: skip
    if config.generator in ("trellis", "sam3d"):
        from reconstruction.assets.generation.local import Sam3D, Trellis

        backend = Trellis if config.generator == "trellis" else Sam3D
        return backend(config.generator_model, config.seed)
    return load_plugin("assets.generator", config.generator, AssetsConfig)(config)


def records_folder() -> Path:
    """Return the folder of records: SIMRECON_GENERATION_RECORDS, or `generated` beside the registry."""
    named = os.environ.get(RECORDS_VARIABLE, "")
    return Path(named).expanduser() if named else default_registry_root().parent / "generated"


def check_generator(config: AssetsConfig) -> None:
    """Check the configured generator early, as its stage runs minutes later; with records, none is needed.

    Raises:
        EnvironmentMissing: a key is not set, or a package is not installed.
        UsageError: an address is not valid.
    """
    backend = load_generator(config)
    if backend is not None and not Records(records_folder(), backend).any_kept():
        backend.check()
