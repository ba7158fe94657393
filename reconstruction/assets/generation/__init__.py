"""Generators: services and local models that complete an object from pictures of it.

They take the place of the embedded completion. Their meshes are registered to the seen points and rejected where they
disagree; the embedded completion then stands in (docs/generation.md).
"""

from reconstruction.assets.generation.base import (
    GenerationBackend,
    GenerationError,
    GeneratorUnavailable,
    Job,
    ObjectPictures,
)
from reconstruction.assets.generation.load import check_generator, load_generator

__all__ = (
    "GenerationBackend",
    "GenerationError",
    "GeneratorUnavailable",
    "Job",
    "ObjectPictures",
    "check_generator",
    "load_generator",
)
