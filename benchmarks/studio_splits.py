"""How well a split by one click a part separates things that touch: every touching pair of true objects of a capture.

    python -m benchmarks.studio_splits --home HOME --scene default --truth CAPTURE/ground_truth --video FILE

The surface of two true objects within 3 cm of each other is taken for one thing and split by one click each. Two kinds
of clicks are tried: in the middle of what a view from above shows, and at the vertex farthest from the other object.
The score of a split is the lesser IoU of its two parts, over vertices. `geodesic` assigns vertices by paths over the
surface alone, `learned` is what the studio does.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from benchmarks.studio_acts import Played, User
from reconstruction.editing.clicked_split import clicked_parts, grown_parts
from reconstruction.measure.ground_truth import GroundTruth
from registry import SceneRegistry
from studio.correcting.session import Session
from studio.remembered import remember

_TOUCHING_M, _LEAST = 0.03, 20  # vertices of one object within this distance of the other
_VISIBLE = 100  # vertices; objects with fewer are left out
_WELL = 0.75  # score of a split that needs no more points


def main() -> None:
    """Print the scores of all pairs, and their means."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--home", type=Path, required=True, help="folder with registry/ and work/")
    parser.add_argument("--scene", default="default")
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--video", type=Path, required=True)
    asked = parser.parse_args()
    registry = SceneRegistry(asked.home / "registry")
    remember(registry.root, asked.scene, video=asked.video)
    session = Session(registry, registry.load(asked.scene))
    user = User(session, GroundTruth.load(asked.truth), Played(asked.scene))
    surface, footage = user.pointer.surface, user.pointer.footage
    assert footage is not None
    methods = {
        "geodesic": lambda rows, seeds: grown_parts(surface, rows, seeds),
        "learned": lambda rows, seeds: clicked_parts(surface, footage.affinities, rows, seeds),
    }
    name = {entity.id: entity.label for entity in user.truth.evaluated}
    scores: dict[tuple[str, str], list[float]] = {}
    for first, second in touching_pairs(user):
        rows = np.flatnonzero(np.isin(user.true, [first, second]))
        for clicks, seeds in seeds_of(user, first, second).items():
            line = [f"{name[first]:>16} {name[second]:<16} {clicks:8}"]
            for method, split in methods.items():
                score = split_score(split(rows, seeds), user.true[rows] == second)
                scores.setdefault((method, clicks), []).append(score)
                line.append(f"{method} {score:.2f}")
            print("  ".join(line))
    for (method, clicks), values in scores.items():
        well = np.mean(np.array(values) >= _WELL)
        print(
            f"{method}, {clicks}: mean {np.mean(values):.2f}, {well:.0%} at {_WELL} or more, {len(values)} pairs"
        )
    session.close()


def touching_pairs(user: User) -> list[tuple[int, int]]:
    """Return pairs of ids of true objects whose seen surfaces come near each other."""
    points = {e.id: user.points[user.seen(e)] for e in user.truth.evaluated if len(user.seen(e)) > _VISIBLE}
    trees = {number: cKDTree(of) for number, of in points.items()}
    out = []
    for a in points:
        for b in points:
            if a < b:
                away = trees[a].query(points[b], distance_upper_bound=_TOUCHING_M)[0]
                if np.isfinite(away).sum() > _LEAST:
                    out.append((a, b))
    return out


def seeds_of(user: User, first: int, second: int) -> dict[str, list[list[int]]]:
    """Return the clicked vertices of both objects, by the kind of click."""
    middle, far = [], []
    for mine, other in ((first, second), (second, first)):
        rows, others = np.flatnonzero(user.true == mine), np.flatnonzero(user.true == other)
        clicked = user.middle_of(rows).point_world
        assert clicked is not None
        middle.append([int(rows[np.argmin(np.linalg.norm(user.points[rows] - clicked, axis=1))])])
        away = cKDTree(user.points[others]).query(user.points[rows])[0]
        far.append([int(rows[np.argmax(away)])])
    return {"middle": middle, "farthest": far}


def split_score(part: np.ndarray, second: np.ndarray) -> float:
    """Return the lesser IoU of two parts (k,) and the truth: whether a vertex is of the second object, bool (k,)."""
    both = [(part == number, second == (number == 1)) for number in (0, 1)]
    return float(min((a & b).sum() / max((a | b).sum(), 1) for a, b in both))


if __name__ == "__main__":
    main()
