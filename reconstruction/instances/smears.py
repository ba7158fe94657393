"""What shows the wall is the wall, however far in front of it depth put it.

Behind the outline of a thing that stands before a wall, depth fills in what lies between the two: sheets that go
from the thing to the wall, with the wall's picture on them. They hide the thing's shape and make it twice as large. In
the frames they give themselves away: along the line of sight, what they show is the color that the wall has there,
from wherever one looks, while a thing has a color of its own before a changing background.
"""

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.cut import Shell
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.sightings import Sighting
from reconstruction.progress import Progress
from reconstruction.surface.base_planes import FittedPlane, plane_axes
from reconstruction.surface.mesh_graph import MeshGraph, pieces

_LARGEST_M = 0.6  # furniture stands along walls and may have their color
_LARGEST_GROUP_M = 1.2  # what lies on furniture is none, but smears join things there
_REACHES_M = 0.06  # a smear goes on to the wall
_MIN_SEEN, _SURE_SHARE = 2, 0.6
_ALIKE = 6.0
_CELL_M, _NEAR_M = 0.015, 0.25  # of the wall's picture; beyond what is known of it
_ON_WALL_M, _ON_WALL = 0.015, 0.01  # depth this near shows the wall: metres, share of depth
_LEAST_M2 = 5e-4  # of a smear
_SCRAP_SHARE = 0.1  # of the largest piece that is left
_MOST_SHARE = 0.6  # of a thing's area: one of the wall's color cannot be told from the wall
_BUMP_M = 0.08  # so far a bump of a wall stands out


def without_smears(
    shell: Shell,
    things: list[Thing],
    owner: np.ndarray,
    frames: list[Sighting],
    config: InstancesConfig,
    progress: Progress,
) -> list[Thing]:
    """Give the smears between small things and the walls behind them to the walls.

    Args:
        shell: the surface and its base.
        things: what was found; theirs are the vertices.
        owner: int32 (v,) base entity of each vertex; smears are written into it.
        frames: keyframes, the surface drawn into them.
        config: how large a thing is at least.
        progress: told of how many things had smears.

    Returns:
        The same things.
    """
    graph, cleaned = shell.graph, 0
    for row, wall in enumerate(shell.planes):
        near = [thing for thing in things if wall.label == "wall" and _reaches(graph, thing, wall)]
        if not near:
            continue
        picture = WallPicture(graph, wall, frames)
        for thing in near:
            smear = _smear(graph, thing.vertices, wall, picture, frames)
            smear = _with_scraps(graph, thing.vertices, smear)
            left = graph.areas[thing.vertices].sum() - graph.areas[smear].sum()
            enough = left > (1.0 - _MOST_SHARE) * graph.areas[thing.vertices].sum()
            if len(smear) and enough and left > config.min_object_area_m2:
                thing.vertices = np.setdiff1d(thing.vertices, smear, assume_unique=True)
                owner[smear] = shell.entity_id(row)
                cleaned += 1
    if cleaned:
        progress.note(f"{cleaned} things are freed of surface that is smeared to the wall behind them")
    return things


def without_wall_bumps(
    shell: Shell, things: list[Thing], owner: np.ndarray, frames: list[Sighting]
) -> list[Thing]:
    """Give walls what hangs on them, hardly stands out and looks as they do: depth that few frames measured wrong.

    Args:
        shell: the surface and its base.
        things: what was found, pictures excluded: those are told by their looks.
        owner: int32 (v,) base entity of each vertex; bumps are written into it.
        frames: keyframes, the surface drawn into them.

    Returns:
        The things that are left.
    """
    carriers = {id(thing.rests_on) for thing in things}
    alone = [thing for thing in things if thing.attached and id(thing) not in carriers]
    bumps: set[int] = set()
    for row, wall in enumerate(shell.planes):
        flat = [thing for thing in alone if wall.label == "wall" and _hugs(shell.graph, thing, wall)]
        if not flat:
            continue
        picture = WallPicture(shell.graph, wall, frames)
        for thing in flat:
            areas = shell.graph.areas[thing.vertices]
            shows = shows_wall(shell.graph.points[thing.vertices], picture, frames)
            if id(thing) not in bumps and areas[shows].sum() > _SURE_SHARE * areas.sum():
                owner[thing.vertices] = shell.entity_id(row)
                bumps.add(id(thing))
    return [thing for thing in things if id(thing) not in bumps]


def _hugs(graph: MeshGraph, thing: Thing, wall: FittedPlane) -> bool:
    distance = wall.distance(graph.points[thing.vertices])
    return bool(quantiles(distance, graph.areas[thing.vertices], (0.9,))[0] <= _BUMP_M)


def _reaches(graph: MeshGraph, thing: Thing, wall: FittedPlane) -> bool:
    points, areas = graph.points[thing.vertices], graph.areas[thing.vertices]
    largest = _LARGEST_M if thing.rests_on is None else _LARGEST_GROUP_M
    if thing.attached or np.ptp(points, axis=0).max() > largest:
        return False
    return bool(quantiles(wall.distance(points), areas, (0.02,))[0] < _REACHES_M)


class WallPicture:
    """The colors of a wall where frames see it."""

    def __init__(self, graph: MeshGraph, wall: FittedPlane, frames: list[Sighting]) -> None:
        self.wall = wall
        self.axes = np.stack(plane_axes(wall.plane), axis=1)
        flat = graph.points[wall.members] @ self.axes
        low, high = np.percentile(flat, 0.2, axis=0), np.percentile(flat, 99.8, axis=0)
        i, j = np.meshgrid(*(np.arange(a, b, _CELL_M) for a, b in zip(low, high)), indexing="ij")
        cells = np.stack([i.ravel(), j.ravel()], axis=1)
        points = cells @ self.axes.T - wall.plane[3] * wall.plane[:3]
        total, count = np.zeros((len(points), 3)), np.zeros(len(points))
        for frame in frames:
            row, column, z = frame.seen_at(points)
            off = np.abs(frame.measured[row, column] - z)
            seen = (z > 0) & (frame.measured[row, column] > 0) & (off < np.maximum(_ON_WALL * z, _ON_WALL_M))
            total[seen] += frame.lab[row[seen], column[seen]]
            count[seen] += 1
        known = count > 0
        self.lab = total[known] / count[known, None]
        self.tree = cKDTree(cells[known]) if known.any() else None

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the color (n, 3) at points on the wall, nan where nothing is known near."""
        out = np.full((len(points), 3), np.nan)
        if self.tree is not None:
            gap, nearest = self.tree.query(points @ self.axes, distance_upper_bound=_NEAR_M)
            out[np.isfinite(gap)] = self.lab[nearest[np.isfinite(gap)]]
        return out

    def behind(self, points: np.ndarray, frame: Sighting) -> np.ndarray:
        """Return the color (n, 3) of the wall behind points as a frame sees them, nan where it is not behind them."""
        rays = points - frame.eye
        toward = rays @ self.wall.plane[:3]
        there = (toward < 0) & (self.wall.distance(points) > 0)
        reach = -self.wall.distance(frame.eye[None]) / np.where(there, toward, -1.0)
        return np.where(there[:, None], self.at(frame.eye + reach[:, None] * rays), np.nan)


def shows_wall(points: np.ndarray, picture: WallPicture, frames: list[Sighting]) -> np.ndarray:
    """Return which points (n, 3) have, in most frames that see them, the color of the wall behind them."""
    like, seen = np.zeros(len(points)), np.zeros(len(points))
    for frame in frames:
        row, column, z = frame.seen_at(points)
        at = np.flatnonzero(frame.shown(row, column, z))
        gap = np.linalg.norm(frame.lab[row[at], column[at]] - picture.behind(points[at], frame), axis=1)
        like[at] += gap < _ALIKE
        seen[at] += 1
    return (seen >= _MIN_SEEN) & (like >= _SURE_SHARE * seen)


def _smear(
    graph: MeshGraph, body: np.ndarray, wall: FittedPlane, picture: WallPicture, frames: list[Sighting]
) -> np.ndarray:  # fmt: skip
    """Return the vertices of a body that show the wall and go on to it."""
    shows = body[shows_wall(graph.points[body], picture, frames)]
    reaching = [
        piece
        for piece in pieces(graph, shows)
        if graph.areas[piece].sum() > _LEAST_M2 and wall.distance(graph.points[piece]).min() < _REACHES_M
    ]
    return np.sort(np.concatenate(reaching)) if reaching else body[:0]


def _with_scraps(graph: MeshGraph, body: np.ndarray, smear: np.ndarray) -> np.ndarray:
    """Add what hangs on a body by its smear alone."""
    left = pieces(graph, np.setdiff1d(body, smear, assume_unique=True))
    if not len(smear) or len(left) < 2:
        return smear
    near = cKDTree(graph.points[smear])
    least = _SCRAP_SHARE * graph.areas[left[0]].sum()
    small = [piece for piece in left if graph.areas[piece].sum() < least]
    hanging = [piece for piece in small if near.query(graph.points[piece])[0].min() < 2.0 * graph.spacing_m]
    return np.sort(np.concatenate([smear, *hanging]))
