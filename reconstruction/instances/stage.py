"""The stage as the pipeline runs it: things are found, then named."""

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.find import find_instances
from reconstruction.instances.naming import load_namer, name_instances
from reconstruction.progress import Progress
from reconstruction.types import DepthMaps, InstanceSet, PosedFrames, Surface


def make_instances(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, config: InstancesConfig, *, progress: Progress
) -> InstanceSet:
    """Find things and name them; see `find_instances` and `load_namer`, whose errors come before any work."""
    namer = load_namer(config)
    found = find_instances(posed, depth, surface, config, progress=progress)
    return found if namer is None else name_instances(namer, found, posed, progress=progress)
