"""Train the network and the boosted trees of the learned cut on rooms on disk, and measure it on rooms kept out.

    python -m priors.partition DATA --out RUN [--photographs DIR] [--models DIR] [--cache DIR] [--proposals-only]

Graphs with truth are made from `DATA/<split>/<number>` (see `priors.dataset`, `--keep depth`) and cached. Every fifth
room of "train" and "models" is kept out, and so are all other splits. The network of superpoints is trained on all
rooms, and on either half of them; the clusters that each half's makes of the other half are what the trees for pairs
of clusters are fitted to, and the proposals that either half's trees make of the other half are what the trees for
proposals are. `RUN` gets `partition.safetensors` and `figures.json`. `--photographs` and `--models` have to be the
folders that the rooms were made with.
"""

import argparse
import hashlib
import json
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from scipy.special import expit
from torch.nn import functional

from priors.partition_clusters import (
    Clusters,
    RoomProposals,
    clusters_of,
    examples_of,
    proposals_of,
    shipped_proposals,
)
from priors.partition_figures import figures_of, proposal_figures
from priors.partition_network import Network
from priors.partition_rooms import NEEDED, Example
from priors.partition_targets import Targets
from priors.partition_trees import PAIRS, PROPOSALS, fit_trees, mean_of
from priors.rooms import HELD_OUT, MODELS_SPLIT, Sources
from priors.samples import Room, open_rooms
from reconstruction.instances.partition.boosting import Boosted
from reconstruction.instances.partition.features import EDGE_FEATURES, NODE_FEATURES
from reconstruction.instances.partition.graph import LABELS
from reconstruction.instances.partition.model import WEIGHTS, Ensemble, Model, load_models
from registry.errors import UsageError

_KEPT_OUT = 5  # one training room of so many
_FINER = -3.0  # log-odds added to borders of superpoints: clusters can still be joined, but not cut
_THINGS = 0.5  # log-odds added to "thing": proposals can still be left out, but not made of base
_ROUNDS = {"pairs": 300, "proposals": 400}
_SEEDS = 5  # of the proposals' trees, whose mean is taken: one seed is worth two or three things either way
_TOGETHER = [
    [k for k, name in enumerate(names) if name.startswith(("together", "pixel"))]
    for names in (NODE_FEATURES, EDGE_FEATURES)
]
_COLORS = [k for k, name in enumerate(EDGE_FEATURES) if name.startswith(("color", "edge"))]
_SCALING = {"node_mean", "node_scale", "edge_mean", "edge_scale"}  # kept as float32 in the file
_WITHOUT_IMAGES = 0.3  # share of crops without what the image network says
_TOLD_EVERY = 100  # steps
_ANYWHERE = 0.25  # of the crops have any middle, the others one on a thing


@dataclass(frozen=True)
class Fit:
    """How one graph's networks are trained."""

    steps: int
    members: int  # networks whose scores are averaged
    width: int
    rounds: int  # of messages
    weight_decay: float
    hidden: float  # share of features that are replaced by their means
    noise: float  # added to features, in standard deviations
    crop: int  # regions
    rate: float = 3e-3


_SUPERPOINTS = Fit(3000, 2, 32, 3, 1e-2, 0.0, 0.0, 1000)


@dataclass(frozen=True)
class Scorers:
    """Models of superpoints and of pairs of clusters, and the proposals of rooms that they were not fitted to."""

    superpoints: Ensemble
    pairs: Boosted
    proposals: dict[str, list[RoomProposals]]  # by split


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    torch.set_num_threads(options.threads)
    options.out.mkdir(parents=True, exist_ok=True)
    cache = options.cache or options.out / "cache"
    splits = split_rooms(options.data)
    print({name: len(rooms) for name, rooms in splits.items()}, flush=True)
    scorers = (_shipped if options.proposals_only else _trained)(splits, cache, options)
    found = scorers.proposals
    print(
        {name: sum(len(room.rows) for room in rooms) for name, rooms in found.items()},
        "proposals",
        flush=True,
    )
    proposals = _fit_proposals(found["train"], options.rounds or _ROUNDS["proposals"], options.seed)
    said = {name: [expit(proposals(room.rows)) for room in rooms] for name, rooms in found.items()}
    trees = {"pairs": scorers.pairs, "proposals": proposals}
    export(scorers.superpoints, trees, options.out / "partition.safetensors")
    figures = {
        f"{name}, superpoints": figures_of(scorers.superpoints, [room.example for room in rooms])
        for name, rooms in found.items()
    }
    for name, rooms in found.items():
        figures[f"{name}, things"] = proposal_figures(rooms, said[name])
    for name, row in figures.items():
        print(name, json.dumps(row), flush=True)
    (options.out / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    return 0


def _trained(splits: dict[str, list[Room]], cache: Path, options: argparse.Namespace) -> Scorers:
    """Fit networks and trees for pairs to the rooms of "train"; each half is scored by those of the other half."""
    examples = {
        name: examples_of(rooms, cache, Sources.of(options), options.processes)
        for name, rooms in splits.items()
    }
    fit = replace(_SUPERPOINTS, steps=options.steps or _SUPERPOINTS.steps)
    members = partial(_members, kept=options.out / "networks", seed=options.seed)
    finished = ensemble_of(members(examples["train"], fit))
    halves = [examples["train"][0::2], examples["train"][1::2] or examples["train"]]
    by_half = [ensemble_of(members(half, replace(fit, members=1))) for half in halves]
    rounds, clusters = options.rounds or _ROUNDS["pairs"], {}
    for name, rooms in splits.items():  # those trained on first
        models = [by_half[1 - k % 2] if name == "train" else finished for k in range(len(rooms))]
        clusters[name] = clusters_of(rooms, examples[name], models, cache, options.processes)
    pairs = _fit_pairs(clusters["train"], rounds, options.seed)
    half = [_fit_pairs(clusters["train"][k::2] or clusters["train"], rounds, options.seed) for k in (0, 1)]
    proposals = {}
    for name, rooms in clusters.items():
        trees = [half[1 - k % 2] if name == "train" else pairs for k in range(len(rooms))]
        proposals[name] = proposals_of(rooms, trees, cache, options.processes)
    return Scorers(finished, pairs, proposals)


def _shipped(splits: dict[str, list[Room]], cache: Path, options: argparse.Namespace) -> Scorers:
    """Read networks and trees for pairs from the weights that ship; the rooms have to be others than theirs."""
    models = load_models()
    proposals = {
        name: shipped_proposals(rooms, cache, Sources.of(options), options.processes)
        for name, rooms in splits.items()
    }
    return Scorers(models.superpoints, models.pairs, proposals)


def _fit_pairs(rooms: list[Clusters], rounds: int, seed: int) -> Boosted:
    rows, same, weight = [], [], []
    for room in rooms:
        true, certain = room.pair_truth()
        known = certain > 0
        rows.append(room.pieces.pair_rows()[known])
        same.append(true[known])
        weight.append(certain[known])
    rows, same, weight = (np.concatenate(values) for values in (rows, same, weight))
    print(f"{len(rows)} pairs of clusters, {same.mean():.0%} of one thing", flush=True)
    return fit_trees(rows, same, weight, PAIRS, rounds, seed)


def _fit_proposals(rooms: list[RoomProposals], rounds: int, seed: int) -> Boosted:
    rows, iou = np.concatenate([r.rows for r in rooms]), np.concatenate([r.best_iou for r in rooms])
    # a room of many pieces has many proposals, and says hardly more than one of few
    weight = np.concatenate([np.full(len(r.rows), len(r.rows) ** -0.5) for r in rooms if len(r.rows)])
    weight /= weight.mean()
    return mean_of([fit_trees(rows, iou, weight, PROPOSALS, rounds, seed + k) for k in range(_SEEDS)])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m priors.partition", description=__doc__.split("\n\n")[0])
    parser.add_argument("data", type=Path, help="folder of the dataset")
    parser.add_argument("--out", type=Path, required=True, help="folder for weights and figures")
    parser.add_argument("--cache", type=Path, help="folder for graphs (default: OUT/cache)")
    Sources.add_options(parser)
    parser.add_argument(
        "--steps",
        type=int,
        help=f"of each network, a part of a room a step (default: {_SUPERPOINTS.steps})",
    )
    parser.add_argument(
        "--rounds",
        type=int,
        help=f"trees (default: {_ROUNDS['pairs']} for pairs, {_ROUNDS['proposals']} for proposals)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of weights and order (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="of training (default: %(default)s)")
    parser.add_argument(
        "--processes",
        type=int,
        default=1,
        help="that make graphs, clusters and proposals (default: %(default)s)",
    )
    parser.add_argument(
        "--proposals-only",
        action="store_true",
        help="fit the proposals' trees alone and keep the rest of the weights that ship; needs rooms new to them",
    )
    return parser


def _members(examples: list[Example], fit: Fit, kept: Path, seed: int) -> list[Network]:
    """Return networks with other seeds, from the folder `kept` where the same ones were trained before."""
    data = hashlib.sha256()
    for values in (array for e in examples for array in (e.nodes, e.edges, e.pairs)):
        data.update(np.ascontiguousarray(values).tobytes())
    kept.mkdir(parents=True, exist_ok=True)
    out = []
    for k in range(fit.members):
        key = hashlib.sha256(f"{data.hexdigest()} {replace(fit, members=1)} {seed + k}".encode()).hexdigest()
        file = kept / f"{key[:16]}.safetensors"
        if file.is_file():
            network = _empty(examples, fit)
            network.load_state_dict(load_file(file))
        else:
            network = train(examples, fit, seed + k)
            save_file(network.state_dict(), file)
        _shift(network)
        out.append(network)
    return out


def _empty(examples: list[Example], fit: Fit) -> Network:
    return Network((examples[0].nodes.shape[1], examples[0].edges.shape[1]), fit.width, fit.rounds).eval()


def _shift(network: Network) -> None:
    with torch.no_grad():
        network.edge_out[-1].bias += _FINER
        network.node_out[-1].bias[LABELS.index("thing")] += _THINGS


def ensemble_of(networks: list[Network]) -> Ensemble:
    """Return trained networks as the ensemble that the stage runs."""
    return Ensemble(tuple(Model({k: v.numpy() for k, v in n.state_dict().items()}) for n in networks))


def split_rooms(data: Path) -> dict[str, list[Room]]:
    """Return rooms by split: those trained on, those of the same families kept out, and other families."""
    rooms = [room for name in ("train", MODELS_SPLIT) for room in open_rooms(data / name, NEEDED)]
    kept_out = [room for room in rooms if int(room.folder.name) % _KEPT_OUT == _KEPT_OUT - 1]
    out = {"train": [room for room in rooms if room not in kept_out], "kept_out": kept_out}
    out |= {name: open_rooms(data / name, NEEDED) for name in HELD_OUT}
    if not out["train"]:
        raise UsageError(
            f"{data}/train has no rooms with {', '.join(NEEDED)}: see python -m priors.dataset --help"
        )
    return {name: rooms for name, rooms in out.items() if rooms}


def train(examples: list[Example], fit: Fit, seed: int) -> Network:
    """Fit a network to graphs with truth, a part of a room a step."""
    torch.manual_seed(seed)
    network = _empty(examples, fit).train()
    for name in ("nodes", "edges"):
        values = np.concatenate([getattr(e, name) for e in examples])
        getattr(network, f"{name[:-1]}_mean").copy_(torch.from_numpy(values.mean(axis=0)))
        getattr(network, f"{name[:-1]}_scale").copy_(torch.from_numpy(1.0 / (values.std(axis=0) + 1e-6)))
    optimizer = torch.optim.AdamW(network.parameters(), lr=fit.rate, weight_decay=fit.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, fit.rate, total_steps=fit.steps + 1)
    targets = [Targets.of(e) for e in examples]
    rng, started, total = np.random.default_rng(seed), time.perf_counter(), np.zeros(2)
    for step in range(1, fit.steps + 1):
        row = int(rng.integers(len(examples)))
        room, truth = crop(examples[row], targets[row], rng, fit.crop)
        parts = losses(network, blurred(room, network, fit, rng), truth)
        optimizer.zero_grad()
        sum(parts).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        total += [float(p.detach()) for p in parts]
        if step % _TOLD_EVERY == 0:
            edges, labels = total / _TOLD_EVERY
            left = (time.perf_counter() - started) / step * (fit.steps - step)
            print(f"step {step}: edges {edges:.4f} labels {labels:.4f} ({left:.0f} s left)", flush=True)
            total[:] = 0
    return network.eval()


def blurred(room: Example, network: Network, fit: Fit, rng: np.random.Generator) -> Example:
    """Return a part of a room with noise on its features, and some of them replaced by their means."""
    if not fit.hidden and not fit.noise:
        return room
    out = {}
    for name in ("nodes", "edges"):
        values = getattr(room, name)
        mean, scale = (getattr(network, f"{name[:-1]}_{part}").numpy() for part in ("mean", "scale"))
        noisy = values + fit.noise / scale * rng.standard_normal(values.shape)
        out[name] = np.where(rng.random(values.shape) < fit.hidden, mean, noisy).astype(np.float32)
    return replace(room, **out)


def crop(room: Example, targets: Targets, rng: np.random.Generator, most: int) -> tuple[Example, Targets]:
    """Return the regions nearest to a random one, which lies on a thing most times, and what joins them."""
    things = np.flatnonzero(targets.label != LABELS.index("base"))
    if len(things) == 0 or rng.random() < _ANYWHERE:
        things = np.arange(len(room.nodes))
    away = np.linalg.norm(room.centers - room.centers[rng.choice(things)], axis=1)
    kept = np.sort(np.argsort(away, kind="stable")[:most])
    number = np.full(len(room.nodes), -1, np.int32)
    number[kept] = np.arange(len(kept), dtype=np.int32)
    inside = (number[room.pairs] >= 0).all(axis=1)
    edges = _other_colors(room.edges[inside], rng)
    nodes = room.nodes[kept]
    if rng.random() < _WITHOUT_IMAGES:
        nodes, edges = nodes.copy(), edges.copy()
        nodes[:, _TOGETHER[0]], edges[:, _TOGETHER[1]] = 0, 0
    part = replace(room, nodes=nodes, edges=edges, pairs=number[room.pairs[inside]])
    return part, Targets(
        targets.same[inside], targets.same_weight[inside], targets.label[kept], targets.label_weight[kept]
    )


def _other_colors(edges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Exchange the features of color among some borders, in half of the cases: textures say nothing of things."""
    out = edges.copy()
    if rng.random() < 0.5:
        some = np.flatnonzero(rng.random(len(edges)) < rng.random())
        out[np.ix_(some, _COLORS)] = edges[np.ix_(rng.permutation(some), _COLORS)]
    return out


def losses(network: Network, room: Example, targets: Targets) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the cross entropies of affinities and of labels."""
    affinity, label = network(
        *(torch.from_numpy(x) for x in (room.nodes, room.edges, room.pairs.astype(np.int64)))
    )
    weight = torch.from_numpy(targets.same_weight)
    each = functional.binary_cross_entropy_with_logits(
        affinity, torch.from_numpy(targets.same), reduction="none"
    )
    edges = (each * weight).sum() / weight.sum().clamp_min(1e-6)
    weight = torch.from_numpy(targets.label_weight)
    each = functional.nll_loss(label, torch.from_numpy(targets.label), reduction="none")
    return edges, (each * weight).sum() / weight.sum().clamp_min(1e-6)


def export(superpoints: Ensemble, trees: dict[str, Boosted], file: Path) -> None:
    """Write the weights as `reconstruction.instances.partition.model.load_models` reads them, layers as float16.

    The networks of crops and the trees of duplicates are those that ship; `priors.crops` and `priors.duplicates` train
    them, in this order.
    """
    load_models.cache_clear()
    arrays = {
        f"superpoints.{k}.{name}": value if name in _SCALING else value.astype(np.float16)
        for k, member in enumerate(superpoints.members)
        for name, value in member.weights.items()
    }
    for kind, boosted in trees.items():
        arrays |= {f"{kind}.{name}": value for name, value in boosted.arrays().items()}
    others = {k: v for k, v in load_file(WEIGHTS).items() if k.startswith(("crops.", "duplicates."))}
    save_file({name: torch.from_numpy(value.copy()) for name, value in arrays.items()} | others, file)


if __name__ == "__main__":
    sys.exit(main())
