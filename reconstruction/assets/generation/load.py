"""Which generator completes objects: what the config asks for."""

import os
from pathlib import Path

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.generation.base import GenerationBackend
from reconstruction.assets.generation.records import Records
from reconstruction.assets.generation.service import ServiceLimits
from registry import default_registry_root

RECORDS_VARIABLE = "SIMRECON_GENERATION_RECORDS"


def load_generator(config: AssetsConfig) -> GenerationBackend | None:
    """Return the backend that `config.generator` asks for; None for the embedded completion alone.

    Models are loaded when the first object is generated, so this is quick and sends nothing.

    Raises:
        UsageError: its address is none.
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
            config.generator_url,
            config.generator_model,
            textured=config.generator_texture,
            poll=config.generator_poll,
            seed=config.seed,
            limits=limits,
        )
    from reconstruction.assets.generation.local import Sam3D, Trellis

    made = {"trellis": Trellis, "sam3d": Sam3D}[config.generator]
    return made(config.generator_model, config.seed)


def records_folder() -> Path:
    """Return where meshes are kept: SIMRECON_GENERATION_RECORDS, or `generated` beside the registry."""
    named = os.environ.get(RECORDS_VARIABLE, "")
    return Path(named).expanduser() if named else default_registry_root().parent / "generated"


def check_generator(config: AssetsConfig) -> None:
    """Say at once what would otherwise stop the stage minutes later; kept meshes need no generator.

    Raises:
        EnvironmentMissing: a key is not set, or a package is not installed.
        UsageError: an address is none.
    """
    backend = load_generator(config)
    if backend is not None and not Records(records_folder(), backend).any_kept():
        backend.check()
