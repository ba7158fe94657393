"""Stage 6: cut the fused surface into floor, walls and separate things, from geometry and color alone."""

from reconstruction.instances.config import INSTANCES_PRESETS, InstancesConfig
from reconstruction.instances.find import find_instances
from reconstruction.instances.naming import load_namer, name_instances
from reconstruction.instances.outside import backends, outside_inputs
from reconstruction.instances.overrides import apply_overrides
from reconstruction.instances.stage import make_instances

VERSION = 24

__all__ = [
    "INSTANCES_PRESETS",
    "VERSION",
    "InstancesConfig",
    "apply_overrides",
    "backends",
    "find_instances",
    "load_namer",
    "make_instances",
    "name_instances",
    "outside_inputs",
]
