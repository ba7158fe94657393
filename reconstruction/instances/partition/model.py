"""The network that scores borders and regions, run with NumPy: features in, log-odds and log-probabilities out.

Features of regions and borders are embedded; in each round every region receives the mean and the maximum of messages
from its neighbors (Battaglia et al., Relational inductive biases, deep learning, and graph networks, 2018). All layers
are symmetric in the two sides of a border.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from reconstruction.instances.partition.features import EDGE_FEATURES, NODE_FEATURES
from registry.errors import EnvironmentMissing

WEIGHTS = Path(__file__).parent / "weights" / "partition.safetensors"
LABELS = ("thing", "base", "artifact")
CLIP = 5.0  # standard deviations beyond which features are cut off


@dataclass(frozen=True)
class Scores:
    """Scores of a graph by the network."""

    affinity: np.ndarray  # float32 (e,) log-odds that both sides are one thing
    label: np.ndarray  # float32 (n, 3) log-probabilities of LABELS


@dataclass(frozen=True)
class Model:
    """Weights by name, as `priors.partition_network.Network` names them."""

    weights: dict[str, np.ndarray]

    @property
    def rounds(self) -> int:
        """Return how often neighbors exchange messages."""
        return len({name.split(".")[1] for name in self.weights if name.startswith("message.")})

    def scores(self, nodes: np.ndarray, edges: np.ndarray, pairs: np.ndarray) -> Scores:
        """Score a graph.

        Args:
            nodes: float32 (n, len(NODE_FEATURES)) features of regions.
            edges: float32 (e, len(EDGE_FEATURES)) features of their borders.
            pairs: int (e, 2) regions on both sides, rows sorted.
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
        label = label - label.max(axis=1, keepdims=True)
        label -= np.log(np.exp(label).sum(axis=1, keepdims=True))
        return Scores(affinity.astype(np.float32), label.astype(np.float32))

    def _mlp(self, name: str, x: np.ndarray) -> np.ndarray:
        w = self.weights
        hidden = np.maximum(x @ w[f"{name}.0.weight"].T + w[f"{name}.0.bias"], 0)
        return hidden @ w[f"{name}.2.weight"].T + w[f"{name}.2.bias"]


def standardized(values: np.ndarray, mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return features less their mean over their scale, clipped."""
    return np.clip((values - mean) * scale, -CLIP, CLIP).astype(np.float32)


class _Neighbors:
    """Mean and maximum of messages to each node."""

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


@lru_cache(maxsize=2)
def load_models(weights: Path = WEIGHTS) -> tuple[Model, ...]:
    """Read the weights of all looks, named `<look>.<name>`.

    Raises:
        EnvironmentMissing: the file is not there or is not what this version reads.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        found = load_file(weights)
        looks: dict[int, dict[str, np.ndarray]] = {}
        for name, value in found.items():
            look, _, own = name.partition(".")
            looks.setdefault(int(look), {})[own] = value.astype(np.float32)
        for look in looks.values():
            shapes = look["node_mean"].shape, look["edge_mean"].shape
            if shapes != ((len(NODE_FEATURES),), (len(EDGE_FEATURES),)):
                raise KeyError(f"made for {shapes} features")
    except (OSError, KeyError, ValueError, SafetensorError) as error:
        raise EnvironmentMissing(
            f"instances: the weights {weights} cannot be read ({error}). Install the package again, or use "
            "--set instances.cut=rules."
        ) from error
    return tuple(Model(looks[k]) for k in sorted(looks))
