"""Generation backends: services and models that complete an object from pictures of it, where the user has one.

They stand on the same seam as the embedded completion. What they return is registered to what was seen and rejected
where it disagrees; then the embedded completion stands in (docs/generation.md).
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
