"""Train the networks that score proposals as keyframes show them, on rooms on disk, and measure them on rooms kept out.

    python -m priors.crops DATA --out RUN [--photographs DIR] [--models DIR] [--cache DIR]

Rooms are those of `python -m priors.partition`; networks and trees that make their proposals are those that ship, and
the rooms have to be others than theirs. `RUN` gets `partition.safetensors`, with what ships beside the new heads, and
`figures.json`.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch.nn import functional

from priors.partition import split_rooms
from priors.partition_clusters import RoomProposals, shipped_proposals
from priors.partition_crops import RoomCrops, crops_of_rooms, joined
from priors.partition_figures import proposal_figures
from priors.rooms import Sources
from reconstruction.instances.partition.crop_network import Head
from reconstruction.instances.partition.crop_scores import (
    estimated_iou,
    head_inputs,
    mean_by_proposal,
    mean_logit,
    mirrored,
)
from reconstruction.instances.partition.model import WEIGHTS, load_models

_EPOCHS = 6
_HEADS = 2  # whose logits are averaged
_BATCH = 128
_RATE, _DECAY = 2e-3, 1e-2
_SHARE = 0.35  # of the crops are drawn an epoch
_BORING, _SELDOM = 0.1, 0.25  # crops of a lower IoU are drawn this less often


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    cache = options.cache or options.out / "cache"
    splits, found, crops = split_rooms(options.data), {}, {}
    for name, rooms in splits.items():
        found[name] = shipped_proposals(rooms, cache, Sources.of(options), options.processes)
        crops[name] = crops_of_rooms(rooms, found[name], cache, options.processes)
        print(f"{name}: {len(rooms)} rooms, {sum(len(c.proposal) for c in crops[name])} crops", flush=True)
    torch.set_num_threads(options.threads)  # making crops may have left it at one
    heads = [train(crops["train"], options.epochs, options.seed + k) for k in range(options.heads)]
    said = {name: [_said(heads, *pair) for pair in zip(crops[name], found[name])] for name in found}
    export(heads, options.out / "partition.safetensors")
    figures = {f"{name}, things": proposal_figures(found[name], said[name]) for name in found}
    for name, row in figures.items():
        print(name, json.dumps(row), flush=True)
    (options.out / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    return 0


def train(rooms: list[RoomCrops], epochs: int, seed: int) -> Head:
    """Fit a head to the true IoUs of crops."""
    torch.manual_seed(seed)
    rng, head = np.random.default_rng(seed), Head().train()
    samples, weight = joined(rooms)
    often = weight * np.where(samples.iou > _BORING, 1.0, _SELDOM)
    often /= often.sum()
    steps = max(int(_SHARE * len(weight)) // _BATCH, 1)
    optimizer = torch.optim.AdamW(head.parameters(), _RATE, weight_decay=_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, _RATE, total_steps=steps * epochs + 1, pct_start=0.1
    )
    for epoch in range(1, epochs + 1):
        total, started = 0.0, time.perf_counter()
        drawn = rng.choice(len(weight), (steps, _BATCH), p=often)
        for rows in np.sort(drawn, axis=1):
            inputs = _inputs(samples, rows)
            logit = head(*(mirrored(*inputs) if rng.random() < 0.5 else inputs))
            loss = functional.binary_cross_entropy_with_logits(logit, torch.from_numpy(samples.iou[rows]))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += float(loss.detach())
        took = time.perf_counter() - started
        print(f"epoch {epoch} of {epochs}: loss {total / steps:.4f} ({took:.0f} s)", flush=True)
    return head.eval()


def _inputs(samples: RoomCrops, rows: np.ndarray | slice) -> tuple[torch.Tensor, ...]:
    fine, coarse = (torch.from_numpy(x[rows]).float() for x in (samples.fine, samples.coarse))
    return fine, coarse, *head_inputs(samples.maps[rows], samples.scalars[rows])


@torch.inference_mode()
def _said(heads: list[Head], crops: RoomCrops, found: RoomProposals) -> np.ndarray:
    """Return the IoU (m,) that trees and heads estimate of a room's proposals, 0 where none was looked at."""
    starts = range(0, len(crops.proposal), _BATCH)
    logit = [mean_logit(heads, _inputs(crops, slice(start, start + _BATCH))) for start in starts]
    out = np.zeros(len(found.rows))
    if logit:
        rows, said = mean_by_proposal(crops.proposal, np.concatenate(logit).astype(np.float64))
        out[rows] = estimated_iou(load_models().proposals(found.rows[rows]), said)
    return out


def export(heads: list[Head], file: Path) -> None:
    """Write the weights that ship with new heads; filters are float16."""
    arrays = {k: v for k, v in load_file(WEIGHTS).items() if not k.startswith("crops.")}
    parts = {}
    for number, head in enumerate(heads):
        parts |= {f"crops.heads.{number}.{name}": value for name, value in head.state_dict().items()}
    arrays |= {k: (v.half() if v.ndim > 1 else v).contiguous() for k, v in parts.items()}
    save_file(arrays, file)
    load_models.cache_clear()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m priors.crops", description=(__doc__ or "").split("\n\n")[0]
    )
    add = parser.add_argument
    add("data", type=Path, help="folder of the dataset")
    add("--out", type=Path, required=True, help="folder for weights and figures")
    add("--cache", type=Path, help="folder for graphs, proposals and crops (default: OUT/cache)")
    Sources.add_options(parser)
    add("--epochs", type=int, default=_EPOCHS, help="of each head (default: %(default)s)")
    add("--heads", type=int, default=_HEADS, help="whose logits are averaged (default: %(default)s)")
    add("--seed", type=int, default=0, help="of weights and order (default: %(default)s)")
    add("--threads", type=int, default=1, help="of training (default: %(default)s)")
    add("--processes", type=int, default=1, help="that make proposals and crops (default: %(default)s)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
