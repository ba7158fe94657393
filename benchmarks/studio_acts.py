"""Acts to a right scene: correct scenes of bench captures through the studio, by a user who is played from the truth.

    python -m benchmarks.studio_acts --home HOME --scene default --truth CAPTURE/ground_truth --video FILE --out FILE

The user sees the things of the scene and the true room. In each round they merge what was cut along a wrong line, click
the parts of wrong merges (split), draw outlines of missed things in two frames, merge pieces, drop others, give the
true size and place to things whose box is wrong, and press Apply; from the second round on they also set wrong
relations. A split whose preview is wrong gets more points, each in the middle of the largest wrong spot of a part.
Everything goes through `studio.correcting` as in the page, but for the browser. Reported: acts, clicks (undone tries
included), the time of the acts (computing, and of a person at 3 s a click), the time of Apply, and figures before and
after.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from reconstruction.core.mesh_graph import MeshGraph, pieces
from reconstruction.editing.overrides import Overrides
from reconstruction.measure.alignment import align
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.matching import box_iou, match_base
from reconstruction.measure.object_scores import score_graph, score_objects
from reconstruction.measure.scene import bundle_poses, placed_meshes
from reconstruction.measure.surfaces import nearest_entities
from registry import SceneRegistry
from registry.errors import SimReconError
from registry.geometry import invert_rigid, rigid, transform_points
from studio.correcting.acts import Act, Outline
from studio.correcting.session import Session
from studio.remembered import remember
from studio.selection import Click

SECONDS_A_CLICK = 3.0  # a person who knows what to click: aim, press, look
_NEAR_M, _SAMPLES = 0.03, 30_000  # as `reconstruction.measure.stages`
_PART = 0.35  # a true object of which this share of the seen surface is in a thing is a part of it
_LEAST = 60  # vertices; fewer are borders
_MOSTLY = 0.6
_RIGHT = 0.75  # of a part that a look at the preview accepts
_GOOD_ENOUGH = 0.6  # of a part: the best of several tries is kept
_MIXED = 0.2  # of a true object, and of a thing: with less in common, a thing is not taken for a piece of it
_TRIES = 5  # of a split, each with more clicks
_BOX_RIGHT = 0.5  # IoU of boxes from which on a size is not corrected
_SAME = 0.1  # IoU of boxes at which a user takes a box without surface for the true thing
_FIGURES = (
    "object_recall_25",
    "object_recall_50",
    "object_precision_25",
    "graph_f1",
    "graph_f1_matched",
    "stable_rate",
    "things",
)


@dataclass
class Played:
    """Acts and clicks of the played user, and the scene's figures before and after."""

    scene: str
    acts: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    clicks: int = 0
    computing_s: float = 0.0
    apply_s: list[float] = field(default_factory=list)
    before: dict = field(default_factory=dict)
    after: list[dict] = field(default_factory=list)

    @property
    def person_s(self) -> float:
        """Time of the acts for a person."""
        return SECONDS_A_CLICK * self.clicks


class User:
    """Knows the true room, and looks at one revision of the scene."""

    def __init__(self, session: Session, truth: GroundTruth, played: Played) -> None:
        self.session, self.truth, self.played = session, truth, played
        self.told: set[tuple[int, int, str]] = set()  # relations that were set already
        self.look()

    def look(self) -> None:
        """Compare the scene with the truth: which true entity each vertex of the surface belongs to."""
        bundle = self.session.bundle
        self.alignment = align(bundle_poses(bundle), self.truth.world_from_camera, self.truth.up)
        pointer = self.session.previewer.pointer()
        assert pointer is not None
        self.pointer = pointer
        self.points = np.asarray(pointer.surface.vertices, np.float64)
        self.graph = MeshGraph.from_surface(pointer.surface)
        self.owner = np.asarray(pointer.found.vertex_instance)
        self.shown = self.owner  # ids that clicks in the page have, until Apply
        self.changed: set[int] = set()  # things whose cut was corrected since the last Apply
        surface = set(np.unique(self.owner).tolist())
        placed = [m.moved(self.alignment.true_from_estimated) for m in placed_meshes(bundle)]
        self.box_of = {m.id: m.bounds for m in placed if not m.base}
        self.without_surface = [m for m in placed if not m.base and m.id not in surface]
        true = nearest_entities(self.alignment.to_true(self.points), self.truth.entities, _SAMPLES, _NEAR_M)
        self.true = np.asarray(true)
        self.things = [item.id for item in bundle.objects]

    def do(
        self, make: Callable[[], Act], clicks: int, good: Callable[[np.ndarray], bool] | None = None
    ) -> bool:
        """Perform an act; False if the page refuses it, or if its preview does not look good (then it is undone).

        Args:
            make: makes the act.
            clicks: presses of the mouse that it takes.
            good: judges the owners (v,) of the surface that the preview shows.
        """
        began = time.perf_counter()
        self.played.clicks += clicks
        try:
            act = make()
            self.session.perform(act)
            after = Overrides([act.entry]).apply_to_instances(self.pointer)
            if good is not None and not good(np.asarray(after.vertex_instance)):
                self.session.document.undo()
                self.played.clicks += 1
                return False
            self.pointer = replace(self.pointer, found=after)
            self.owner = np.asarray(after.vertex_instance)
        except SimReconError as error:
            self.session.document.undo()
            self.played.refused.append(str(error))
            return False
        finally:
            self.played.computing_s += time.perf_counter() - began
        self.played.acts.append(act.title)
        return True

    def seen(self, entity: TrueEntity) -> np.ndarray:
        """Return the vertices int (k,) of a true object."""
        return np.flatnonzero(self.true == entity.id)

    def middle_of(self, rows: np.ndarray) -> Click:
        """Return a click in the middle of the upper fifth of some vertices (k,), which a view from above shows."""
        high = rows[np.argsort(-self.points[rows, 2])[: max(20, len(rows) // 5)]]
        row = high[np.argmin(np.linalg.norm(self.points[high] - self.points[high].mean(axis=0), axis=1))]
        return _click(int(self.shown[row]), self.points[row])

    def split(self, thing: int, entities: list[TrueEntity]) -> None:
        """Split a thing into true objects: by a click each, then by more clicks where the preview is wrong.

        Of tries that are all wrong the best is kept if it is good enough; else outlines go around all but the largest
        part, one frame each.
        """
        mine = self.owner == thing
        rows = [np.flatnonzero(mine & (self.true == entity.id)) for entity in entities]
        parts = [[self.middle_of(part)] for part in rows]
        tried: list[tuple[float, list[list[Click]]]] = []
        after: list[np.ndarray] = []
        clicks = 2 + len(parts)  # Split, a click each, Done
        for _ in range(_TRIES):
            clicked = [list(part) for part in parts]

            def good(owner: np.ndarray, clicked: list[list[Click]] = clicked) -> bool:
                after.append(owner)
                tried.append((self._pure(owner, thing, entities), clicked))
                return tried[-1][0] >= _RIGHT

            before = len(tried)
            if self.do(lambda c=clicked: self.session.acts.split(c), clicks, good):
                return
            if len(tried) == before:
                break  # refused
            added = self._more_clicks(parts, rows, after[-1])
            if not added:
                break
            # Done, and for each point its color and the spot; More points takes the place of the undo.
            clicks = 1 + 2 * added
        purity, best = max(tried, key=lambda one: one[0], default=(0.0, []))
        if purity >= _GOOD_ENOUGH:
            self.do(lambda: self.session.acts.split(best), 1)  # Redo
            return
        for k, entity in enumerate(entities):
            if k != int(np.argmax([len(part) for part in rows])):
                self.add(entity, 1)

    def _more_clicks(self, parts: list[list[Click]], rows: list[np.ndarray], after: np.ndarray) -> int:
        """Add a click to each part with a spot that was given to another one, in its middle; return how many."""
        added = 0
        for part, mine in zip(parts, rows):
            first = part[0].point_world
            assert first is not None
            own = after[int(np.argmin(np.linalg.norm(self.points - first, axis=1)))]
            wrong = mine[after[mine] != own]
            spot = self._largest_spot(wrong) if len(wrong) else wrong
            if len(spot) >= _LEAST // 2:
                part.append(self.middle_of(spot))
                added += 1
        return added

    def _largest_spot(self, rows: np.ndarray) -> np.ndarray:
        """Return the largest of the connected spots of some vertices."""
        return pieces(self.graph, np.sort(rows))[0]

    def add(self, entity: TrueEntity, frames: int) -> None:
        """Outline a true object in one or two frames: it becomes a thing of its own."""
        outlines = self.outline(entity, frames)
        points = sum(len(o.pixels) for o in outlines)
        self.do(lambda: self.session.acts.add(entity.label, outlines), 3 + frames + points)

    def _pure(self, after: np.ndarray, thing: int, entities: list[TrueEntity]) -> float:
        """Return the least share of a true object's vertices in a thing that stay together after a split of it."""
        shares = []
        for entity in entities:
            rows = (self.owner == thing) & (self.true == entity.id)
            counts = np.bincount(after[rows])
            part = np.bincount(after[(self.owner == thing) & (self.true > 0)], minlength=len(counts))
            best = int(np.argmax(counts))
            shares += [counts[best] / rows.sum(), counts[best] / max(part[best], 1)]
        return float(min(shares))

    def outline(self, entity: TrueEntity, count: int) -> list[Outline]:
        """Return outlines around a true object in the frames that show most of it, from different sides."""
        cameras, size = self.session.bundle.cameras, self.session.bundle.cameras
        shown = []
        for index, pose in zip(cameras.indices, cameras.world_from_camera):
            ids = self.truth.instances(int(index))
            if ids is None:
                continue
            mask = (ids == entity.id).astype(np.uint8)
            border = mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()
            shown.append((float(mask.sum()) * (0.3 if border else 1.0), int(index), pose[:3, 2], mask))
        shown.sort(key=lambda item: -item[0])
        chosen: list = []
        for item in shown:
            apart = [np.degrees(np.arccos(np.clip(item[2] @ other[2], -1, 1))) for other in chosen]
            if len(chosen) < count and item[0] > 0 and all(angle > 15 for angle in apart):
                chosen.append(item)
        out = []
        for _, index, _, mask in chosen:
            grown = cv2.dilate(mask, np.ones((5, 5), np.uint8))
            contour = max(
                cv2.findContours(grown, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0], key=cv2.contourArea
            )
            corners = (
                cv2.approxPolyDP(contour, 0.01 * cv2.arcLength(contour, True), True)[:, 0].astype(float) + 0.5
            )
            scale = np.array([size.width / mask.shape[1], size.height / mask.shape[0]])
            out.append(Outline(index, tuple((float(x), float(y)) for x, y in corners * scale)))
        return out

    def correct_cut(self) -> None:
        """Mend the cut: merges, splits, additions, drops."""
        for things, entities in self.mixtures():
            if len(things) > 1:
                self.do(lambda t=things: self.session.acts.merge(t), len(things) + 1)
            owner = max(things, key=lambda t: int((self.owner == t).sum()))
            self.changed |= set(things)
            if len(entities) > 1:
                self.split(owner, entities)
        for entity in self.truth.evaluated:
            if not self.holders(entity):
                self.add(entity, 2)
        known = {e.id for e in self.truth.evaluated}
        for thing in self.things:
            mine = self.true[self.shown == thing]
            if len(mine) and np.isin(mine, list(known)).mean() < 0.2:
                self.do(lambda t=thing: self.session.acts.drop(t), 2)

    def mixtures(self) -> list[tuple[list[int], list[TrueEntity]]]:
        """Return the things and true objects that belong together, but for those that are one and the same."""
        entities = [e for e in self.truth.evaluated if len(self.seen(e))]
        count = len(self.things)
        links = []
        for k, entity in enumerate(entities):
            held = np.bincount(self.owner[self.seen(entity)], minlength=max(self.things) + 1)
            for row, thing in enumerate(self.things):
                shared = int(held[thing])
                whole = int((self.owner == thing).sum())
                most = shared >= _PART * len(self.seen(entity))
                piece = shared >= _MIXED * len(self.seen(entity)) and shared >= _MIXED * whole
                if shared >= _LEAST and (most or piece):
                    links.append((row, count + k))
        ends = np.array(links, int).reshape(-1, 2)
        size = count + len(entities)
        group = connected_components(
            coo_matrix((np.ones(len(ends)), ends.T), shape=(size, size)), directed=False
        )[1]
        out = []
        for number in np.unique(group[:count]):
            things = [self.things[row] for row in np.flatnonzero(group[:count] == number)]
            inside = [entities[k] for k in np.flatnonzero(group[count:] == number)]
            if inside and (len(things) > 1 or len(inside) > 1):
                out.append((things, inside))
        return out

    def holders(self, entity: TrueEntity) -> list[int]:
        """Return the things that a user sees where a true object is."""
        rows = self.seen(entity)
        owners = np.unique(self.owner[rows]) if len(rows) else np.zeros(0, int)
        base = {b.id for b in self.session.bundle.base}
        share = {int(o): int((self.owner[rows] == o).sum()) for o in owners if o > 0 and o not in base}
        found = [o for o, held in share.items() if held >= max(_LEAST, _PART * len(rows))]
        boxes = [m for m in self.without_surface if box_iou(m.bounds, entity.bounds)[0, 0] > _SAME]
        return found + [m.id for m in boxes]

    def correct_sizes(self) -> None:
        """Give the true size and place to things whose cut is right and whose box is not."""
        for entity in self.truth.evaluated:
            for thing in self.holders(entity):
                if thing not in self.box_of or thing in self.changed or not self._mostly(thing, entity.id):
                    continue
                if box_iou(self.box_of[thing], entity.bounds)[0, 0] >= _BOX_RIGHT:
                    continue
                item = next(o for o in self.session.bundle.objects if o.id == thing)
                pose = np.asarray(item.world_from_object, np.float64)
                local = transform_points(invert_rigid(pose), self.to_estimated(entity.mesh.vertices))
                low, high = local.min(axis=0), local.max(axis=0)
                bottom = np.array([*(0.5 * (low + high))[:2], low[2]])
                target = rigid(pose[:3, :3], transform_points(pose, bottom[None])[0])
                self.do(lambda t=thing, s=high - low: self.session.acts.size(t, s), 8)
                self.do(lambda t=thing, p=target: self.session.acts.move(t, p), 4)

    def to_estimated(self, points: np.ndarray) -> np.ndarray:
        """Move points (n, 3) of the true world to that of the scene."""
        return transform_points(
            np.linalg.inv(self.alignment.true_from_estimated), np.asarray(points, np.float64)
        )

    def _mostly(self, thing: int, true_id: int) -> bool:
        mine = self.true[self.owner == thing]
        return len(mine) > 0 and float((mine == true_id).mean()) >= _MOSTLY

    def correct_relations(self, objects: list[dict]) -> None:
        """Set the parents that are not the true ones."""
        base_of = {true: mine for mine, true in self._base().items()}
        thing_of = {o["true_id"]: o["match"] for o in objects if o.get("match") is not None}
        edges = {
            e["child"]: (e["parent"], e["relation"]) for e in self.session.bundle.scene["graph"]["edges"]
        }
        for entity in self.truth.evaluated:
            child, parent = thing_of.get(entity.id), base_of.get(entity.parent, thing_of.get(entity.parent))
            if child is None or parent is None or edges.get(child) == (parent, entity.relation):
                continue
            where: Click | int = parent
            if not self.session.anchors.knows(parent):
                rows = np.flatnonzero(self.owner == parent)
                near = self.points[rows] - self.points[self.owner == child].mean(axis=0)
                where = _click(parent, self.points[rows[np.argmin(np.linalg.norm(near, axis=1))]])
            relation = entity.relation or "supported_by"
            if (child, parent, relation) in self.told:
                continue  # said before, and the simulation showed otherwise
            self.told.add((child, parent, relation))
            self.do(lambda c=child, w=where, r=relation: self.session.acts.parent(c, w, r), 3)

    def _base(self) -> dict[int, int]:
        """Return the true base entity of each estimated one."""
        placed = [m.moved(self.alignment.true_from_estimated) for m in placed_meshes(self.session.bundle)]
        return match_base([m for m in placed if m.base], self.truth.base)


def _click(thing: int, point: np.ndarray) -> Click:
    up = np.array([0.0, 0.0, 1.0])
    return Click(thing, np.asarray(point, np.float64), up, point + up, -up, None, None, 0)


def play(home: Path, scene_id: str, truth_folder: Path, video: Path, rounds: int) -> Played:
    """Correct one scene and measure it."""
    registry = SceneRegistry(home / "registry")
    remember(registry.root, scene_id, video=video)
    session = Session(registry, registry.load(scene_id))
    truth, played = GroundTruth.load(truth_folder), Played(scene_id)
    played.before, objects = _figures(session, truth_folder)
    user = User(session, truth, played)
    for round_ in range(rounds):
        count = len(played.acts)
        if round_ < rounds - 1:
            user.correct_cut()
            user.correct_sizes()
        if round_ > 0:
            user.correct_relations(objects)
        if len(played.acts) == count:
            break
        run = session.apply(require_stable=False)
        state = run.wait(3600)
        played.apply_s.append(round(state.elapsed_s, 1))
        if state.error:
            played.refused.append(f"Apply: {state.error}")
            break
        session.show(registry.load(scene_id))
        figures, objects = _figures(session, truth_folder)
        played.after.append(
            {"round": round_ + 1, "acts": len(played.acts), "clicks": played.clicks, **figures}
        )
        user.look()
    session.close()
    return played


def _figures(session: Session, folder: Path) -> tuple[dict, list[dict]]:
    """Return the figures of objects and relations as `simrecon evaluate` has them, and its records of the objects."""
    bundle, truth = session.bundle, GroundTruth.load(folder)
    alignment = align(bundle_poses(bundle), truth.world_from_camera, truth.up)
    placed = [mesh.moved(alignment.true_from_estimated) for mesh in placed_meshes(bundle)]
    scores = score_objects([m for m in placed if not m.base], truth, 5_000)
    edges = bundle.scene["graph"]["edges"]
    base = [m for m in placed if m.base]
    relations = score_graph(edges, base, truth, scores.true_of, scores.records)
    rest = {"stable_rate": bundle.scene["report"]["physics"].get("stable_rate")}
    found = {**scores.metrics, **relations, **rest, "things": len(bundle.objects)}
    return {name: found.get(name) for name in _FIGURES}, scores.records


def main() -> None:
    """Play, print and write the result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--home", type=Path, required=True, help="folder with registry/ and work/; it is changed"
    )
    parser.add_argument("--scene", default="default")
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--video", type=Path, required=True)
    parser.add_argument(
        "--rounds", type=int, default=3, help="times of Apply at most; the last sets relations only"
    )
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    played = play(asked.home, asked.scene, asked.truth, asked.video, asked.rounds)
    text = json.dumps({**asdict(played), "person_s": played.person_s}, indent=1, default=float)
    asked.out.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
