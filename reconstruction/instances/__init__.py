"""Stage 6: segment the fused surface into floor, walls, ceiling and objects, by a learned partition or by 2D masks."""

from reconstruction.instances.config import INSTANCES_PRESETS, InstancesConfig
from reconstruction.instances.external import backends, outside_inputs
from reconstruction.instances.find import find_instances, make_instances
from reconstruction.instances.naming import load_namer, name_instances

__all__ = [
    "INSTANCES_PRESETS",
    "InstancesConfig",
    "backends",
    "find_instances",
    "load_namer",
    "make_instances",
    "name_instances",
    "outside_inputs",
]
