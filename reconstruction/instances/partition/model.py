"""Inference of the learned models: a message-passing network on the region graph, and boosted trees.

The network embeds the features of regions and borders. In each round a region receives the mean and the maximum of the
messages of its neighbors (Battaglia et al., Relational inductive biases, deep learning, and graph networks, 2018). All
layers are symmetric in the two sides of a border.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from reconstruction.instances.partition.boosting import Boosted
from reconstruction.instances.partition.clusters import CLUSTER_FEATURES, PAIR_FEATURES
from reconstruction.instances.partition.crop_scores import CropScorer
from reconstruction.instances.partition.duplicates import DUPLICATE_FEATURES
from reconstruction.instances.partition.features import EDGE_FEATURES, NODE_FEATURES
from reconstruction.instances.partition.graph import Scores
from reconstruction.instances.partition.proposal_features import PROPOSAL_FEATURES
from registry.errors import EnvironmentMissing

WEIGHTS = Path(__file__).parent / "weights" / "partition.safetensors"
FEATURES = (len(NODE_FEATURES), len(EDGE_FEATURES))  # of superpoints and of their borders
TREES = {
    "pairs": len(PAIR_FEATURES) + 2 * len(CLUSTER_FEATURES), "proposals": len(PROPOSAL_FEATURES),
    "duplicates": len(DUPLICATE_FEATURES),
}  # fmt: skip
CLIP = 5.0  # standard deviations at which features are clipped


@dataclass(frozen=True)
class Model:
    """The network: weights by their names in `priors.partition_network.Network`."""

    weights: dict[str, np.ndarray]

    @property
    def rounds(self) -> int:
        """Return the number of message-passing rounds."""
        return len({name.split(".")[1] for name in self.weights if name.startswith("message.")})

    def scores(self, nodes: np.ndarray, edges: np.ndarray, pairs: np.ndarray) -> Scores:
        """Return affinities of borders and label probabilities of regions.

        Args:
            nodes: float32 (n, F) features of regions.
            edges: float32 (e, G) features of borders.
            pairs: int (e, 2) regions on both sides of each border, rows sorted.
        """
        w = self.weights
        h = self._mlp("node_in", standardized(nodes, w["node_mean"], w["node_scale"]))
        g = self._mlp("edge_in", standardized(edges, w["edge_mean"], w["edge_scale"]))
        a, b = pairs[:, 0], pairs[:, 1]
        gather = _Neighbors(pairs, len(nodes))
        for k in range(self.rounds):
            own, sent = h @ w[f"message.{k}.own"].T, h @ w[f"message.{k}.sent"].T
            along = g @ w[f"message.{k}.along"].T + w[f"message.{k}.bias"]
            to_a, to_b = np.maximum(own[a] + sent[b] + along, 0), np.maximum(own[b] + sent[a] + along, 0)
            mean, most = gather(to_a, to_b)
            h = h + self._mlp(f"node_step.{k}", np.concatenate([h, mean, most], axis=1))
            g = g + self._mlp(f"edge_step.{k}", np.concatenate([g, h[a] + h[b], np.abs(h[a] - h[b])], axis=1))
        affinity = self._mlp("edge_out", np.concatenate([g, h[a] + h[b], np.abs(h[a] - h[b])], axis=1))[:, 0]
        label = self._mlp("node_out", h)
        return Scores(affinity.astype(np.float32), _log_softmax(label))

    def _mlp(self, name: str, x: np.ndarray) -> np.ndarray:
        w = self.weights
        hidden = np.maximum(x @ w[f"{name}.0.weight"].T + w[f"{name}.0.bias"], 0)
        return hidden @ w[f"{name}.2.weight"].T + w[f"{name}.2.bias"]


def standardized(values: np.ndarray, mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return (values - mean) * scale, clipped to `CLIP`, as float32."""
    return np.clip((values - mean) * scale, -CLIP, CLIP).astype(np.float32)


class _Neighbors:
    """Mean and maximum of the messages to each node."""

    def __init__(self, pairs: np.ndarray, count: int) -> None:
        to = np.concatenate([pairs[:, 0], pairs[:, 1]])
        self.order = np.argsort(to, kind="stable")
        self.nodes, self.starts, self.sizes = np.unique(to[self.order], return_index=True, return_counts=True)
        self.count = count

    def __call__(self, to_first: np.ndarray, to_second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean = np.zeros((self.count, to_first.shape[1]), np.float32)
        most = mean.copy()
        if len(self.nodes):
            messages = np.concatenate([to_first, to_second])[self.order]
            mean[self.nodes] = np.add.reduceat(messages, self.starts) / self.sizes[:, None]
            most[self.nodes] = np.maximum.reduceat(messages, self.starts)
        return mean, most


@dataclass(frozen=True)
class Ensemble:
    """Networks whose scores are averaged."""

    members: tuple[Model, ...]

    def scores(self, nodes: np.ndarray, edges: np.ndarray, pairs: np.ndarray) -> Scores:
        """Return the mean log-odds, and the renormalized mean log-probabilities; see `Model.scores`."""
        every = [model.scores(nodes, edges, pairs) for model in self.members]
        label = np.mean([s.label for s in every], axis=0)
        return Scores(np.mean([s.affinity for s in every], axis=0), _log_softmax(label))


def _log_softmax(values: np.ndarray) -> np.ndarray:
    values = values - values.max(axis=1, keepdims=True)
    return (values - np.log(np.exp(values).sum(axis=1, keepdims=True))).astype(np.float32)


@dataclass(frozen=True)
class Models:
    """All models of the learned partition."""

    superpoints: Ensemble  # scores of the superpoint graph
    pairs: Boosted  # log-odds that two clusters are pieces of one object
    proposals: Boosted  # logit of the estimated IoU of a proposal and its best object
    crops: CropScorer  # the same logit of the likeliest proposals, from keyframes
    duplicates: Boosted  # logit of the IoU that two proposals of one object count twice


@lru_cache(maxsize=2)
def load_models(weights: Path = WEIGHTS) -> Models:
    """Read the models from a safetensors file.

    Its arrays are `superpoints.<member>.<name>`, `<pairs, proposals or duplicates>.<array>` and `crops.<name>`.

    Raises:
        EnvironmentMissing: the file is missing, or was made for other features.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        stored = load_file(weights)
        members: dict[str, dict[str, np.ndarray]] = {}
        for name, value in _under(stored, "superpoints").items():
            member, own = name.split(".", 1)
            members.setdefault(member, {})[own] = value.astype(np.float32)
        shapes = {(len(w["node_mean"]), len(w["edge_mean"])) for w in members.values()}
        if shapes != {FEATURES}:
            raise KeyError(f"superpoints: made for {shapes or 'no'} features")
        trees = {name: Boosted.named(_under(stored, name)) for name in TREES}
        for name, wanted in TREES.items():
            if int(trees[name].features) != wanted:
                raise KeyError(f"{name}: made for {int(trees[name].features)} features")
        crops = CropScorer(_under(stored, "crops"))
        crops.check()
    except (OSError, KeyError, ValueError, SafetensorError) as error:
        raise EnvironmentMissing(
            f"instances: the weights {weights} cannot be read ({error}). Install the package again."
        ) from error
    superpoints = Ensemble(tuple(Model(members[k]) for k in sorted(members)))
    return Models(superpoints, trees["pairs"], trees["proposals"], crops, trees["duplicates"])


def _under(stored: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name[len(prefix) + 1 :]: value for name, value in stored.items() if name.startswith(f"{prefix}.")}
