"""Graphs with truth from rooms on disk: fused surfaces, features of superpoints and borders, true entities; cached.

Three rooms of four keep the depth that the aggregation network predicted, where the dataset holds it: the cut has to do
with surfaces of `prior=both` first, and of `prior=mending`.
"""

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from priors.rooms import Film, Sources, draw_film
from priors.samples import Room
from priors.surfaces import true_ids
from reconstruction.code_digest import code_digest, tree_digest
from reconstruction.core import artifacts
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, Surface
from reconstruction.core.workers import Workers
from reconstruction.depth import DepthConfig
from reconstruction.depth.evidence import PREDICTED, Evidence
from reconstruction.depth.mending import WEIGHTS, drop_unconfirmed, mend_depth
from reconstruction.depth.views import plan_views
from reconstruction.instances.cut import Shell
from reconstruction.instances.partition.cut import features
from reconstruction.instances.partition.features import Shapes, View
from reconstruction.instances.partition.graph import region_graph
from reconstruction.instances.sightings import sightings
from reconstruction.surface import SurfaceConfig, fuse_surface
from registry.errors import UsageError
from synthetic.capture import posed_capture

NEEDED = (
    "picture", "depth", "origin", "correlation", "surety", "exact_depth", "exact_ids", "world_from_camera", "focal",
)  # fmt: skip
_FEATURE_MODULES = tuple(
    f"reconstruction.instances.{name}" for name in ("cut", "superpoints", "sightings", "partition.features")
)
TRIMMED = 1.0  # percent of a thing's points at either side of its box, as in `reconstruction.measure`
_STEP_PX = 4
_LEAST_PURITY = 0.6  # of a superpoint's known surface must be of one entity


@dataclass(frozen=True)
class Example:
    """One room's graph and its truth."""

    nodes: np.ndarray  # float32 (n, F) features of regions
    edges: np.ndarray  # float32 (e, G) features of borders
    pairs: np.ndarray  # int32 (e, 2)
    centers: np.ndarray  # float32 (n, 3) of regions, world metres
    region: np.ndarray  # int32 (v,) region of each vertex
    areas: np.ndarray  # float64 (v,) m2
    true_ids: np.ndarray  # uint16 (v,) entity, 0 = artifact
    base_entities: np.ndarray  # int () ids 1 to this one are floor and walls
    pixels: np.ndarray  # float64 (ids,) greatest share of a keyframe that shows each entity
    boxes: (
        np.ndarray
    )  # float64 (ids, 2, 3) around the true points that keyframes show of each entity, nan for none

    def region_ids(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the entity int (n,) with most surface in each region, and whether the region is pure."""
        count, ids = len(self.nodes), int(self.true_ids.max()) + 1
        table = np.zeros((count, ids))
        np.add.at(table, (self.region, self.true_ids), np.maximum(self.areas, 1e-12))
        return table.argmax(axis=1), table.max(axis=1) > _LEAST_PURITY * table.sum(axis=1)


def cached(room: Room, cache: Path, kind: str) -> Path:
    """Return where something of a room is kept, which follows from its arrays and the weights that mend its depth."""
    weights = hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()[:12]
    made = hashlib.sha256((room.folder / "room.json").read_bytes()).hexdigest()[:12]
    kind = f"{kind}-predicted" if _keeps_predictions(room) else kind
    return cache / kind / weights / room.folder.parent.name / f"{room.folder.name}-{made}"


def _keeps_predictions(room: Room) -> bool:
    return int(room.folder.name) % 4 != 0 and bool((np.asarray(room.arrays["origin"]) == PREDICTED).any())


def digest_of(modules: Sequence[str]) -> str:
    """Return a digest of this file and of the code behind modules."""
    code = [tree_digest(Path(__file__)), *(code_digest(name) for name in modules)]
    return hashlib.sha256("".join(code).encode()).hexdigest()[:12]


def frames_and_depth(room: Room, cache: Path) -> tuple[PosedFrames, DepthMaps]:
    """Return the keyframes with true cameras, and their depth as the depth stage mends it.

    Mended maps are taken from the cache if the same weights made them.
    """
    posed, found = _evidence(room)
    folder = cached(room, cache, "mended")
    if not folder.is_dir():
        config = DepthConfig()
        mended = mend_depth(found, posed, config.mend_surety, Workers(1).each)
        mended = drop_unconfirmed(mended, found.depth, posed, config.min_agreeing, Workers(1).each)
        _save(mended.maps(), folder)
    return posed, artifacts.load(DepthMaps, folder)


def _evidence(room: Room) -> tuple[PosedFrames, Evidence]:
    """Return the keyframes with true cameras, and their depth before it is mended."""
    a = room.arrays
    left_out = (np.asarray(a["origin"]) == PREDICTED) & (not _keeps_predictions(room))
    depth = np.where(left_out, 0, a["depth"]).astype(np.float32)
    height, width = depth.shape[1:]
    fx, fy = (float(f) for f in a["focal"])
    camera = Camera(width, height, fx, fy, 0.5 * width, 0.5 * height)
    posed = posed_capture(
        camera, np.asarray(a["world_from_camera"]), np.asarray(a["picture"]), depth, room.folder.name
    )
    origin = np.where(left_out, 0, a["origin"]).astype(np.uint8)
    correlation, surety = (np.asarray(a[name], np.float32) / 100 for name in ("correlation", "surety"))
    neighbors = plan_views(posed, DepthConfig()).neighbors
    return posed, Evidence(camera, neighbors, depth, origin, correlation, surety, np.zeros(0, np.float32))


def fused(room: Room, cache: Path) -> Surface:
    """Return the fused surface of a room, from the cache if it is there."""
    folder = cached(room, cache, "surfaces")
    if not folder.is_dir():
        _save(fuse_surface(*frames_and_depth(room, cache), SurfaceConfig()), folder)
    return artifacts.load(Surface, folder)


def _save(value: DepthMaps | Surface, folder: Path) -> None:
    """Write a folder of arrays, whole or not at all."""
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    artifacts.save(value, part)
    part.rename(folder)


def room_view(room: Room, cache: Path) -> View:
    """Return a room's fused surface as its keyframes see it."""
    surface = fused(room, cache)
    shell = Shell.of(surface, NO_PROGRESS)
    return View.of(shell.graph, surface, sightings(surface, *frames_and_depth(room, cache)))


def example(room: Room, cache: Path, sources: Sources) -> Example:
    """Return the graph of a room with its truth, from the cache if the code that made it is the same."""
    file = cached(room, cache, f"graphs-{digest_of(_FEATURE_MODULES)}").with_suffix(".npz")
    if not file.is_file():
        write_example(file, _made(room, cache, sources))
    return read_example(file)


def write_example(file: Path, made: Example) -> None:
    """Write a graph with its truth, whole or not at all."""
    write_arrays(file, **{f.name: getattr(made, f.name) for f in fields(Example)})


def read_example(file: Path) -> Example:
    """Read what `write_example` wrote."""
    with np.load(file) as stored:
        return Example(**{f.name: stored[f.name] for f in fields(Example)})


def _made(room: Room, cache: Path, sources: Sources) -> Example:
    view = room_view(room, cache)
    graph = region_graph(view.mesh)
    nodes, edges = features(view, graph)
    centers = Shapes.of(view.mesh, graph).center.astype(np.float32)
    truth = _truth(room, view.surface, cache, sources)
    return Example(nodes, edges, graph.pairs, centers, graph.region, view.mesh.areas, **truth)


def _truth(room: Room, surface: Surface, cache: Path, sources: Sources) -> dict[str, np.ndarray]:
    """Return the last fields of a room's example, from the cache if they are there."""
    file = cached(room, cache, "truths").with_suffix(".npz")
    if not file.is_file():
        film = film_of(room, sources)
        eyes = np.asarray(room.arrays["world_from_camera"])[:, :3, 3]
        ids = true_ids(film.film_set, np.asarray(surface.vertices, np.float64), eyes)
        exact = np.asarray(room.arrays["exact_ids"])
        count = int(max(exact.max(), film.film_set.face_entity.max())) + 1
        pixels = np.stack([np.bincount(row.ravel(), minlength=count) for row in exact]).max(axis=0)
        write_arrays(
            file, true_ids=ids, base_entities=np.array(film.base_entities), pixels=pixels / exact[0].size,
            boxes=_shown_boxes(room, count),
        )  # fmt: skip
    with np.load(file) as stored:
        return dict(stored)


def film_of(room: Room, sources: Sources) -> Film:
    """Draw the film again that a room on disk was made of.

    Raises:
        UsageError: it is another one: drawn by other code or with other photographs.
    """
    film = draw_film(room.folder.parent.name, int(room.folder.name), sources)
    made = json.loads((room.folder / "room.json").read_text())["film"]
    if json.loads(json.dumps(film.describe())) != made:
        raise UsageError(f"{room.folder}: made by other code or with other sources, make it anew")
    return film


def _shown_boxes(room: Room, count: int) -> np.ndarray:
    """Return the boxes float64 (count, 2, 3) of the true points at every fourth pixel of the keyframes, by entity."""
    arrays = room.arrays
    depth, ids = (
        np.asarray(arrays[name])[:, ::_STEP_PX, ::_STEP_PX] for name in ("exact_depth", "exact_ids")
    )
    height, width = arrays["exact_depth"].shape[1:]
    v, u = np.mgrid[0:height:_STEP_PX, 0:width:_STEP_PX] + 0.5
    fx, fy = arrays["focal"]
    rays = np.stack([(u - 0.5 * width) / fx, (v - 0.5 * height) / fy, np.ones_like(u)], axis=-1)
    points, names = [], []
    for z, own, pose in zip(depth.astype(np.float64), ids, arrays["world_from_camera"]):
        seen = (z > 0) & (own > 0)
        points.append((rays[seen] * z[seen][:, None]) @ pose[:3, :3].T + pose[:3, 3])
        names.append(own[seen])
    points, names = np.concatenate(points), np.concatenate(names)
    out = np.full((count, 2, 3), np.nan)
    for name in np.unique(names):
        out[name] = np.percentile(points[names == name], (TRIMMED, 100 - TRIMMED), axis=0)
    return out


def write_arrays(file: Path, **arrays: np.ndarray) -> None:
    """Write arrays whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(".part.npz")
    np.savez(part, **arrays)
    part.rename(file)
