"""Train the trees that say what two proposals of one object count twice, on rooms on disk, and measure rooms kept out.

    python -m priors.duplicates DATA --out RUN [--photographs DIR] [--models DIR] [--cache DIR]

Rooms are those of `python -m priors.partition`; all that estimates their proposals ships, and the rooms have to be new
to it. `RUN` gets `partition.safetensors`, with what ships beside the new trees, and `figures.json`.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file, save_file
from scipy.sparse import csr_array

from priors.partition import split_rooms
from priors.partition_clusters import RoomProposals, in_processes, shipped_proposals
from priors.partition_figures import proposal_figures
from priors.partition_rooms import cached, digest_of, room_view, write_arrays
from priors.partition_trees import DUPLICATES, fit_trees, mean_of
from priors.rooms import Sources
from priors.samples import Room
from reconstruction.instances.partition.boosting import Boosted
from reconstruction.instances.partition.crop_scores import cluster_areas, estimated_iou
from reconstruction.instances.partition.duplicates import ProposalPairs, proposal_pairs
from reconstruction.instances.partition.model import WEIGHTS, load_models

_ROUNDS, _SEEDS = 200, 3
_PAIRS = 8000  # of a room, drawn by each seed


@dataclass(frozen=True)
class RoomPairs:
    """One room's proposals with their estimates, pairs of them, and what each pair counts twice."""

    found: RoomProposals
    iou: np.ndarray  # float (m,) estimated, 0 where none was looked at
    pairs: ProposalPairs

    def truth(self) -> np.ndarray:
        """Return the IoU (k,) that each pair counts twice: the smaller one where both are most like the same thing."""
        a, b = self.pairs.first, self.pairs.second
        same = self.found.best_thing[a] == self.found.best_thing[b]
        return np.where(same, np.minimum(self.found.best_iou[a], self.found.best_iou[b]), 0.0)


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    cache, pairs = options.cache or options.out / "cache", {}
    for name, rooms in split_rooms(options.data).items():
        found = shipped_proposals(rooms, cache, Sources.of(options), options.processes)
        pairs[name] = pairs_of(rooms, found, cache, options.processes)
        print(f"{name}: {len(rooms)} rooms, {sum(len(p.pairs.rows) for p in pairs[name])} pairs", flush=True)
    trees = fit(pairs["train"], options.rounds, options.seed)
    export(trees, options.out / "partition.safetensors")
    figures = {}
    for name, rooms in pairs.items():
        figures[f"{name}, alone"] = _figures(rooms, None)
        figures[f"{name}, counted once"] = _figures(rooms, [r.pairs.counted_twice(trees) for r in rooms])
    for name, row in figures.items():
        print(name, json.dumps(row), flush=True)
    (options.out / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    return 0


def _figures(rooms: list[RoomPairs], twice: list[csr_array] | None) -> dict[str, float]:
    return proposal_figures([room.found for room in rooms], [room.iou for room in rooms], twice)


def pairs_of(
    rooms: Sequence[Room], found: Sequence[RoomProposals], cache: Path, processes: int
) -> list[RoomPairs]:
    """Return each room's pairs of proposals, by the estimates of the trees and networks that ship, cached."""
    jobs = [(*job, cache) for job in zip(rooms, found, strict=True)]
    return [_pairs(one, iou) for one, iou in zip(found, in_processes(_estimated, jobs, processes))]


def _pairs(found: RoomProposals, iou: np.ndarray) -> RoomPairs:
    area = cluster_areas(found.example.areas, found.region, found.members)
    return RoomPairs(found, iou, proposal_pairs(found.proposals, iou, area, found.links, found.odds))


def _estimated(job: tuple[Room, RoomProposals, Path]) -> np.ndarray:
    room, found, cache = job
    kind = f"iou-{digest_of(['reconstruction.instances.partition.cut'])}"
    file = cached(room, cache, kind).with_suffix(".npz")
    if not file.is_file():
        models, iou = load_models(), np.zeros(len(found.rows))
        trees = models.proposals(found.rows)
        shown, crops = models.crops(room_view(room, cache), found.region, found.members, trees)
        iou[shown] = estimated_iou(trees[shown], crops)
        write_arrays(file, iou=iou)
    with np.load(file) as stored:
        return stored["iou"]


def fit(rooms: Sequence[RoomPairs], rounds: int, seed: int) -> Boosted:
    """Fit the trees to some pairs of each room; a room counts as the square root of the number of its pairs."""

    def one(seed: int) -> Boosted:
        random = np.random.default_rng(seed)
        drawn = [random.permutation(len(room.pairs.rows))[:_PAIRS] for room in rooms]
        rows = np.concatenate([room.pairs.rows[own] for room, own in zip(rooms, drawn)])
        twice = np.concatenate([room.truth()[own] for room, own in zip(rooms, drawn)])
        weight = np.concatenate([np.full(len(own), len(own) ** -0.5) for own in drawn if len(own)])
        return fit_trees(rows, twice, weight / weight.mean(), DUPLICATES, rounds, seed)

    return mean_of([one(seed + k) for k in range(_SEEDS)])


def export(trees: Boosted, file: Path) -> None:
    """Write the weights that ship with new trees."""
    arrays = {k: v for k, v in load_file(WEIGHTS).items() if not k.startswith("duplicates.")}
    save_file(arrays | {f"duplicates.{name}": value for name, value in trees.arrays().items()}, file)
    load_models.cache_clear()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m priors.duplicates", description=(__doc__ or "").split("\n\n")[0]
    )
    add = parser.add_argument
    add("data", type=Path, help="folder of the dataset")
    add("--out", type=Path, required=True, help="folder for weights and figures")
    add("--cache", type=Path, help="folder for graphs, proposals and estimates (default: OUT/cache)")
    Sources.add_options(parser)
    add("--rounds", type=int, default=_ROUNDS, help="trees of each seed (default: %(default)s)")
    add("--seed", type=int, default=0, help="of the pairs and trees (default: %(default)s)")
    add("--processes", type=int, default=1, help="that make proposals (default: %(default)s)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
