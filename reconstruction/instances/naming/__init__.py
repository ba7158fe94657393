"""What things are called: the embedded labels, or open-vocabulary ones from models that look at the pictures.

Labels change nothing but labels: ids, boxes and surfaces stay. A thing that a model does not know, or cannot be asked
about, keeps its embedded label.
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
