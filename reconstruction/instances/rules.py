"""The embedded cut: rules of shape, contact and color, without any masks."""

import numpy as np

from reconstruction.instances.along_walls import bridges_along_walls
from reconstruction.instances.base import base_skirts
from reconstruction.instances.boxes import quantiles
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.contents import cut_contents
from reconstruction.instances.cut import Cut, Shell
from reconstruction.instances.feet import merge_feet
from reconstruction.instances.flats import cut_flats
from reconstruction.instances.flush import merge_flush
from reconstruction.instances.foreign import ColorView, cut_foreign
from reconstruction.instances.insides import merge_insides
from reconstruction.instances.pictures import find_pictures
from reconstruction.instances.scraps import without_fragments, without_skirts
from reconstruction.instances.segmentation import Thing, segment
from reconstruction.instances.side_by_side import cut_side_by_side
from reconstruction.instances.sightings import Sighting
from reconstruction.instances.skirt_colors import mark_unlike
from reconstruction.instances.smears import without_smears, without_wall_bumps
from reconstruction.instances.stacks import cut_stacks
from reconstruction.instances.stands import merge_stands
from reconstruction.progress import Progress
from reconstruction.surface.base_planes import FittedPlane
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import DepthMaps, PosedFrames, Surface


def cut_by_rules(
    shell: Shell,
    surface: Surface,
    posed: PosedFrames,
    depth: DepthMaps,
    frames: list[Sighting],
    config: InstancesConfig,
    progress: Progress,
) -> Cut:
    """Cut what stands above the base by connectivity, supports, creases and color; find pictures on the walls."""
    graph, planes, owner = shell.graph, shell.planes, shell.owner.copy()
    things = _pictures(graph, planes, owner, posed, depth, config)
    hung = np.zeros(len(graph.points), bool)
    for thing in things:
        hung[thing.vertices] = True
    rest = np.flatnonzero((owner == 0) & ~hung & ~shell.behind)
    for vertices, number in base_skirts(graph, rest, planes, config.bridge_gap_m):
        owner[vertices] = number
    view = ColorView.of(shell, frames)
    for vertices, number in bridges_along_walls(shell, rest[owner[rest] == 0], view, config):
        owner[vertices] = number
    rest = rest[owner[rest] == 0]
    segmented, crumbs = _without_base_crumbs(graph, segment(graph, rest, config), planes)
    for vertices, number in crumbs:
        owner[vertices] = number
    owner[hung] = 0
    standing = without_wall_bumps(shell, _mark_attached(graph, segmented, planes), owner, frames)
    things = _merge_attached(graph, things + standing)
    things = merge_insides(graph, merge_feet(graph, things, progress), progress)
    things = merge_stands(graph, things, progress)
    things = cut_flats(graph, surface, things, posed, depth, config, progress)
    things = cut_foreign(shell, things, owner, view, config, progress)
    things = merge_flush(graph, cut_contents(view, things, config, progress), progress)
    things = without_smears(shell, things, owner, frames, config, progress)
    things = cut_side_by_side(graph, surface, things, posed, depth, config, progress)
    things = cut_stacks(graph, surface, things, posed, depth, config, progress)
    mark_unlike(view, things, owner)
    things = without_skirts(graph, things, progress)
    things = without_fragments(graph, things, shell.base[0].observed, config, progress)
    for thing in things:
        if thing.attached:
            owner[thing.vertices] = 0
    return Cut(things, owner)


def _pictures(
    graph: MeshGraph,
    planes: list[FittedPlane],
    owner: np.ndarray,
    posed: PosedFrames,
    depth: DepthMaps,
    config: InstancesConfig,
) -> list[Thing]:
    found: list[Thing] = []
    used = np.zeros(len(owner), bool)
    for plane in planes:
        if plane.label != "wall":
            continue
        taken = (owner > 0) & ~plane.members
        for vertices in find_pictures(graph, plane, taken | used, owner == 0, posed, depth, config):
            used[vertices] = True
            found.append(Thing(vertices, attached=True))
    return found


def _without_base_crumbs(
    graph: MeshGraph, things: list[Thing], planes: list[FittedPlane]
) -> tuple[list[Thing], list[tuple[np.ndarray, int]]]:
    """Give bumps of the floor and the walls back to them: small, thin, hugging the base all over."""
    first = 1 if planes and planes[0].label == "floor" else 2
    kept: list[Thing] = []
    crumbs = []
    carriers: set[int] = set()
    for thing in reversed(things):  # what rests on a thing comes after it
        points = graph.points[thing.vertices]
        if not planes or id(thing) in carriers:
            kept.append(thing)
            carriers.add(id(thing.rests_on))
            continue
        distances = np.stack([np.abs(plane.distance(points)) for plane in planes])
        nearest = distances.min(axis=0)
        spread = np.sort(np.ptp(points, axis=0))
        middle, most = quantiles(nearest, graph.areas[thing.vertices], (0.5, 0.9))
        thin = most < 0.035 or (spread[2] < 0.12 and middle < 0.025)
        hugging = np.average(nearest < 0.05, weights=np.maximum(graph.areas[thing.vertices], 1e-12)) > 0.8
        if (thin and spread[2] < 0.6) or hugging:
            crumbs.append((thing.vertices, first + int(np.argmin(np.median(distances, axis=1)))))
        else:
            kept.append(thing)
            carriers.add(id(thing.rests_on))
    return kept[::-1], crumbs


def _mark_attached(graph: MeshGraph, things: list[Thing], planes: list[FittedPlane]) -> list[Thing]:
    """Mark things that touch a wall and have nothing below them."""
    for thing in things:
        points = graph.points[thing.vertices]
        if thing.rests_on is not None or points[:, 2].min() < 0.15:
            continue
        for plane in planes:
            distance = quantiles(plane.distance(points), graph.areas[thing.vertices], (0.05,))[0]
            if plane.label == "wall" and distance < 0.06:
                thing.attached = True
    return things


def _merge_attached(graph: MeshGraph, things: list[Thing]) -> list[Thing]:
    """Join hanging things whose boxes overlap: a picture's frame, its inside, its sides."""
    hanging = sorted((t for t in things if t.attached), key=lambda t: -float(graph.areas[t.vertices].sum()))
    out = [t for t in things if not t.attached]
    kept: list[Thing] = []
    for thing in hanging:
        points = graph.points[thing.vertices]
        for other in kept:
            around = graph.points[other.vertices]
            low, high = around.min(axis=0) - 0.03, around.max(axis=0) + 0.03
            if ((points > low) & (points < high)).all(axis=1).mean() > 0.5:
                other.vertices = np.union1d(other.vertices, thing.vertices)
                break
        else:
            kept.append(thing)
    return kept + out
