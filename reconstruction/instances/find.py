"""The stage itself: base planes, the cut, boxes and labels, id maps."""

from dataclasses import replace

import numpy as np

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.contact_skirts import cut_cleaned_stacks
from reconstruction.instances.cut import Cut, Shell
from reconstruction.instances.describe import describe
from reconstruction.instances.doubts import as_drawn, without_doubts
from reconstruction.instances.hung import add_hung
from reconstruction.instances.id_maps import render_id_maps
from reconstruction.instances.mask_cut import cut_by_masks
from reconstruction.instances.masks import load_mask_backend
from reconstruction.instances.masks.base import FrameMasks
from reconstruction.instances.outlined import add_outlined
from reconstruction.instances.partition import cut_by_partition
from reconstruction.instances.refine import refine_by_views
from reconstruction.instances.rules import cut_by_rules
from reconstruction.instances.scraps import without_unseen
from reconstruction.instances.sightings import sightings
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
        config: where the cut comes from, and thresholds.
        progress: told of decisions: a floor that had to be assumed, an empty room.

    Raises:
        UsageError: a folder of masks does not fit the capture.
        EnvironmentMissing: the learned masks asked for need something that is not here.

    Returns:
        The instances; ids count from 1, base entities first (floor, walls, ceiling), then objects by size.
    """
    backend = load_mask_backend(config)
    masks = None if backend is None else backend.frame_masks(posed, depth, progress=progress)
    progress.start(3, "base planes and things")
    shell = Shell.of(surface, progress)
    progress.advance()
    frames = sightings(surface, posed, depth)
    by_rules = masks is None and config.cut == "rules"
    if masks is not None:
        cut = cut_by_masks(shell, surface, posed, depth, masks, config, progress)
    elif by_rules:
        cut = cut_by_rules(shell, surface, posed, depth, frames, config, progress)
        cut = refine_by_views(shell, cut, surface, posed, depth, config, progress)
    else:
        cut = cut_by_partition(shell, surface, frames, config, progress)
    taken = without_doubts(shell, cut.things, frames, progress)
    if by_rules:
        again = cut_cleaned_stacks(shell.graph, surface, cut.things, posed, depth, config, progress)
        cut = replace(cut, things=again)
    progress.advance()
    vertex_instance = cut.owner.copy()
    objects = describe(shell.graph, cut.things, shell.base, vertex_instance)
    progress.advance()
    if not objects:
        progress.note("No separate things were found: the scene is an empty room.")
    told = None if cut.told is None else _with_numbers(cut.told, cut, len(shell.base), vertex_instance)
    drawn = as_drawn(shell.graph, vertex_instance, taken)
    id_maps = render_id_maps(posed, depth, surface, drawn, config, told, progress=progress)
    found = InstanceSet(vertex_instance, shell.base, objects, id_maps)
    if told is not None and masks is not None:
        asked = masks.resized(told.camera.width, told.camera.height)
        found = add_outlined(found, asked, told, posed, depth, surface, config, progress)
    elif masks is None:
        found = add_hung(found, posed, depth, surface, config, progress)
    return without_unseen(found, config, progress)


def _with_numbers(told: FrameMasks, cut: Cut, base: int, vertex_instance: np.ndarray) -> FrameMasks:
    """Return the masks with the numbers of things that `describe` gave, for ids in the order of the cut."""
    numbers = [vertex_instance[thing.vertices[0]] for thing in cut.things]
    return replace(told, ids=np.r_[np.arange(base + 1), numbers].astype(np.uint16)[told.ids])
