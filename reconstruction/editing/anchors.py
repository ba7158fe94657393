"""Resolution of addresses (`addresses`) to objects, surface vertices and points."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reconstruction.core.types import BaseEntity, Instance, InstanceSet, Surface
from reconstruction.editing.addresses import Address
from reconstruction.editing.film import Film
from reconstruction.instances.id_maps import seen_vertices
from reconstruction.instances.partition.seeded import Affinities
from registry.errors import UsageError
from registry.labels import STRUCTURE

NEAR_M = 0.3  # largest distance of `near` to the object's box
AT_M = 0.05  # largest distance of `at` to the object's surface
_REACH_PX = 2.0  # a click may miss the object by this many pixels at depth resolution


@dataclass(frozen=True)
class Footage(Film):
    """The film in world space with the surface that was reconstructed from it."""

    surface: Surface

    @cached_property
    def affinities(self) -> Affinities:
        """Learned affinities of the surface's superpoints; the first access takes seconds.

        Raises:
            EnvironmentMissing: the weights cannot be read.
        """
        return Affinities.of(self.surface, self.posed, self.depth)

    def seen_vertices(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Return the surface vertex int32 (h, w) at each pixel at depth resolution, -1 = none."""
        return seen_vertices(self.surface, self.depth.camera, world_from_camera)[0]

    def seen_in_keyframe(self, row: int) -> np.ndarray:
        """Return `seen_vertices` of a keyframe by its row; each is rendered once."""
        if row not in self._seen:
            self._seen[row] = self.seen_vertices(np.asarray(self.posed.world_from_camera[row]))
        return self._seen[row]

    @cached_property
    def _seen(self) -> dict[int, np.ndarray]:
        return {}


@dataclass(frozen=True)
class Structure:
    """The structure of a scene, which has no plane and no box."""

    id: int
    label: str = STRUCTURE


@dataclass(frozen=True)
class Pointer:
    """Resolves addresses in one state of the instances."""

    found: InstanceSet
    surface: Surface
    footage: Footage | None = None  # needed for clicks

    def thing(self, address: Address) -> Instance:
        """Return the object that an address means.

        Raises:
            UsageError: there is none; the message has what is there instead, and the nearest object.
        """
        number = self._number(address)
        item = self._things.get(number)
        if item is None:
            shown = self._name(number)
            raise UsageError(f"overrides: {address} shows {shown}, not a thing{self._beside(address)}")
        return item

    def entity(self, address: Address) -> Instance | BaseEntity | Structure:
        """Return the object or base entity that an address means, or the structure.

        Raises:
            UsageError: there is none.
        """
        number = address.id if address.kind == "id" else self._number(address, base_too=True)
        item = self._things.get(number) or self._base.get(number)
        if number and number == self.found.structure:
            return Structure(number)
        if item is None:
            raise UsageError(f"overrides: {address} shows {self._name(number)}")
        return item

    def vertex(self, address: Address, item: Instance) -> int:
        """Return the surface vertex of an object that is nearest to a point or a click on it."""
        mine = np.flatnonzero(self.found.vertex_instance == item.id)
        points = np.asarray(self.surface.vertices, np.float64)[mine]
        if address.kind == "at":
            return int(mine[np.argmin(np.linalg.norm(points - np.asarray(address.at), axis=1))])
        pixel, (_, pose) = self._film.depth_pixel(address), self._film.camera_of(address.frame)
        seen = self._film.seen_vertices(pose)
        direct = seen[int(pixel[1]), int(pixel[0])]
        if direct >= 0 and self.found.vertex_instance[direct] == item.id:
            return int(direct)
        shown = _nearest_pixel(np.isin(seen, mine), pixel)
        if shown is not None:
            return int(seen[shown[0], shown[1]])
        local = points @ pose[:3, :3] - pose[:3, 3] @ pose[:3, :3]
        z = np.maximum(local[:, 2], 1e-3)
        u, v = self._film.depth.camera.project(np.column_stack([local[:, :2], z]))
        away = np.hypot(u - pixel[0], v - pixel[1])
        return int(mine[np.argmin(np.where(local[:, 2] > 0, away, np.inf))])

    def point(self, address: Address) -> np.ndarray:
        """Return the world point (3,) of an address: itself, or the surface vertex at a click or of an id."""
        if address.kind == "at":
            return np.asarray(address.at)
        item = self.entity(address)
        if isinstance(item, Instance):
            return np.asarray(self.surface.vertices[self.vertex(address, item)], np.float64)
        raise UsageError(f"overrides: {address} shows {self._name(item.id)}, not a thing")

    def _number(self, address: Address, base_too: bool = False) -> int:
        """Return the id at an address, 0 = nothing."""
        if address.kind == "id":
            return self._guarded(address)
        if address.kind == "at":
            return self._at(np.asarray(address.at), base_too)
        bare = self._bare(address)
        if bare:
            return bare
        ids, pixel = self._ids(address.frame), self._film.depth_pixel(address)
        hit = int(ids[int(pixel[1]), int(pixel[0])])
        if hit in self._things or (base_too and hit):
            return hit
        rows, columns = np.mgrid[: ids.shape[0], : ids.shape[1]] + 0.5
        disk = np.hypot(columns - pixel[0], rows - pixel[1]) <= _REACH_PX
        near = ids[disk & np.isin(ids, list(self._things))]
        return int(np.bincount(near).argmax()) if len(near) else hit

    def _bare(self, address: Address) -> int:
        """Return the id of the nearest box without surface and pixels (`add` of a glass) at a click, 0 without any.

        It counts before the surface behind it, which shows through.
        """
        drawn = {*np.unique(self.found.vertex_instance).tolist(), *np.unique(self.found.id_maps).tolist()}
        bare = [item for item in self.found.objects if item.id not in drawn]
        if not bare:
            return 0
        pixel, pose = self._film.depth_pixel(address), self._film.camera_of(address.frame)[1]
        ray = pose[:3, :3] @ self._film.depth.camera.unproject(pixel[0], pixel[1], 1.0)
        vertex = self._film.seen_vertices(pose)[int(pixel[1]), int(pixel[0])]
        wall = np.inf if vertex < 0 else float((self.surface.vertices[vertex] - pose[:3, 3]) @ pose[:3, 2])
        entered = {item.id: _entry(item, pose[:3, 3], ray) for item in bare}
        number = min(entered, key=entered.__getitem__)
        return number if entered[number] < wall else 0

    def _guarded(self, address: Address) -> int:
        """Return the id of an address after a check of its guard `near`."""
        item = self._things.get(address.id)
        if item is None:
            raise UsageError(f"overrides: no object {address.id}; objects are {[*self._things]}")
        if address.near is not None:
            # `near` may be anywhere on the object: distance to the center, less half the diagonal of the box.
            away = np.linalg.norm(np.asarray(address.near) - item.center)
            if away > NEAR_M + 0.5 * np.linalg.norm(item.extents_m):
                where = ", ".join(f"{x:.2f}" for x in item.center)
                raise UsageError(
                    f"overrides: object {item.id} ({item.label}) is at [{where}], not near {list(address.near)}; "
                    "the file was made for another reconstruction, correct its ids"
                )
        return item.id

    def _at(self, point: np.ndarray, base_too: bool) -> int:
        """Return the id at a world point: of the nearest surface, else of the smallest box that contains it."""
        away = np.linalg.norm(np.asarray(self.surface.vertices, np.float64) - point, axis=1)
        nearest = int(np.argmin(away)) if len(away) else -1
        owner = np.asarray(self.found.vertex_instance)
        if base_too and nearest >= 0 and owner[nearest] and away[nearest] < AT_M:
            return int(owner[nearest])
        things = np.isin(owner, list(self._things))
        if things.any():
            closest = int(np.argmin(np.where(things, away, np.inf)))
            if away[closest] <= AT_M:
                return int(owner[closest])
        inside = [o for o in self.found.objects if _in_box(o, point)]
        if inside:
            return min(inside, key=lambda o: float(np.prod(o.extents_m))).id
        return int(owner[nearest]) if nearest >= 0 and away[nearest] <= AT_M else 0

    @cached_property
    def _things(self) -> dict[int, Instance]:
        return {o.id: o for o in self.found.objects}

    @cached_property
    def _base(self) -> dict[int, BaseEntity]:
        return {b.id: b for b in self.found.base}

    def _ids(self, frame: int) -> np.ndarray:
        """Return the ids (h, w) of a video frame: the id map of a keyframe, else the rendered surface."""
        row, pose = self._film.camera_of(frame)
        if row is not None and len(self.found.id_maps):
            return np.asarray(self.found.id_maps[row])
        seen = self._film.seen_vertices(pose)
        return np.where(seen >= 0, np.asarray(self.found.vertex_instance)[seen], 0)

    @property
    def _film(self) -> Footage:
        if self.footage is None:
            raise ValueError("clicks need the footage that they were made in")
        return self.footage

    def _name(self, number: int) -> str:
        if number in self._base:
            return f"the {self._base[number].label} ({number})"
        if number and number == self.found.structure:
            return f"the structure ({number})"
        item = self._things.get(number)
        return f"{item.label} {item.id}" if item else "nothing that was reconstructed"

    def _beside(self, address: Address) -> str:
        """Return the end of an error message: the object that is nearest to an address without one."""
        if not self._things:
            return "; nothing was found in this scene"
        if address.kind == "pixel":
            ids = self._ids(address.frame)
            shown = _nearest_pixel(np.isin(ids, list(self._things)), self._film.depth_pixel(address))
            if shown is None:
                return "; no thing shows in this frame"
            row, column, away = shown
            size = address.size or (self._film.posed.source.width, self._film.posed.source.height)
            number, distance = int(ids[row, column]), f"{away * size[0] / ids.shape[1]:.0f} pixels"
        else:
            vertices = np.asarray(self.surface.vertices, np.float64)
            things = np.isin(self.found.vertex_instance, list(self._things))
            off = np.where(things, np.linalg.norm(vertices - np.asarray(address.at), axis=1), np.inf)
            number, distance = int(self.found.vertex_instance[np.argmin(off)]), f"{off.min():.2f} m"
        return f"; the nearest is {self._name(number)}, {distance} away"


def _nearest_pixel(mask: np.ndarray, pixel: np.ndarray) -> tuple[int, int, float] | None:
    """Return row, column and distance of the set pixel of a mask (h, w) nearest to a pixel x, y; None without any."""
    shown = np.stack(np.nonzero(mask), axis=1)
    if not len(shown):
        return None
    away = np.hypot(*(shown + 0.5 - pixel[::-1]).T)
    row, column = shown[np.argmin(away)]
    return int(row), int(column), float(away.min())


def _in_box(item: Instance, point: np.ndarray) -> bool:
    return bool((np.abs(box_axes(item) @ (point - item.center)) <= 0.5 * np.asarray(item.extents_m)).all())


def box_axes(item: Instance) -> np.ndarray:
    """Return the rotation (3, 3) from the world to the axes of an object's box."""
    c, s = np.cos(item.yaw_rad), np.sin(item.yaw_rad)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0, 0, 1.0]])


def _entry(item: Instance, eye: np.ndarray, ray: np.ndarray) -> float:
    """Return how far along a ray (3,), in lengths of it, it enters an object's box; infinity if it misses."""
    start, along = box_axes(item) @ (eye - item.center), box_axes(item) @ ray
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    half = 0.5 * np.asarray(item.extents_m)
    ends = np.sort(np.stack([(-half - start) / along, (half - start) / along]), axis=0)
    near, far = float(ends[0].max()), float(ends[1].min())
    return near if 0 < near <= far else np.inf
