"""Open-vocabulary labels of objects by models that look at images.

Naming changes labels alone: ids, boxes and surfaces stay. An object without an answer keeps its embedded label.
"""

from reconstruction.instances.naming.base import Name, Namer, apply_names
from reconstruction.instances.naming.load import DEFAULT_CLIP_MODEL, load_namer, name_instances
from reconstruction.instances.naming.views import ObjectView, best_views, collage

__all__ = [
    "DEFAULT_CLIP_MODEL",
    "Name",
    "Namer",
    "ObjectView",
    "apply_names",
    "best_views",
    "collage",
    "load_namer",
    "name_instances",
]
