"""Which thing an address (`addresses`) means: looked up in the cut, the surface and the film's frames."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reconstruction.core.types import BaseEntity, DepthMaps, Instance, InstanceSet, PosedFrames, Surface
from reconstruction.editing.addresses import Address
from reconstruction.instances.id_maps import seen_vertices
from reconstruction.poses.lens import Lens
from registry.errors import UsageError

NEAR_M = 0.3  # how far `near` may be from a thing's box
AT_M = 0.05  # how far `at` may be from a thing's surface
_REACH_PX = 2.0  # how far a click may miss, at depth resolution
_GAP_S = 1.0  # between posed frames further apart than this no camera is interpolated


@dataclass(frozen=True)
class Footage:
    """What clicks are looked up in: the film's frames with cameras, and the surface that they show."""

    posed: PosedFrames  # world space
    depth: DepthMaps  # only its camera is used: the resolution of the id maps
    surface: Surface
    lens: Lens

    def camera_of(self, frame: int) -> tuple[int | None, np.ndarray]:
        """Return the keyframe's row (None where it is none) and world_from_camera of a video frame.

        Raises:
            UsageError: no camera of that frame is known.
        """
        posed = self.posed
        row = np.flatnonzero(np.asarray(posed.indices) == frame)
        if len(row):
            return int(row[0]), np.asarray(posed.world_from_camera[row[0]])
        known = np.concatenate([posed.indices, posed.held_out_indices])
        poses = np.concatenate([posed.world_from_camera, posed.held_out_world_from_camera.reshape(-1, 4, 4)])
        exact = np.flatnonzero(known == frame)
        if len(exact):
            return None, poses[exact[0]]
        order = np.argsort(known, kind="stable")
        after = int(np.searchsorted(known[order], frame))
        if posed.ordered and 0 < after < len(known):
            a, b = order[after - 1], order[after]
            if known[b] - known[a] <= _GAP_S * posed.source.fps:
                return None, _between(poses[a], poses[b], (frame - known[a]) / (known[b] - known[a]))
        nearest = sorted(sorted(known.tolist(), key=lambda k: abs(k - frame))[:6])
        raise UsageError(
            f"overrides: no camera is known of frame {frame} (the film has {posed.source.frame_count}); "
            f"the nearest with one are {', '.join(map(str, nearest))}"
        )

    def depth_pixel(self, address: Address) -> np.ndarray:
        """Return the pixel (2,) that a click means in the straightened frame at depth resolution.

        Raises:
            UsageError: it lies outside the frame.
        """
        width, height = address.size or (self.posed.source.width, self.posed.source.height)
        x, y = address.pixel
        if not (0 <= x <= width and 0 <= y <= height):
            raise UsageError(f"overrides: {address} lies outside the frame of {width} x {height} pixels")
        working = np.array([[x / width * self.lens.width, y / height * self.lens.height]])
        camera = self.depth.camera
        scale = np.array([camera.width / self.lens.width, camera.height / self.lens.height])
        pixel = self.lens.straightened(working)[0] * scale
        if not ((pixel >= 0) & (pixel <= [camera.width, camera.height])).all():
            raise UsageError(f"overrides: {address} lies in the film's margin that straightening cuts off")
        return np.minimum(pixel, [camera.width - 1e-6, camera.height - 1e-6])

    def seen_vertices(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Return int32 (h, w) at depth resolution: the surface vertex that each pixel shows, -1 = none."""
        return seen_vertices(self.surface, self.depth.camera, world_from_camera)[0]


def _between(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation, Slerp

    out = np.eye(4)
    turns = Rotation.from_matrix(np.stack([a[:3, :3], b[:3, :3]]))
    out[:3, :3] = Slerp([0, 1], turns)([share]).as_matrix()[0]
    out[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return out


@dataclass(frozen=True)
class Pointer:
    """Looks addresses up in one state of the cut."""

    found: InstanceSet
    surface: Surface
    footage: Footage | None = None  # needed for clicks

    def thing(self, address: Address) -> Instance:
        """Return the thing that an address means.

        Raises:
            UsageError: there is none; the message says what is there.
        """
        number = self._number(address)
        item = next((o for o in self.found.objects if o.id == number), None)
        if item is None:
            raise UsageError(
                f"overrides: {address} shows {self._name(number)}, not a thing{self._beside(address)}"
            )
        return item

    def entity(self, address: Address) -> Instance | BaseEntity:
        """Return the thing or the part of the room (floor, wall, ceiling) that an address means."""
        if address.kind == "id":
            number = address.id
        else:
            number = self._number(address, base_too=True)
        everything = (*self.found.objects, *self.found.base)
        item = next((o for o in everything if o.id == number), None)
        if item is None:
            raise UsageError(f"overrides: {address} shows {self._name(number)}")
        return item

    def vertex(self, address: Address, item: Instance) -> int:
        """Return the surface vertex of a thing that a point on it means."""
        mine = np.flatnonzero(self.found.vertex_instance == item.id)
        points = np.asarray(self.surface.vertices, np.float64)[mine]
        if address.kind == "at":
            return int(mine[np.argmin(np.linalg.norm(points - address.at, axis=1))])
        pixel, (_, pose) = self._footage().depth_pixel(address), self._footage().camera_of(address.frame)
        seen = self._footage().seen_vertices(pose)
        direct = seen[int(pixel[1]), int(pixel[0])]
        if direct >= 0 and self.found.vertex_instance[direct] == item.id:
            return int(direct)
        shown = np.stack(np.nonzero(np.isin(seen, mine)), axis=1)
        if len(shown):
            row, column = shown[np.argmin(np.hypot(*(shown + 0.5 - pixel[::-1]).T))]
            return int(seen[row, column])
        local = points @ pose[:3, :3] - pose[:3, 3] @ pose[:3, :3]
        camera = self._footage().depth.camera
        z = np.maximum(local[:, 2], 1e-3)
        off = np.hypot(
            camera.fx * local[:, 0] / z + camera.cx - pixel[0],
            camera.fy * local[:, 1] / z + camera.cy - pixel[1],
        )
        return int(mine[np.argmin(np.where(local[:, 2] > 0, off, np.inf))])

    def point(self, address: Address) -> np.ndarray:
        """Return the world point (3,) that an address means: itself, or the surface that a click hits."""
        if address.kind == "at":
            return np.asarray(address.at)
        item = self.entity(address)
        if isinstance(item, Instance):
            return np.asarray(self.surface.vertices[self.vertex(address, item)], np.float64)
        raise UsageError(f"overrides: {address} shows {self._name(item.id)}, not a thing")

    def _number(self, address: Address, base_too: bool = False) -> int:
        if address.kind == "id":
            return self._guarded(address)
        if address.kind == "at":
            return self._at(np.asarray(address.at), base_too)
        ids, pixel = self._ids(address.frame), self._footage().depth_pixel(address)
        hit = int(ids[int(pixel[1]), int(pixel[0])])
        if hit in self._things or (base_too and hit):
            return hit
        rows, columns = np.mgrid[: ids.shape[0], : ids.shape[1]] + 0.5
        disk = np.hypot(columns - pixel[0], rows - pixel[1]) <= _REACH_PX
        near = ids[disk & np.isin(ids, list(self._things))]
        return int(np.bincount(near).argmax()) if len(near) else hit

    def _guarded(self, address: Address) -> int:
        item = next((o for o in self.found.objects if o.id == address.id), None)
        if item is None:
            raise UsageError(
                f"overrides: no object {address.id}; objects are {[o.id for o in self.found.objects]}"
            )
        if address.near is not None:
            # The anchor may lie anywhere on the thing: measured to its box's center, less half its diagonal.
            away = np.linalg.norm(np.asarray(address.near) - item.center)
            if away > NEAR_M + 0.5 * np.linalg.norm(item.extents_m):
                where = ", ".join(f"{x:.2f}" for x in item.center)
                raise UsageError(
                    f"overrides: object {item.id} ({item.label}) is at [{where}], not near {list(address.near)}; "
                    "the file was made for another reconstruction, correct its ids"
                )
        return item.id

    def _at(self, point: np.ndarray, base_too: bool) -> int:
        vertices = np.asarray(self.surface.vertices, np.float64)
        away = np.linalg.norm(vertices - point, axis=1)
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
    def _things(self) -> set[int]:
        return {o.id for o in self.found.objects}

    def _ids(self, frame: int) -> np.ndarray:
        """Return what the frame shows, (h, w) at depth resolution: a keyframe's id map, else the surface drawn."""
        row, pose = self._footage().camera_of(frame)
        if row is not None and len(self.found.id_maps):
            return np.asarray(self.found.id_maps[row])
        seen = self._footage().seen_vertices(pose)
        return np.where(seen >= 0, np.asarray(self.found.vertex_instance)[seen], 0)

    def _footage(self) -> Footage:
        if self.footage is None:
            raise ValueError("clicks need the footage that they were made in")
        return self.footage

    def _name(self, number: int) -> str:
        base = next((b for b in self.found.base if b.id == number), None)
        if base is not None:
            return f"the {base.label} ({base.id})"
        item = next((o for o in self.found.objects if o.id == number), None)
        return f"{item.label} {item.id}" if item else "nothing that was reconstructed"

    def _beside(self, address: Address) -> str:
        """Say what thing is nearest to a place without one."""
        if not self.found.objects:
            return "; nothing was found in this scene"
        if address.kind == "pixel":
            ids, pixel = self._ids(address.frame), self._footage().depth_pixel(address)
            shown = np.stack(np.nonzero(np.isin(ids, list(self._things))), axis=1)
            if not len(shown):
                return "; no thing shows in this frame"
            off = np.hypot(*(shown + 0.5 - pixel[::-1]).T)
            row, column = shown[np.argmin(off)]
            size = address.size or (self.footage.posed.source.width, self.footage.posed.source.height)
            distance = f"{off.min() * size[0] / ids.shape[1]:.0f} pixels"
            number = int(ids[row, column])
        else:
            vertices = np.asarray(self.surface.vertices, np.float64)
            things = np.isin(self.found.vertex_instance, list(self._things))
            away = np.where(things, np.linalg.norm(vertices - np.asarray(address.at), axis=1), np.inf)
            number, distance = int(self.found.vertex_instance[np.argmin(away)]), f"{away.min():.2f} m"
        return f"; the nearest is {self._name(number)}, {distance} away"


def _in_box(item: Instance, point: np.ndarray) -> bool:
    c, s = np.cos(item.yaw_rad), np.sin(item.yaw_rad)
    offset = point - item.center
    local = np.array([c * offset[0] + s * offset[1], -s * offset[0] + c * offset[1], offset[2]])
    return bool((np.abs(local) <= 0.5 * np.asarray(item.extents_m)).all())
