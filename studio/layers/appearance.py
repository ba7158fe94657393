"""Forms of the surfaces, one at a time: textures, Gaussians, coverage colors, or collision parts."""

import threading
from typing import TYPE_CHECKING, Any

import numpy as np

from registry.simulation import read_obj_points
from studio.coverage import Coverage, measure_coverage
from studio.gaussians import read_gaussians
from studio.layers.base import discard

if TYPE_CHECKING:
    from studio.scene_view import StudioPage

TEXTURES, GAUSSIANS, COVERAGE, COLLISION = "Textures", "Gaussians", "Seen or guessed", "Collision parts"


class Appearance:
    """The surfaces of the scene in one of four forms; forms other than textures are made on demand."""

    modes = (TEXTURES, GAUSSIANS, COVERAGE, COLLISION)

    def __init__(self, page: "StudioPage") -> None:
        self._page = page
        self.mode, self.room = TEXTURES, True
        self._made: dict[str, list[Any]] = {}
        self._made_room: dict[str, list[Any]] = {}
        self._coverage: Coverage | None = None
        self._lock = threading.RLock()

    def set(self, mode: str, room: bool) -> None:
        """Show the surfaces in a form; `room` also shows floor, walls and backdrop."""
        with self._lock:
            self.mode, self.room = mode, room
            if mode != TEXTURES and mode not in self._made:
                make = {GAUSSIANS: self._gaussians, COVERAGE: self._coverages, COLLISION: self._collision}[
                    mode
                ]
                self._made[mode], self._made_room[mode] = make()
            self._show()

    def rebuild(self) -> None:
        """Forget the forms of another revision, and show the present one anew."""
        with self._lock:
            for nodes in (*self._made.values(), *self._made_room.values()):
                discard(self._page, nodes)
            self._made, self._made_room, self._coverage = {}, {}, None
            self.set(self.mode, self.room)

    def shares_of(self, object_id: int) -> np.ndarray | None:
        """Return the shares of an object's surface that are guessed, completed, seen (3,); None: not measured yet."""
        if self._coverage is None or not self._coverage.measured:
            return None
        return self._coverage.surfaces[object_id].shares

    def legend(self) -> str:
        """Return HTML that explains the form."""
        if self.mode == COVERAGE and self._coverage is not None:
            return self._coverage.legend()
        if self.mode == COLLISION:
            parts = sum(len(o.collision) for o in self._page.bundle.objects)
            return (
                f"{parts} convex parts, each in a color of its own: the shapes that touch in the simulation."
            )
        if self.mode == GAUSSIANS:
            entry = self._page.bundle.scene.get("gaussians")
            return (
                f"{entry['count']:,} Gaussians, as fitted to the frames."
                if entry
                else "This scene has no Gaussians."
            )
        return ""

    def _show(self) -> None:
        page = self._page
        textured = self.mode == TEXTURES
        with page.server.atomic():
            for handle in page.object_handles().values():
                handle.visible = textured
            # The room stays textured behind collision parts, which it has as plain boxes.
            for handle in page.room_handles():
                handle.visible = self.room and self.mode in (TEXTURES, COLLISION)
            for made, shown in ((self._made, True), (self._made_room, self.room)):
                for mode, nodes in made.items():
                    for node in nodes:
                        node.visible = shown and mode == self.mode
        page.skip_in_clicks("room", () if self.room else (b.id for b in page.bundle.base))

    def _gaussians(self) -> tuple[list[Any], list[Any]]:
        found = read_gaussians(self._page.bundle)
        if found is None:
            return [], []
        base = np.isin(found.owners, [0, *(b.id for b in self._page.bundle.base)])
        nodes = []
        for name, rows in (("objects", ~base), ("room", base)):
            nodes.append(
                self._page.server.scene.add_gaussian_splats(
                    f"/layers/gaussians/{name}",
                    found.centers[rows],
                    found.covariances[rows],
                    found.colors[rows],
                    found.opacities[rows, None],
                )
            )
        return nodes[:1], nodes[1:]

    def _coverages(self) -> tuple[list[Any], list[Any]]:
        self._coverage = measure_coverage(self._page.bundle, self._page.stage_results)
        objects, room = [], []
        for key, surface in self._coverage.surfaces.items():
            is_object = key in self._page.object_handles()
            name = f"/objects/{key}/coverage" if is_object else f"/layers/coverage/{key}"
            node = self._page.server.scene.add_mesh_trimesh(
                name, surface.colored(), cast_shadow=False, receive_shadow=False
            )
            (objects if is_object else room).append(node)
        return objects, room

    def _collision(self) -> tuple[list[Any], list[Any]]:
        import trimesh

        nodes = []
        for item in self._page.bundle.objects:
            corners = [
                hull_corners(read_obj_points(self._page.bundle.resolve(path))) for path in item.collision
            ]
            if not corners:
                continue
            colors = [
                np.tile([*_part_color(number), 255], (len(part), 1)) for number, part in enumerate(corners)
            ]
            vertices = np.concatenate(corners)
            mesh = trimesh.Trimesh(
                vertices,
                np.arange(len(vertices)).reshape(-1, 3),
                vertex_colors=np.concatenate(colors),
                process=False,
            )
            name = f"/objects/{item.id}/collision"
            nodes.append(
                self._page.server.scene.add_mesh_trimesh(name, mesh, cast_shadow=False, receive_shadow=False)
            )
        return nodes, []


def hull_corners(points: np.ndarray) -> np.ndarray:
    """Return the triangles of a convex hull as separate corners (3 f, 3), counter-clockwise from outside."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    corners = points[hull.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    corners[inward] = corners[inward][:, ::-1]
    return corners.reshape(-1, 3)


def _part_color(number: int) -> tuple[int, int, int]:
    """Return the color of a part: neighbors in number differ by the golden angle in hue."""
    import colorsys

    red, green, blue = colorsys.hls_to_rgb((0.55 + number * 0.381966) % 1.0, 0.62, 0.45)
    return round(255 * red), round(255 * green), round(255 * blue)
