"""The instances stage: base planes, segmentation, boxes and labels, id maps, names."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import DepthMaps, InstanceSet, Plane, PosedFrames, Surface
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.cut import Cut, Shell
from reconstruction.instances.describe import describe
from reconstruction.instances.id_maps import render_id_maps, without_unseen
from reconstruction.instances.mask_cut import cut_by_masks
from reconstruction.instances.masks import load_mask_backend
from reconstruction.instances.masks.base import FrameMasks
from reconstruction.instances.mirrors import hang_mirrors
from reconstruction.instances.naming import load_namer, name_instances
from reconstruction.instances.outlined import add_outlined
from reconstruction.instances.partition import cut_by_partition
from reconstruction.instances.sightings import sightings
from reconstruction.instances.structure import find_structure


def make_instances(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, config: InstancesConfig, *, mirrors: Sequence[Plane] = (),
    progress: Progress,
) -> InstanceSet:  # fmt: skip
    """Segment the surface and name the objects; see `find_instances`, `hang_mirrors` and `load_namer`.

    The namer is loaded first, so that its errors come before any work.
    """
    namer = load_namer(config)
    found = find_instances(posed, depth, surface, config, progress=progress)
    found = hang_mirrors(found, mirrors, surface, posed, depth)
    return found if namer is None else name_instances(namer, found, posed, progress=progress)


def find_instances(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, config: InstancesConfig, *, progress: Progress
) -> InstanceSet:
    """Segment the surface into base entities and objects.

    Args:
        posed: keyframes with cameras in world space.
        depth: their depth in metres.
        surface: the fused surface in world space, floor at z = 0, walls roughly along the axes.
        config: the segmentation method, and the least size of objects.
        progress: receives notes of decisions: an assumed floor, an empty room.

    Returns:
        The instances; ids count from 1, base entities first (floor, walls, ceiling), then objects by size.

    Raises:
        UsageError: a folder of masks does not fit the capture.
        EnvironmentMissing: a package or weights of the mask model are missing, or the weights of the partition cannot
            be read.
    """
    backend = load_mask_backend(config)
    masks = None if backend is None else backend.frame_masks(posed, depth, progress=progress)
    progress.start(3, "base planes and things")
    shell = Shell.of(surface, progress)
    progress.advance()
    if masks is None:
        cut = cut_by_partition(shell, surface, sightings(surface, posed, depth), config, progress)
    else:
        cut = cut_by_masks(shell, surface, posed, depth, masks, config, progress)
    progress.advance()
    structure = None
    if config.structure:
        structure = find_structure(shell, cut, np.asarray(surface.weights), config.min_structure_area_m2)
    if structure is not None:
        area_m2 = float(shell.graph.areas[structure.vertices].sum())
        progress.note(f"{area_m2:.1f} m2 of it are kept as structure: static, and carrying")
    vertex_instance = cut.owner.copy()
    objects = describe(shell.graph, cut.things, shell.base, vertex_instance, structure)
    number = 0 if structure is None else int(vertex_instance[structure.vertices[0]])
    progress.advance()
    if not objects:
        progress.note("No separate objects were found: the scene is an empty room.")
    labeled = _with_instance_ids(cut, len(shell.base), vertex_instance)
    id_maps = render_id_maps(posed, depth, surface, vertex_instance, config, labeled, progress=progress)
    found = InstanceSet(vertex_instance, shell.base, objects, id_maps, number)
    if masks is not None and labeled is not None:
        masks = masks.resized(labeled.camera.width, labeled.camera.height)
        found = add_outlined(found, masks, labeled, posed, depth, surface, config, progress)
    return without_unseen(found, config, progress)


def _with_instance_ids(cut: Cut, base: int, vertex_instance: np.ndarray) -> FrameMasks | None:
    """Return the labeled masks with the final ids of objects, which `describe` assigned by size."""
    if cut.labeled is None:
        return None
    numbers = [vertex_instance[thing.vertices[0]] for thing in cut.things]
    return replace(cut.labeled, ids=np.r_[np.arange(base + 1), numbers].astype(np.uint16)[cut.labeled.ids])
