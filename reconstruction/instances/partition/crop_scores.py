"""Estimated IoU of proposals by networks that see them in keyframes: crops of the likeliest -> logits."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix
from scipy.special import expit

from reconstruction.instances.partition.crops import MAPS, Crops, crops_of
from reconstruction.instances.partition.features import View
from reconstruction.instances.partition.proposals import distinct
from reconstruction.poses.parallel import ordered_map
from registry.errors import EnvironmentMissing

MOST = 1000  # proposals that are looked at, those the trees score highest; the others are never objects
ALIKE = 0.9  # IoU of two proposals above which the likelier one is looked at for both
_BATCH = 16  # crops; each batch is of one thread, so that results do not depend on the number of threads
_CLIP_LOGIT = 7.0  # of the trees
_TINY = 1e-9


@dataclass(frozen=True)
class CropScorer:
    """Heads whose logits are averaged.

    Weights have the names of `crop_network.Head`: `heads.<member>.<name>`.
    """

    weights: dict[str, np.ndarray]

    def check(self) -> None:
        """Look whether there are weights of heads, and no others.

        Raises:
            KeyError: there are none.
        """
        kinds = {name.split(".")[0] for name in self.weights}
        if kinds != {"heads"}:
            raise KeyError(f"crops: weights of {', '.join(sorted(kinds)) or 'nothing'}")

    def __call__(
        self, view: View, region: np.ndarray, members: csr_matrix, logit: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows (r,) of the likely proposals, and their logits float64 (r,).

        Of proposals that are almost the same the likeliest is looked at, and its logit is that of the others.

        Args:
            view: the surface and its keyframes.
            region: int (v,) cluster of each vertex; numbers from n on are no clusters of things.
            members: (m, n) 1 = the cluster is in the proposal.
            logit: float (m,) of each proposal, as the trees estimate it.
        """
        area = cluster_areas(view.mesh.areas, region, members)
        standing = distinct(members, area, logit, MOST, ALIKE)
        crops = crops_of(view, region, members, np.unique(standing[standing >= 0]))
        said = np.full(len(logit) + 1, np.nan)  # the last is that of proposals that nothing stands for
        shown, mean = mean_by_proposal(crops.proposal, self.logits(crops))
        said[shown] = mean
        rows = np.flatnonzero(np.isfinite(said[standing]))
        return rows, said[standing[rows]]

    def logits(self, crops: Crops) -> np.ndarray:
        """Return the logit float64 (k,) of each crop: the mean of heads, and of the crop and its mirror image."""
        import torch

        from reconstruction.core.trunk import load_trunk

        torch.set_num_threads(1)
        trunk, heads = load_trunk(), self.heads

        def of(start: int) -> np.ndarray:
            part = slice(start, start + _BATCH)
            with torch.inference_mode():
                fine, coarse = trunk(color_input(crops.color[part]))[2:]
                seen = (fine, coarse, *head_inputs(crops.maps[part], crops.scalars[part]))
                return mean_logit(heads, seen)

        every = list(ordered_map(of, range(0, len(crops.proposal), _BATCH)))
        return np.concatenate(every).astype(np.float64) if every else np.zeros(0)

    @cached_property
    def heads(self) -> tuple:
        """The heads (`torch.nn.Module` each), in evaluation mode.

        Raises:
            EnvironmentMissing: weights are missing, too many, or of another shape.
        """
        import torch

        from reconstruction.instances.partition.crop_network import Head

        out = []
        for number in sorted({name.split(".")[1] for name in self.weights}):
            prefix, head = f"heads.{number}.", Head()
            own = {k.removeprefix(prefix): v for k, v in self.weights.items() if k.startswith(prefix)}
            try:
                head.load_state_dict({k: torch.from_numpy(np.array(v)) for k, v in own.items()})
            except RuntimeError as error:
                raise EnvironmentMissing(
                    f"instances: the weights of the crops' networks do not fit ({error}). Install the package again."
                ) from error
            out.append(head.eval())
        return tuple(out)


def cluster_areas(areas: np.ndarray, region: np.ndarray, members: csr_matrix) -> np.ndarray:
    """Return the area (n,) of each cluster of the members (m, n) from those of vertices (v,)."""
    count = members.shape[1]  # pyright: ignore[reportOptionalSubscript]
    return np.bincount(region, np.maximum(areas, _TINY), minlength=count)[:count]


def mean_by_proposal(proposal: np.ndarray, logit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the proposals that have crops, ascending, and the mean logit of each; `proposal` is that of each crop."""
    rows, own = np.unique(proposal, return_inverse=True)
    return rows, np.bincount(own, logit) / np.maximum(np.bincount(own), 1)


def estimated_iou(by_trees: np.ndarray, by_crops: np.ndarray) -> np.ndarray:
    """Return the IoU of proposals from the mean of both logits: trees know the shape better, networks the picture."""
    return expit(0.5 * (np.clip(by_trees, -_CLIP_LOGIT, _CLIP_LOGIT) + by_crops))


def color_input(color: np.ndarray):
    """Return color uint8 (b, h, w, 3) as the trunk's input (b, 3, h, w), -1 to 1."""
    import torch

    scaled = torch.from_numpy(color).permute(0, 3, 1, 2).float() / 127.5 - 1
    return scaled.contiguous(memory_format=torch.channels_last)


def head_inputs(maps: np.ndarray, scalars: np.ndarray) -> tuple:
    """Return the maps int8 and the scalars of crops as the head's inputs beside the features."""
    import torch

    return torch.from_numpy(maps).float() / 127, torch.from_numpy(scalars)


def mean_logit(heads, inputs: tuple) -> np.ndarray:
    """Return the mean logit (b,) of heads for their inputs and for the mirror image of these."""
    import torch

    return (
        torch.stack([head(*seen) for head in heads for seen in (inputs, mirrored(*inputs))]).mean(0).numpy()
    )


def mirrored(fine, coarse, maps, scalars) -> tuple:
    """Return the head's inputs mirrored left to right."""
    import torch

    sign = torch.ones(len(MAPS), 1, 1)
    sign[MAPS.index("normal_x")] = -1
    return fine.flip(3), coarse.flip(3), maps.flip(3) * sign, scalars
