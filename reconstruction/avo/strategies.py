"""How viewpoints are chosen: the strategies that the paper compares, behind one interface."""

import math
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from reconstruction.avo.cameras import look_at, square_camera
from reconstruction.avo.config import AvoConfig
from reconstruction.avo.scene import Target, ViewScene, reach_of
from reconstruction.avo.search import Search
from reconstruction.avo.starts import input_starts, starts_around
from reconstruction.types import Camera
from registry.errors import UsageError
from registry.geometry import matrix_from_quat

if TYPE_CHECKING:
    from reconstruction.avo.objective import Objective

_APART_DEG = 25.0  # starts that are optimized look from directions at least this far apart
_CANONICAL_PITCH_DEG = 25.0
_BY_PIXELS = 0.15  # of the ranking of starts; the rest is by what is seen anew
_SEEN_AT, _CLEAR_SHARE = 0.1, 0.2
_FRONTS_FROM = 2  # every second input camera tells fronts from backs
_BETTER = 1.03  # by this factor a start must show more than what the search made of it, to stay
_LARGE_STEPS = 2 / 3  # of the steps are taken for large targets
_LEAST_PX = 0.05  # of a Gaussian; less is never a good view of it


@dataclass(frozen=True)
class Viewpoint:
    """One chosen camera."""

    world_from_camera: np.ndarray  # float64 (4, 4)
    camera: Camera  # field of view; its size is the working resolution
    origin: str  # how it was found, for people
    gain: float  # share of the target's opacity that it showed for the first time
    fronts: float = (
        1.0  # share of what is seen that frames saw, not backs; 1 where the strategy does not tell them
    )


class Strategy(Protocol):
    """Chooses the viewpoints of a target."""

    name: str

    def choose(self, scene: ViewScene, target: Target, config: AvoConfig) -> list[Viewpoint]:
        """Return at most `config.views` viewpoints, the most informative first; none where nothing can be seen."""


class Coverage:
    """What is left of the target's effective opacities: alpha_i decays by what each view shows of it.

    A Gaussian has a front, which frames saw, and a back, which shows through sides that no frame saw: it stands for
    what is there, with less weight. What a view shows of a side is its rendered contribution beside the most that any
    start shows of it. A tenth of that counts as seen; a fifth of the weight waits for a view as good as the best.
    """

    def __init__(self, opacities: np.ndarray, most: np.ndarray, back_weight: float) -> None:
        """Start with nothing seen.

        Args:
            opacities: (m,) of the target's Gaussians.
            most: (2, m) the largest contributions of their fronts and backs, sums over pixels of alpha T; what cannot
                be seen does not count.
            back_weight: of backs beside fronts.
        """
        sides = np.where(most > _LEAST_PX, np.array([[1.0], [back_weight]]), 0.0)
        self._opacities = np.asarray(opacities, np.float64) * sides
        self._total = max(float(self._opacities.sum()), 1e-12)
        self._sides, self._most = sides, np.maximum(most, _LEAST_PX)
        self._unseen, self._unclear = np.ones(most.shape), np.ones(most.shape)

    @property
    def left(self) -> np.ndarray:
        """What is left of each side (2, m), as a share of its own."""
        return (1.0 - _CLEAR_SHARE) * self._unseen + _CLEAR_SHARE * self._unclear

    @property
    def worth(self) -> np.ndarray:
        """What is left of the effective opacity of each side (2, m), as a share of a front's."""
        return self._sides * self.left

    @property
    def remaining(self) -> float:
        """Share of the opacity that is left."""
        return float((self._opacities * self.left).sum()) / self._total

    def gain(self, contributions: np.ndarray) -> float:
        """Return the share of the opacity that a view with these contributions (2, m) shows anew."""
        return self.remaining - self.after(contributions).remaining

    def after(self, contributions: np.ndarray) -> "Coverage":
        """Return what is left after a view with these contributions (2, m)."""
        out = copy(self)
        share = contributions / self._most
        out._unseen = self._unseen * (1.0 - np.clip(share / _SEEN_AT, 0.0, 1.0))
        out._unclear = self._unclear * (1.0 - np.clip(share, 0.0, 1.0))
        return out


def _coverage(scene: ViewScene, target: Target, most: np.ndarray, config: AvoConfig) -> Coverage:
    opacities = 1.0 / (1.0 + np.exp(-scene.packed[target.rows, 9].astype(np.float64)))
    return Coverage(opacities, most, config.back_weight)


def _objective(scene: ViewScene, target: Target, camera: Camera, config: AvoConfig) -> "Objective":
    from reconstruction.avo.objective import Objective

    reach = reach_of(scene.packed, config.sigma_cutoff)
    return Objective(scene.packed, reach, target.rows, camera, config)


class ActiveViews:
    """Active viewpoint optimization (SimRecon, section on AVO)."""

    def __init__(self, name: str, with_depth: bool) -> None:
        self.name, self._with_depth = name, with_depth

    def choose(self, scene: ViewScene, target: Target, config: AvoConfig) -> list[Viewpoint]:
        """See `Strategy.choose`."""
        weight = config.depth_weight if self._with_depth else 0.0
        config = _affordable(config, target)
        coarse = _objective(scene, target, square_camera(config.scan_side_px, config.fov_deg), config)
        fine = _objective(scene, target, square_camera(config.side_px, config.fov_deg), config)
        search = Search(fine, scene.clearance, target.distance_m, weight, config)
        starts = input_starts(scene, target, config)
        seen = [coarse.scan(start)[0][0] for start in starts[::_FRONTS_FROM]]
        fine.fronts = coarse.fronts = _fronts(scene, target, np.array(seen))
        if config.starts == "around":
            starts = np.concatenate([starts, starts_around(scene, target, config)])
        scanned = [_scan(coarse, start, target, fine.camera) for start in starts]
        shown = np.array([contributions for contributions, _ in scanned])
        if self._with_depth:
            starts = _at_target_distance(starts, np.array([z for _, z in scanned]), scene, target, config)
        fixed = np.array([search.loss_of_place(start[:3, 3])[0] for start in starts])
        coverage, out = _coverage(scene, target, shown.max(axis=0), config), []
        while len(out) < config.views:
            information = np.einsum("ksm,sm->k", shown, coverage.worth)
            fine.reference_px = max(float(information.max()), _LEAST_PX)
            gains = np.array([coverage.gain(contributions) for contributions in shown])
            scores = gains / max(gains.max(), 1e-9) + _BY_PIXELS * information / fine.reference_px - fixed
            rows = _apart(starts, -scores, config.restarts)
            found = search.best_of(starts[rows], coverage.worth)
            if found is None:
                break
            pose, contributions = found.pose, _scan(fine, found.pose, target, fine.camera)[0]
            for row in rows:  # what counts is what is seen anew: more pixels of less are no progress
                if fixed[row] == 0.0 and coverage.gain(shown[row]) > _BETTER * coverage.gain(contributions):
                    pose, contributions = starts[row], _scan(fine, starts[row], target, fine.camera)[0]
            gain, coverage = coverage.gain(contributions), coverage.after(contributions)
            if gain < config.min_gain:
                break
            origin = "optimized" if pose is found.pose else "start"
            fronts = float(contributions[0].sum() / max(contributions.sum(), 1e-9))
            out.append(Viewpoint(pose, fine.camera, origin, gain, fronts))
            if coverage.remaining < config.remaining_share:
                break
        return out


def _affordable(config: AvoConfig, target: Target) -> AvoConfig:
    """Return the settings for a target: coarser and shorter where it is large."""
    if not 0 < config.large_gaussians < len(target.rows):
        return config
    side, steps = min(config.side_px, config.scan_side_px), round(_LARGE_STEPS * config.steps)
    return replace(config, side_px=side, steps=steps)


def _scan(
    objective: "Objective", pose: np.ndarray, target: Target, camera: Camera
) -> tuple[np.ndarray, float]:
    """Return what a pose shows of each side of the target's Gaussians (2, m), and at which depth.

    In pixels of `camera`, from the target distance: so they say how well a side is seen, not how close the camera is.
    """
    contributions, depth = objective.scan(pose)
    return contributions * (depth / target.distance_m * camera.fx / objective.camera.fx) ** 2, depth


def _at_target_distance(
    starts: np.ndarray, depths: np.ndarray, scene: ViewScene, target: Target, config: AvoConfig
) -> np.ndarray:
    """Return the starts (n, 4, 4) moved along their view to the target distance, as far as is free."""
    out = starts.copy()
    for row in np.flatnonzero(depths > 0):
        forward = depths[row] - target.distance_m
        for share in (1.0, 0.8, 0.6, 0.4, 0.2):
            eye = starts[row, :3, 3] + share * forward * starts[row, :3, 2]
            if scene.clearance.at(eye) >= config.clearance_m:
                out[row, :3, 3] = eye
                break
    return out


def _fronts(scene: ViewScene, target: Target, shown: np.ndarray) -> np.ndarray:
    """Return the normals (m, 3) of the target's Gaussians towards the input cameras that saw them.

    Args:
        scene: with the input cameras.
        target: its Gaussians.
        shown: what each Gaussian (m,) gives to every second of them.
    """
    packed = scene.packed[target.rows].astype(np.float64)
    normals = matrix_from_quat(packed[:, 3:7])[:, :, 2]
    toward = scene.inputs[::_FRONTS_FROM, None, :3, 3] - packed[None, :, :3]
    facing = np.einsum("kmc,mc->km", toward, normals) / np.linalg.norm(toward, axis=2)
    side = ((shown + 1e-9) * facing).sum(axis=0)
    return normals * np.where(side < 0, -1.0, 1.0)[:, None]


def _apart(starts: np.ndarray, losses: np.ndarray, count: int) -> list[int]:
    """Return the rows of the best starts that look from different directions."""
    chosen: list[int] = []
    for row in np.argsort(losses, kind="stable"):
        ahead = starts[row, :3, 2]
        if all(starts[other, :3, 2] @ ahead < math.cos(math.radians(_APART_DEG)) for other in chosen):
            chosen.append(int(row))
            if len(chosen) == count:
                break
    return chosen


class InputFrames:
    """The input frames that see most, each next one by what the ones before it did not show."""

    name = "max-visibility"

    def choose(self, scene: ViewScene, target: Target, config: AvoConfig) -> list[Viewpoint]:
        """See `Strategy.choose`."""
        scale = config.side_px / max(scene.camera.width, scene.camera.height)
        camera = scene.camera.resized(round(scene.camera.width * scale), round(scene.camera.height * scale))
        objective = _objective(scene, target, camera, config)
        shown = np.array([_scan(objective, pose, target, camera)[0] for pose in scene.inputs])
        coverage, out = _coverage(scene, target, shown.max(axis=0), config), []
        while len(out) < config.views:
            row = int(np.argmax(np.einsum("ksm,sm->k", shown, coverage.worth)))
            gain, coverage = coverage.gain(shown[row]), coverage.after(shown[row])
            if gain < config.min_gain:
                break
            out.append(Viewpoint(scene.inputs[row], camera, f"input frame {scene.frames[row]}", gain))
            if coverage.remaining < config.remaining_share:
                break
        return out


class Orbit:
    """Evenly spread places around the target, the first where the input cameras are; it knows nothing of the room."""

    name = "canonical"

    def choose(self, scene: ViewScene, target: Target, config: AvoConfig) -> list[Viewpoint]:
        """See `Strategy.choose`."""
        camera = square_camera(config.side_px, config.fov_deg)
        objective = _objective(scene, target, camera, config)
        toward = scene.inputs[:, :2, 3].mean(axis=0) - target.center[:2]
        front, pitch = math.atan2(toward[1], toward[0]), math.radians(_CANONICAL_PITCH_DEG)
        poses = []
        for number in range(config.views):
            angle = front + 2.0 * math.pi * number / config.views
            flat = math.cos(pitch) * np.array([math.cos(angle), math.sin(angle)])
            away = np.append(flat, math.sin(pitch))
            eye = target.center + (target.distance_m + target.radius_m) * away
            poses.append(look_at(eye, target.center, config.max_pitch_deg))
        shown = np.array([_scan(objective, pose, target, camera)[0] for pose in poses])
        coverage, out = _coverage(scene, target, shown.max(axis=0), config), []
        for number, pose in enumerate(poses):
            gain, coverage = coverage.gain(shown[number]), coverage.after(shown[number])
            out.append(Viewpoint(pose, camera, f"orbit at {360 * number // config.views} degrees", gain))
        return out


STRATEGIES: dict[str, Strategy] = {
    strategy.name: strategy
    for strategy in (
        ActiveViews("avo", with_depth=True),
        ActiveViews("avo-no-depth", with_depth=False),
        InputFrames(),
        Orbit(),
    )
}


def load_strategy(name: str) -> Strategy:
    """Return a strategy by name.

    Raises:
        UsageError: there is no such strategy.
    """
    if name not in STRATEGIES:
        raise UsageError(f"views: no strategy {name!r}; there are {', '.join(STRATEGIES)}")
    return STRATEGIES[name]
