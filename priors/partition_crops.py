"""Rooms' proposals in crops of keyframes, with the trunk's features and true IoUs: the head's training samples."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import starmap
from pathlib import Path

import numpy as np

from priors.partition_clusters import RoomProposals, in_processes
from priors.partition_rooms import cached, digest_of, room_view, write_arrays
from priors.samples import Room
from reconstruction.core.trunk import WEIGHTS, load_trunk
from reconstruction.instances.partition.crop_scores import ALIKE, cluster_areas, color_input
from reconstruction.instances.partition.crops import crops_of
from reconstruction.instances.partition.model import load_models
from reconstruction.instances.partition.proposals import distinct

_LIKELY, _GOOD, _OTHERS = (
    380,
    40,
    60,
)  # proposals of a room: likeliest, of the true ones beside them, of the rest
_TRUE = 0.4  # IoU of true ones
_BATCH = 64


@dataclass(frozen=True)
class RoomCrops:
    """One room's samples, in the order of the proposals."""

    fine: np.ndarray  # float16 (k, FINE, 12, 12) features of the trunk
    coarse: np.ndarray  # float16 (k, COARSE, 6, 6)
    maps: np.ndarray  # int8, see `Crops`
    scalars: np.ndarray  # float32
    proposal: np.ndarray  # int64 (k,)
    iou: np.ndarray  # float32 (k,) true one


def crops_of_rooms(
    rooms: Sequence[Room], found: Sequence[RoomProposals], cache: Path, processes: int
) -> list[RoomCrops]:
    """Return each room's samples, cached.

    Args:
        rooms: arrays on disk.
        found: their proposals, by networks and trees that were not fitted to them.
        cache: folder with the fused surfaces.
        processes: at work at once.
    """
    jobs = [(*job, cache) for job in zip(rooms, found, strict=True)]
    return in_processes(_room_crops, jobs, processes)


def _room_crops(job: tuple[Room, RoomProposals, Path]) -> RoomCrops:
    room, found, cache = job
    digest = digest_of([f"reconstruction.instances.partition.{name}" for name in ("crops", "cut")])
    trunk = hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()[:12]
    file = cached(room, cache, f"crops-{digest}-{trunk}").with_suffix(".npz")
    if not file.is_file():
        made = _made(room, found, cache)
        write_arrays(file, **{f.name: getattr(made, f.name) for f in fields(RoomCrops)})
    with np.load(file) as stored:
        return RoomCrops(**{f.name: stored[f.name] for f in fields(RoomCrops)})


def _made(room: Room, found: RoomProposals, cache: Path) -> RoomCrops:
    import torch

    said = load_models().proposals(found.rows) if len(found.rows) else np.zeros(0)
    rows = _drawn(found, said, np.random.default_rng(int(room.folder.name)))
    crops = crops_of(room_view(room, cache), found.region, found.members, rows)
    trunk = load_trunk()
    fine, coarse = [], []
    with torch.inference_mode():
        for start in range(0, len(crops.proposal), _BATCH):
            a, b = trunk(color_input(crops.color[start : start + _BATCH]))[2:]
            fine.append(a.half().numpy())
            coarse.append(b.half().numpy())
        if not fine:
            fine, coarse = ([x.half().numpy()] for x in trunk(color_input(crops.color))[2:])
    own = crops.proposal
    return RoomCrops(
        np.concatenate(fine), np.concatenate(coarse), crops.maps, crops.scalars, own,
        found.best_iou[own].astype(np.float32),
    )  # fmt: skip


def _drawn(found: RoomProposals, said: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the proposals that are shown, ascending: the likeliest distinct ones, and some of the others."""
    area = cluster_areas(found.example.areas, found.region, found.members)
    standing = distinct(found.members, area, said, _LIKELY, ALIKE)
    likely = np.unique(standing[standing >= 0])
    rest = np.setdiff1d(np.arange(len(said)), likely)
    good = rng.permutation(rest[found.best_iou[rest] > _TRUE])[:_GOOD]
    return np.unique(np.concatenate([likely, good, rng.permutation(rest)[:_OTHERS]])).astype(np.int64)


def joined(rooms: Sequence[RoomCrops]) -> tuple[RoomCrops, np.ndarray]:
    """Return the samples of all rooms, and the weight (k,) of each: a room of many says hardly more than one of few."""
    parts = [r for r in rooms if len(r.proposal)]
    weight = np.concatenate([np.full(len(r.proposal), len(r.proposal) ** -0.5) for r in parts])
    names = [f.name for f in fields(RoomCrops)]
    every = starmap(
        lambda *values: np.concatenate(values), zip(*([getattr(r, n) for n in names] for r in parts))
    )
    return RoomCrops(*every), weight / weight.mean()
