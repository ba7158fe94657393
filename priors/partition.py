"""Train the affinities and unaries of the learned cut on rooms on disk, and measure the cut on rooms kept out.

    python -m priors.partition DATA --out RUN [--photographs DIR] [--cache DIR] [--steps 3000] [--rules]

Graphs with truth are made from `DATA/<split>/<number>` (see `priors.dataset`, `--keep depth`) and cached. Every fifth
room of "train" is kept out, and so are all other splits. `RUN` gets `partition.safetensors` and `figures.json`.
`--photographs` has to be the folder that the rooms were made with.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch.nn import functional

from priors.partition_figures import best_shift, figures_of, rules_figures
from priors.partition_looks import next_look
from priors.partition_network import Network
from priors.partition_rooms import NEEDED, Example, example
from priors.rooms import HELD_OUT
from priors.samples import Room, open_rooms
from reconstruction.instances.partition.features import EDGE_FEATURES, NODE_FEATURES
from reconstruction.instances.partition.model import LABELS, load_models
from registry.errors import UsageError

_KEPT_OUT = 5  # one training room of so many
_CROP_REGIONS = 1000
_COLORS = [k for k, name in enumerate(EDGE_FEATURES) if name.startswith(("color", "edge"))]
_TOGETHER = [
    [k for k, name in enumerate(names) if name.startswith(("together", "pixel"))]
    for names in (NODE_FEATURES, EDGE_FEATURES)
]
_WITHOUT_IMAGES = 0.3  # share of crops without what the image network says
_TOLD_EVERY = 100  # steps
_CRUMB_M2 = 1e-4  # regions below this count less
_LEAST_WEIGHT = 0.05
_ANYWHERE = 0.25  # of the crops have any middle, the others one on a thing


@dataclass(frozen=True)
class Targets:
    """True affinities and labels of a graph, with weights."""

    same: np.ndarray  # float32 (e,) 1 = both sides are of one thing, or both base, or both artifacts
    same_weight: np.ndarray  # float32 (e,)
    label: np.ndarray  # int64 (n,) row in LABELS
    label_weight: np.ndarray  # float32 (n,)

    @classmethod
    def of(cls, room: Example) -> "Targets":
        """Read the truth off a room."""
        ids, pure = room.region_ids()
        base = (ids > 0) & (ids <= room.base_entities)
        area = np.bincount(room.region, weights=room.areas, minlength=len(ids))
        weight = np.clip(area / _CRUMB_M2, _LEAST_WEIGHT, 1.0) * pure
        a, b = room.pairs[:, 0], room.pairs[:, 1]
        ids = np.where(base, 1, ids)
        label = np.where(ids == 0, LABELS.index("artifact"), np.where(base, LABELS.index("base"), 0))
        return cls(
            (ids[a] == ids[b]).astype(np.float32), np.minimum(weight[a], weight[b]).astype(np.float32),
            label.astype(np.int64), weight.astype(np.float32),
        )  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    cache = options.cache or options.out / "cache"
    splits = _split_rooms(options.data)
    examples = {
        name: [example(room, cache, options.photographs) for room in rooms] for name, rooms in splits.items()
    }
    print({name: len(rooms) for name, rooms in splits.items()}, flush=True)
    weights, networks, figures = options.out / "partition.safetensors", [], {}
    for look in range(options.looks):
        networks.append(train(examples["train"], options))
        export(networks, weights)
        if look + 1 == options.looks:
            shift = best_shift(load_models(weights)[look], examples["train"])
            print(f"affinities are shifted by {shift}", flush=True)
            with torch.no_grad():
                networks[look].edge_out[-1].bias += shift
            export(networks, weights)
        model = load_models(weights)[look]
        for name, rooms in examples.items():
            figures[f"{name}, look {look + 1}"] = figures_of(model, rooms)
            print(name, json.dumps(figures[f"{name}, look {look + 1}"]), flush=True)
        if look + 1 < options.looks:
            examples = {
                name: [next_look(room, e, model, cache) for room, e in zip(splits[name], examples[name])]
                for name in splits
            }
    if options.rules:
        for name in [name for name in splits if name != "train"]:
            figures[f"{name}, rules"] = rules_figures(splits[name], examples[name], cache)
            print(name, json.dumps(figures[f"{name}, rules"]), flush=True)
    (options.out / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m priors.partition", description=__doc__.split("\n\n")[0])
    parser.add_argument("data", type=Path, help="folder of the dataset")
    parser.add_argument("--out", type=Path, required=True, help="folder for weights and figures")
    parser.add_argument("--cache", type=Path, help="folder for graphs (default: OUT/cache)")
    parser.add_argument("--photographs", type=Path, help="folder of pictures that the rooms were made with")
    parser.add_argument(
        "--steps", type=int, default=3000, help="of training, a part of a room each (default: %(default)s)"
    )
    parser.add_argument("--width", type=int, default=32, help="of the layers (default: %(default)s)")
    parser.add_argument(
        "--looks", type=int, default=2, help="networks, one after the other (default: %(default)s)"
    )
    parser.add_argument("--rounds", type=int, default=3, help="of messages (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=3e-3, help="learning rate (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of weights and order (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="(default: %(default)s)")
    parser.add_argument(
        "--rules", action="store_true", help="measure the cut by rules on the same surfaces, too"
    )
    return parser


def _split_rooms(data: Path) -> dict[str, list[Room]]:
    """Return rooms by split: those trained on, those of the same families kept out, and other families."""
    rooms = open_rooms(data / "train", NEEDED)
    kept_out = [room for room in rooms if int(room.folder.name) % _KEPT_OUT == _KEPT_OUT - 1]
    out = {"train": [room for room in rooms if room not in kept_out], "kept_out": kept_out}
    out |= {name: open_rooms(data / name, NEEDED) for name in HELD_OUT}
    if not out["train"]:
        raise UsageError(
            f"{data}/train has no rooms with {', '.join(NEEDED)}: see python -m priors.dataset --help"
        )
    return {name: rooms for name, rooms in out.items() if rooms}


def train(examples: list[Example], options: argparse.Namespace) -> Network:
    """Fit a network to graphs with truth, a part of a room a step."""
    network = Network(options.width, options.rounds)
    for name in ("nodes", "edges"):
        values = np.concatenate([getattr(e, name) for e in examples])
        getattr(network, f"{name[:-1]}_mean").copy_(torch.from_numpy(values.mean(axis=0)))
        getattr(network, f"{name[:-1]}_scale").copy_(torch.from_numpy(1.0 / (values.std(axis=0) + 1e-6)))
    optimizer = torch.optim.AdamW(network.parameters(), lr=options.rate, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, options.rate, total_steps=options.steps + 1)
    targets = [Targets.of(e) for e in examples]
    rng, started, total = np.random.default_rng(options.seed), time.perf_counter(), np.zeros(2)
    for step in range(1, options.steps + 1):
        row = int(rng.integers(len(examples)))
        parts = losses(network, *crop(examples[row], targets[row], rng, _CROP_REGIONS))
        optimizer.zero_grad()
        sum(parts).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        total += [float(p.detach()) for p in parts]
        if step % _TOLD_EVERY == 0:
            edges, labels = total / _TOLD_EVERY
            left = (time.perf_counter() - started) / step * (options.steps - step)
            print(f"step {step}: edges {edges:.4f} labels {labels:.4f} ({left:.0f} s left)", flush=True)
            total[:] = 0
    return network.eval()


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


def export(networks: list[Network], file: Path) -> None:
    """Write the weights of all looks as `reconstruction.instances.partition.model.load_models` reads them."""
    load_models.cache_clear()
    looks = enumerate(network.state_dict() for network in networks)
    save_file(
        {f"{k}.{name}": value.detach().contiguous() for k, look in looks for name, value in look.items()},
        file,
    )


if __name__ == "__main__":
    sys.exit(main())
