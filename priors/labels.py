"""Fit the trees that name things (`reconstruction.instances.labels`) to rooms on disk; measure them on rooms kept out.

    python -m priors.labels DATA --out RUN [--photographs DIR] [--cache DIR] [--processes 2]

Rows are the true things, as far as the fused surface shows them, and the things that the learned cut finds in the
same rooms: those that are mostly one true thing have its class, pieces that are no thing have none. Every fifth room
of "train" is kept out, and so are all other splits; the probabilities are calibrated on the rooms kept out. `RUN` gets
`labels.safetensors` and `figures.json`. The cache is the one of `python -m priors.partition --proposals-only`.
"""

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import expit

from priors.partition import split_rooms
from priors.partition_clusters import each, shipped_proposals_of
from priors.partition_figures import chosen
from priors.partition_rooms import film_of, fused
from priors.partition_trees import LABELS, fit_classes
from priors.samples import Room
from reconstruction.evaluation.labels import BINS, Guess, label_of, overconfidence, reliability
from reconstruction.instances import InstancesConfig
from reconstruction.instances.contacts import carriers
from reconstruction.instances.cut import Shell, Thing
from reconstruction.instances.describe import place
from reconstruction.instances.labels import CLASSES, LabelModel
from reconstruction.instances.mask_cut import mark_attached
from reconstruction.instances.partition.model import load_models
from reconstruction.progress import NO_PROGRESS

_SAME, _NOTHING = (
    0.5,
    0.25,
)  # IoU of surface from which a found thing is a true one, and up to which it is none
_SHARPNESS = np.arange(0.3, 1.55, 0.05)
_ROUNDS = 120
_TINY = 1e-12


@dataclass(frozen=True)
class Rows:
    """What one room teaches."""

    features: np.ndarray  # float32 (m, F)
    names: tuple[str, ...]  # true words, "" where a found thing is none
    found: np.ndarray  # bool (m,) found by the cut, not true things

    @property
    def classes(self) -> np.ndarray:
        """Return the row in CLASSES, int (m,)."""
        return np.array([CLASSES.index(label_of(name)) for name in self.names], np.int64)


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    cache = options.cache or options.out / "cache"
    rows = {
        name: each(rows_of, [(room, cache, options.photographs) for room in rooms], options.processes)
        for name, rooms in split_rooms(options.data).items()
    }
    for name, rooms in rows.items():
        print(f"{name}: {len(rooms)} rooms, {sum(len(room.names) for room in rooms)} things", flush=True)
    train = rows["train"]
    features, classes = (
        np.concatenate([r.features for r in train]),
        np.concatenate([r.classes for r in train]),
    )
    trees = fit_classes(features, classes, len(CLASSES), LABELS, options.rounds, options.seed)
    chosen_on = [r for name in rows if name != "train" for r in rows[name]] or train
    model = LabelModel(trees, 1.0)
    model = LabelModel(trees, min(_SHARPNESS, key=lambda k: log_loss(LabelModel(trees, k), chosen_on)))
    export(model, options.out / "labels.safetensors")
    figures = {name: figures_of(model, rooms) for name, rooms in rows.items()}
    for name, row in figures.items():
        print(name, json.dumps(row), flush=True)
    (options.out / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m priors.labels", description=__doc__.split("\n\n")[0])
    parser.add_argument("data", type=Path, help="folder of the dataset")
    parser.add_argument("--out", type=Path, required=True, help="folder for weights and figures")
    parser.add_argument("--cache", type=Path, help="folder for surfaces and proposals (default: OUT/cache)")
    parser.add_argument("--photographs", type=Path, help="folder of pictures that the rooms were made with")
    parser.add_argument("--rounds", type=int, default=_ROUNDS, help="trees a class (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the trees (default: %(default)s)")
    parser.add_argument("--processes", type=int, default=1, help="rooms at once (default: %(default)s)")
    return parser


def rows_of(job: tuple[Room, Path, Path | None]) -> Rows:
    """Return what a room teaches."""
    room, cache, photographs = job
    known, models = shipped_proposals_of(job), load_models()
    e, names = known.example, {entity.id: entity.label for entity in film_of(room, photographs).room.entities}
    shell = Shell.of(fused(room, cache), NO_PROGRESS)
    true = np.where(e.true_ids > e.base_entities, e.true_ids, 0)
    own = _things(true)
    got = _things(chosen(known, expit(models.proposals(known.rows)) - models.least_iou))
    features, said, found = [], [], []
    for things, is_found in ((own, False), (got, True)):
        for row, vertices in _placed(shell, things):
            name = _name(vertices, e.true_ids, e.areas, names, int(e.base_entities))
            if name is not None:
                features.append(row)
                said.append(name)
                found.append(is_found)
    return Rows(np.array(features, np.float32), tuple(said), np.array(found, bool))


def _things(number: np.ndarray) -> list[Thing]:
    """Return the sets of vertices with the same number from 1 that are large enough for a thing."""
    vertices = [np.flatnonzero(number == k) for k in np.unique(number[number > 0])]
    return [Thing(v) for v in vertices if len(v) >= InstancesConfig().min_object_vertices]


def _placed(shell: Shell, things: list[Thing]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return features and vertices of each thing, placed as the pipeline does it."""
    for thing, carrier in zip(things, carriers(shell.graph, [t.vertices for t in things])):
        thing.rests_on = things[carrier] if carrier >= 0 else None
    mark_attached(shell, things)
    return [(p.features, p.thing.vertices) for p in place(shell.graph, things, shell.base)]


def _name(
    vertices: np.ndarray, true_ids: np.ndarray, areas: np.ndarray, names: dict[int, str], base_entities: int
) -> str | None:
    """Return the true name of a set of vertices, "" where it is no thing, None where that is not clear."""
    whole = np.bincount(true_ids, areas) + _TINY
    inside = np.bincount(true_ids[vertices], areas[vertices], len(whole))
    iou = inside / (inside.sum() + whole - inside)
    best = base_entities + 1 + int(np.argmax(iou[base_entities + 1 :])) if len(iou) > base_entities + 1 else 0
    if iou[best] >= _SAME:
        return names[best]
    return "" if iou[best] <= _NOTHING else None


def log_loss(model: LabelModel, rooms: list[Rows]) -> float:
    """Return the mean negative log of the probability of the true class, over the things that the cut found."""
    features = np.concatenate([r.features[r.found] for r in rooms])
    classes = np.concatenate([r.classes[r.found] for r in rooms])
    return float(-np.log(model.probabilities(features)[np.arange(len(classes)), classes] + _TINY).mean())


def figures_of(model: LabelModel, rooms: list[Rows]) -> dict:
    """Return how often labels of found things are said and right, and by confidence."""
    guesses = []
    for room in rooms:
        for probability, name in zip(
            model.probabilities(room.features[room.found]), np.array(room.names, object)[room.found]
        ):
            best = int(np.argmax(probability))
            guesses.append(Guess(CLASSES[best], float(probability[best]) if best else 0.0, name))
    said = [g for g in guesses if g.label != CLASSES[0]]
    return {
        "things": len(guesses),
        "said": len(said),
        "right": round(sum(g.right for g in said) / max(len(said), 1), 3),
        "overconfidence": round(overconfidence(guesses), 3),
        "log_loss": round(log_loss(model, rooms), 3),
        "bins": [[b.low, b.count, round(b.confidence, 2), round(b.right, 2)] for b in reliability(guesses)],
    } | {"edges": list(BINS)}


def export(model: LabelModel, file: Path) -> None:
    """Write the weights that `load_labels` reads."""
    from safetensors.numpy import save_file

    arrays = {f"{c}.{k}": v for c, tree in zip(CLASSES, model.trees) for k, v in tree.arrays().items()}
    save_file(arrays | {"sharpness": np.array([model.sharpness], np.float32)}, file)


if __name__ == "__main__":
    sys.exit(main())
