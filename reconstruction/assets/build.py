"""Stage 7: closed, textured objects with collision shapes and masses, and textured floor, walls and ceiling."""

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from reconstruction.assets import completion, solid, texture
from reconstruction.assets.collision import collision_parts, end_decomposer, kept_parts
from reconstruction.assets.config import LEAST_HULLS, AssetsConfig
from reconstruction.assets.cuboids import fit_cuboid, unfreed_cuboid
from reconstruction.assets.cut_off import Room, continued, cut_off_sides, lone_front, with_copies
from reconstruction.assets.edges import with_simple_edges
from reconstruction.assets.fused import fused_points, without_strays
from reconstruction.assets.generation.complete import Attempt, SurfaceColors, generated_shape
from reconstruction.assets.generation.fetch import Fetched, fetch_meshes
from reconstruction.assets.hanging import hanging_slab, is_outlined, outlined_slab
from reconstruction.assets.hanging_relief import mound, relief
from reconstruction.assets.physics.base import choice_for
from reconstruction.assets.physics.load import load_physicist
from reconstruction.assets.physics.mass import physical_attributes
from reconstruction.assets.physics.materials import MaterialChoice
from reconstruction.assets.room import build_room
from reconstruction.assets.solid import Solid
from reconstruction.assets.standing import Stands, find_stands, within_walls, without_children
from reconstruction.assets.structure import build_structure
from reconstruction.assets.views import MOST_AT_ONCE, ScenePixels, object_noise, prepare_pixels
from reconstruction.assets.volume import ObjectFrame, ObjectVolume, confirmed, frame_object, fuse_volume
from reconstruction.core.progress import NO_PROGRESS, NoProgress, Progress
from reconstruction.core.types import (
    AssetProvenance,
    AssetSet,
    ConvexPart,
    DepthMaps,
    Instance,
    InstanceSet,
    ObjectAsset,
    PosedFrames,
    Surface,
    TexturedMesh,
)
from reconstruction.poses.parallel import ordered_map
from reconstruction.views import SceneViews
from registry.errors import EnvironmentMissing
from registry.geometry import rigid, transform_points

# Least size of a shape along each axis, relative to:
_COVERED_SHARE = 0.75  # its seen points
_FUSED_SHARE = 0.5  # its fused surface, which includes skirts
_HUNG_SHARE = 0.9  # the fused surface of a hanging object, which has no skirts behind it


@dataclass(frozen=True)
class Evidence:
    """Inputs shared by all objects, prepared once per scene."""

    posed: PosedFrames
    depth: DepthMaps  # of `posed`, metres
    surface: Surface
    found: InstanceSet
    pixels: ScenePixels
    stands: Stands
    said: dict[
        int, MaterialChoice
    ]  # materials by object id, where a physicist answered; else the table decides
    fetched: Fetched | None  # meshes by a generator
    config: AssetsConfig
    keep: Path | None = None  # folder of cached collision shapes


@dataclass(frozen=True)
class Shape:
    """An object's closed shape and its provenance."""

    body: Solid  # in the grid frame
    frame: ObjectFrame
    how: str
    attempt: Attempt | None = None  # result of the generator, used or not
    is_box: bool = False  # fallback, as too little was seen

    @property
    def colors(self) -> SurfaceColors | None:
        """Return the generator's colors for unseen surface, in world space."""
        return None if self.attempt is None else self.attempt.colors

    @property
    def provenance(self) -> str:
        """Return how the shape was made, and why a generated one was not used."""
        if self.attempt is None or self.attempt.body is not None:
            return self.how
        return f"{self.how}; {self.attempt.how}"


def build_assets(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, instances: InstanceSet, config: AssetsConfig, *,
    views: SceneViews | None = None, keep: Path | None = None, progress: Progress = NO_PROGRESS,
) -> AssetSet:  # fmt: skip
    """Build a complete asset for every object, the structure, rectangles for floor and walls, and the backdrop.

    An object that cannot be completed becomes a box, with a note and in its provenance; the others go on.

    Args:
        posed: keyframes in world space.
        depth: their depth maps, metres.
        surface: the fused surface with its free space; objects are fused again, finer, from the depth maps.
        instances: the instances and their pixels.
        config: resolution, budgets and limits.
        views: views of the objects for a generator and a vision-language model; None: keyframes.
        keep: folder that caches collision shapes by mesh; None: no cache.
        progress: advanced with every object.

    Returns:
        All assets, in the order of `instances`.
    """
    progress.start(len(instances.objects) + len(instances.base) + 1, "assets")
    scene = replace(gather_evidence(posed, depth, surface, instances, config, progress, views), keep=keep)
    objects, pending = [], deque[tuple[Draft, Future[Collided]]]()
    # Objects take shape beside each other; meanwhile CoACD, a process of its own, decomposes those that have one.
    worker, collider = ThreadPoolExecutor(1), Collider(scene, len(instances.objects))
    try:
        drafts = []
        for draft in ordered_map(partial(draft_object, scene=scene), instances.objects, MOST_AT_ONCE):
            drafts.append(draft)
            pending.append((draft, worker.submit(collider, draft)))
            while pending and pending[0][1].done():
                objects.append(_finished(*pending.popleft(), scene, progress))
        structure = build_structure(posed, depth, surface, instances, scene.pixels, config)
        room = build_room(
            posed, depth, instances, [d.asset for d in drafts], scene.pixels, surface.space, config, structure
        )
        objects += [_finished(*item, scene, progress) for item in pending]
    finally:
        worker.shutdown(cancel_futures=True)
        end_decomposer()
    if any(made.visual is not draft.asset.visual for made, draft in zip(objects, drafts)):  # one became a box
        room = build_room(posed, depth, instances, objects, scene.pixels, surface.space, config, structure)
    progress.advance(len(instances.base))
    base, backdrop = room
    return AssetSet(base, tuple(objects), backdrop, structure)


def gather_evidence(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, found: InstanceSet, config: AssetsConfig,
    progress: Progress, views: SceneViews | None = None,
) -> Evidence:  # fmt: skip
    """Prepare the shared inputs; asks the generator and the physicist, if there are any."""
    pixels = prepare_pixels(posed, depth, found.id_maps)
    pixels = without_strays(pixels, posed, depth.camera, surface, found)
    stands = find_stands(posed, depth, pixels, found)
    fetched = fetch_meshes(found, posed, stands.seen, config, progress, views)
    progress.advance()
    physicist = load_physicist(config)
    said = physicist.choose(found, posed, views=views, progress=progress) if physicist else {}
    return Evidence(posed, depth, surface, found, pixels, stands, said, fetched, config)


class Notes(NoProgress):
    """Notes of one object, kept until all of it is made, so that notes are in the order of objects."""

    def __init__(self) -> None:
        self.kept: list[str] = []

    def note(self, message: str) -> None:
        """See `Progress.note`."""
        self.kept.append(message)

    def failed(self, name: str, error: Exception) -> None:
        """Note that an object became a box."""
        self.note(f"{name}: could not be completed ({type(error).__name__}: {error}), it became a box")


def _name(item: Instance) -> str:
    return f"object {item.id} ({item.label})"


@dataclass(frozen=True)
class Draft:
    """An object with everything but its collision shape."""

    item: Instance
    body: Solid  # in object space
    levels: tuple[float, ...]  # heights of what stands on it, in object space
    asset: ObjectAsset
    notes: Notes

    @property
    def name(self) -> str:
        """Return how notes call the object."""
        return _name(self.item)


Collided = tuple[ConvexPart, ...] | Exception  # a collision shape, or why there is none


class Collider:
    """Makes the collision shapes of drafts, one after another, within the scene's budget of hulls."""

    def __init__(self, scene: Evidence, count: int) -> None:
        self._scene, self._left, self._hulls = scene, count, 0

    def __call__(self, draft: Draft) -> Collided:
        """Return the collision shape of the next draft."""
        scene, self._left = self._scene, self._left - 1
        config = scene.config.with_hulls(scene.config.hulls_scene - self._hulls - self._left * LEAST_HULLS)
        try:
            parts = _collision(draft, scene, config)
        except (MemoryError, EnvironmentMissing):
            raise
        except Exception as error:
            self._hulls += 1  # it becomes a box
            return error
        self._hulls += len(parts)
        return parts


def draft_object(item: Instance, scene: Evidence) -> Draft:
    """Build all of one asset but its collision shape. After a failure, build it as a box."""
    notes, name = Notes(), _name(item)
    try:
        shape = object_shape(item, scene)
        if shape.is_box:
            notes.note(f"{name}: too little was seen of it, it became a box")
        if shape.attempt is not None and shape.attempt.rejected:
            notes.note(f"{name}: {shape.attempt.how}; the embedded completion stands in")
        return _draft(item, shape, scene, notes)
    # Compiled geometry libraries raise anything on a degenerate shape, and one object must not fail the scene. Missing
    # memory or software is no property of the object.
    except (MemoryError, EnvironmentMissing):
        raise
    except Exception as error:
        notes.failed(name, error)
    return _draft(item, box_fallback(item, np.zeros((0, 3))), scene, notes)


def _draft(item: Instance, shape: Shape, scene: Evidence, notes: Notes) -> Draft:
    """Give a solid its texture and mass."""
    body, world_from_object = to_object_space(shape.body, shape.frame)
    levels = [s.level_m - float(world_from_object[2, 3]) for s in scene.stands.on(item.id) if s.known]
    visual, baked = _bake(item, body, world_from_object, shape.colors, scene)
    choice = choice_for(item, scene.said, baked.mean_rgb, body.extents)
    asset = ObjectAsset(
        id=item.id,
        label=item.label,
        label_confidence=float(item.label_confidence),
        world_from_object=world_from_object,
        visual=visual,
        collision=(),
        physics=physical_attributes(body, choice),
        provenance=AssetProvenance(
            geometry=shape.provenance,
            appearance=_appearance(baked, shape),
            physics=choice.reason if item.id in scene.said else f"material table by {choice.reason}",
            observed_fraction=baked.seen_share,
        ),
        views=scene.posed.indices[baked.frames].astype(np.int32),
        support_hint=int(item.support_hint),
        attached_hint=bool(item.attached_hint),
    )
    return Draft(item, body, tuple(levels), asset, notes)


def _collision(draft: Draft, scene: Evidence, config: AssetsConfig) -> tuple[ConvexPart, ...]:
    say = {"levels": draft.levels, "progress": draft.notes, "name": draft.name}
    if scene.keep is None:
        return collision_parts(draft.body, config, **say)
    return kept_parts(scene.keep, draft.body, config, **say)


def _finished(draft: Draft, collided: "Future[Collided]", scene: Evidence, progress: Progress) -> ObjectAsset:
    """Wait for a draft's collision shape, and return the asset; without a shape, build it as a box."""
    parts = collided.result()
    if isinstance(parts, Exception):
        draft.notes.failed(draft.name, parts)
        draft = _draft(draft.item, box_fallback(draft.item, np.zeros((0, 3))), scene, draft.notes)
        parts = _collision(draft, scene, scene.config)
    for note in draft.notes.kept:
        progress.note(note)
    progress.advance()
    return replace(draft.asset, collision=parts)


def _bake(
    item: Instance, body: Solid, world_from_object: np.ndarray, colors: SurfaceColors | None, scene: Evidence
) -> tuple[TexturedMesh, texture.Baked]:
    """Unwrap a solid and bake its texture."""
    mapping, faces, uvs = texture.unwrap(body.vertices, body.faces)
    vertices = body.vertices[mapping]
    away = scene.posed.world_from_camera[:, :3, 3] - world_from_object[:3, 3]
    distance = np.linalg.norm(away, axis=1).min()
    tolerance = float(0.006 + 3 * scene.pixels.noise_relative * distance + 0.01 * body.extents.max())
    world = transform_points(world_from_object, vertices)
    baked = texture.bake_object(
        world,
        faces,
        uvs,
        item.id,
        scene.posed,
        scene.depth.camera,
        scene.pixels,
        scene.config,
        tolerance,
        colors,
    )
    return texture.textured(vertices, faces, uvs, baked.texture), baked


def _appearance(baked: texture.Baked, shape: Shape) -> str:
    seen = "baked from frames" if len(baked.frames) else ("not seen" if shape.colors is None else "none seen")
    return seen if shape.colors is None else f"{seen}, the rest as it was generated"


def to_object_space(body: Solid, frame: ObjectFrame) -> tuple[Solid, np.ndarray]:
    """Shift a solid of the grid frame to object space, origin at its bottom center; return world_from_object too."""
    low, high = body.bounds
    origin = np.array([*(low + high)[:2] / 2, low[2]])
    moved = with_simple_edges(Solid(body.vertices - origin, body.faces))
    return moved, frame.world_from_grid @ rigid(translation=origin)


def object_shape(item: Instance, scene: Evidence) -> Shape:
    """Return an object's closed shape: a slab or front where one fits, else from its fused volume."""
    config, seen = scene.config, scene.stands.seen[item.id]
    camera = scene.depth.camera
    if is_outlined(item, seen.points):
        return Shape(*outlined_slab(item, scene.posed, camera, scene.found, config), "outline+slab")
    if len(seen.points) < config.min_points:
        return box_fallback(item, seen.points)
    frame = frame_object(item, seen, scene.stands.level(item.id), scene.found)
    hanging = hanging_slab(item.id, frame, scene.posed, camera, scene.found, config)
    if hanging is not None:
        return Shape(hanging.body, frame, "observed+slab" + ("+completed" if hanging.completed else ""))
    room = Room(scene.posed, camera, scene.depth.depth, scene.surface, scene.found)
    front = lone_front(item.id, frame, seen, room)
    if front is not None:
        return Shape(front, frame, "observed+front")
    noise = object_noise(scene.posed, scene.depth, scene.pixels, seen, item.id)
    sides = cut_off_sides(item.id, frame, seen, room)
    frame = with_copies(frame, sides)
    volume = fuse_volume(item.id, frame, noise, scene.posed, scene.depth, scene.pixels, config)
    furniture = float(np.ptp(frame.points, axis=0).max()) > config.furniture_m
    if not sides:
        frame = confirmed(frame, volume)
    # A container's rim may be close to its content; a table has no rim.
    grow = max(2.0 * volume.noise_m, volume.voxel_m, 0.012 if furniture else 0.004)
    volume = without_children(volume, frame, scene.stands.on(item.id), min(grow, 0.02))
    volume = within_walls(continued(volume, sides), frame, scene.found)
    attempt = None
    if scene.fetched is not None:
        space = scene.surface.space
        attempt = generated_shape(item.id, scene.fetched, frame, volume, space, config, furniture=furniture)
        if attempt is not None and attempt.body is not None:
            return Shape(attempt.body, frame, attempt.how, attempt)
    body, how = _embedded_shape(item.id, volume, frame, scene, furniture=furniture)
    if body is None:
        return box_fallback(item, seen.points)
    if furniture and frame.wall_y is None:
        fused = fused_points(item.id, frame, scene.surface, scene.found)
        if len(fused) and not _covers(body, fused, _FUSED_SHARE):
            return box_around(frame, fused)
    return Shape(body, frame, how + "+continued" * bool(sides), attempt)


def _embedded_shape(
    item: int, volume: ObjectVolume, frame: ObjectFrame, scene: Evidence, *, furniture: bool
) -> tuple[Solid | None, str]:
    """Return the embedded completion, or a relief where it is smaller than what was seen."""
    body, how = embedded_solid(volume, frame, scene.config, furniture=furniture)
    if furniture and frame.wall_y is None:
        return body, how
    fused = fused_points(item, frame, scene.surface, scene.found)
    if frame.wall_y is not None:
        if len(fused) and not _covers(body, fused, _HUNG_SHARE, outer=1.0):
            return relief(fused, frame.wall_y, scene.config), "observed+relief"
        return body, how
    # Instance borders snap to color edges, which leaves next to nothing of an object of few pixels: then its fused
    # surface counts as what was seen.
    enough = len(fused) == 0 or _covers(body, fused, _FUSED_SHARE)
    points = frame.points if enough else fused
    return (body, how) if _covers(body, points) else (mound(points, scene.config), "observed+relief")


def embedded_solid(
    volume: ObjectVolume, frame: ObjectFrame, config: AssetsConfig, *, furniture: bool
) -> tuple[Solid | None, str]:
    """Return the completion of what was seen (`completion.complete`) and how it was made; None where it is empty."""
    field = completion.complete(volume, frame, config, furniture=furniture)
    body = solid.extract(field, frame.points)
    if field.symmetries and not _covers(body, frame.points):
        field = completion.complete(volume, frame, replace(config, symmetry=False), furniture=furniture)
        body = solid.extract(field, frame.points)
    if body is None or body.volume < 1e-7:
        return None, ""
    if frame.wall_y is None:
        tolerance = max(0.003, 1.5 * volume.noise_m, 0.8 * volume.voxel_m)
        cuboid = fit_cuboid(frame.points, frame.normals, body, tolerance)
        if cuboid is None:
            cuboid = unfreed_cuboid(volume, frame, tolerance)
        if cuboid is not None:
            return cuboid, "observed+box"
    on_bottom = np.abs(body.vertices[:, 2]) < 0.3 * volume.voxel_m
    body = solid.taubin(body, int(np.clip(round(3 + 6 * volume.noise_m / volume.voxel_m), 3, 15)), on_bottom)
    budget = config.faces_furniture if furniture else config.faces_small
    body = solid.lighten(body, budget, 0.3 * volume.voxel_m)
    return body, "observed+" + ("+".join(field.symmetries) or "carved")


def _covers(
    body: Solid | None, points: np.ndarray, share: float = _COVERED_SHARE, outer: float = 3.0
) -> bool:
    """Tell whether a body is about as large as the points: wrong symmetries and thin evidence carve too much."""
    if body is None:
        return False
    seen = np.ptp(np.percentile(points, [outer, 100 - outer], axis=0), axis=0)
    return bool((body.extents > share * seen).all())


def box_around(frame: ObjectFrame, points: np.ndarray) -> Shape:
    """Return the box around fused points (k, 3) of furniture, grid frame.

    Of a shelf at the border of a few frames, id maps may show one post only; the fused surface tells its extent.
    """
    low, high = np.percentile(points, [1, 99], axis=0)
    low[2] = min(low[2], 0.0) if frame.on_support else low[2]
    return Shape(solid.box_solid(low, high), frame, "box-fallback", is_box=True)


def box_fallback(item: Instance, points: np.ndarray) -> Shape:
    """Return a box of the instance's extents, where the instance is."""
    size = np.maximum(np.nan_to_num(item.extents_m, nan=0.02), 0.01)
    c, s = np.cos(item.yaw_rad), np.sin(item.yaw_rad)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    bottom = item.center - np.array([0, 0, size[2] / 2])
    half = size / 2
    box = solid.box_solid(np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], size[2]]))
    local = (points - bottom) @ rotation
    frame = ObjectFrame(rigid(rotation, bottom), local, np.zeros_like(local), False, None)
    return Shape(box, frame, "box-fallback", is_box=True)
