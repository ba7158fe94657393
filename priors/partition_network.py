"""The network that scores borders and regions, as PyTorch trains it; `reconstruction` runs the same one with NumPy."""

import torch
from torch import nn

from reconstruction.instances.partition.graph import LABELS
from reconstruction.instances.partition.model import CLIP


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


class Message(nn.Module):
    """The linear maps that make a message of a neighbor, of the receiver and of the border between them."""

    def __init__(self, width: int) -> None:
        """Make the maps; weights are random until loaded."""
        super().__init__()
        self.own, self.sent, self.along = (
            nn.Parameter(torch.randn(width, width) / width**0.5) for _ in range(3)
        )
        self.bias = nn.Parameter(torch.zeros(width))


class Network(nn.Module):
    """See `reconstruction.instances.partition.model.Model`, whose weights have these names."""

    def __init__(self, features: tuple[int, int], width: int, rounds: int) -> None:
        """Make the layers; `features` are the numbers of features of a region and of a border."""
        super().__init__()
        for name, count in zip(("node", "edge"), features):
            self.register_buffer(f"{name}_mean", torch.zeros(count))
            self.register_buffer(f"{name}_scale", torch.ones(count))
        self.node_in = _mlp(features[0], width, width)
        self.edge_in = _mlp(features[1], width, width)
        self.message = nn.ModuleList(Message(width) for _ in range(rounds))
        self.node_step = nn.ModuleList(_mlp(3 * width, width, width) for _ in range(rounds))
        self.edge_step = nn.ModuleList(_mlp(3 * width, width, width) for _ in range(rounds))
        self.edge_out = _mlp(3 * width, width, 1)
        self.node_out = _mlp(width, width, len(LABELS))

    def forward(
        self, nodes: torch.Tensor, edges: torch.Tensor, pairs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return log-odds (e,) of one thing and log-probabilities (n, 3) of the labels."""
        h = self.node_in(((nodes - self.node_mean) * self.node_scale).clamp(-CLIP, CLIP))
        g = self.edge_in(((edges - self.edge_mean) * self.edge_scale).clamp(-CLIP, CLIP))
        a, b = pairs[:, 0], pairs[:, 1]
        to = torch.cat([a, b])
        degree = torch.bincount(to, minlength=len(nodes)).clamp_min(1)[:, None]
        for message, node_step, edge_step in zip(self.message, self.node_step, self.edge_step):
            own, sent, along = h @ message.own.T, h @ message.sent.T, g @ message.along.T + message.bias
            sent_to = torch.relu(torch.cat([own[a] + sent[b] + along, own[b] + sent[a] + along]))
            mean = torch.zeros_like(h).index_add(0, to, sent_to) / degree
            most = torch.zeros_like(h).scatter_reduce(0, to[:, None].expand_as(sent_to), sent_to, "amax")
            h = h + node_step(torch.cat([h, mean, most], dim=1))
            g = g + edge_step(torch.cat([g, h[a] + h[b], (h[a] - h[b]).abs()], dim=1))
        affinity = self.edge_out(torch.cat([g, h[a] + h[b], (h[a] - h[b]).abs()], dim=1))[:, 0]
        return affinity, self.node_out(h).log_softmax(dim=1)
