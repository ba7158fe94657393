"""The stage itself: base planes, the cut, boxes and labels, id maps."""

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.cut import Shell
from reconstruction.instances.describe import describe
from reconstruction.instances.id_maps import render_id_maps
from reconstruction.instances.rules import cut_by_rules
from reconstruction.instances.scraps import without_fragments, without_unseen
from reconstruction.progress import Progress
from reconstruction.types import DepthMaps, InstanceSet, PosedFrames, Surface


def find_instances(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, config: InstancesConfig, *, progress: Progress
) -> InstanceSet:
    """Cut the surface into base entities and separate things.

    Args:
        posed: keyframes with cameras in world space.
        depth: their depth in metres.
        surface: the fused surface in world space, floor at z = 0, walls roughly along the axes.
        config: thresholds.
        progress: told of decisions: a floor that had to be assumed, an empty room.

    Returns:
        The instances; ids count from 1, base entities first (floor, walls, ceiling), then objects by size.
    """
    progress.start(3, "base planes and things")
    shell = Shell.of(surface, progress)
    progress.advance()
    cut = cut_by_rules(shell, posed, depth, config, progress)
    progress.advance()
    things = without_fragments(shell.graph, cut.things, shell.base[0].observed, config, progress)
    vertex_instance = cut.owner.copy()
    for thing in things:
        if thing.attached:
            vertex_instance[thing.vertices] = 0
    objects = describe(shell.graph, things, shell.base, vertex_instance)
    progress.advance()
    if not objects:
        progress.note("No separate things were found: the scene is an empty room.")
    id_maps = render_id_maps(posed, depth, surface, vertex_instance, config, progress=progress)
    return without_unseen(InstanceSet(vertex_instance, shell.base, objects, id_maps), config, progress)
