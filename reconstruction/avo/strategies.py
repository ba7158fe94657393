"""How viewpoints are chosen: the strategies that the paper compares, behind one interface."""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from reconstruction.avo.cameras import look_at, square_camera
from reconstruction.avo.closure import close_shape
from reconstruction.avo.config import AvoConfig
from reconstruction.avo.coverage import LEAST_PX, Coverage, Unseen
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
_FRONTS_FROM = 2  # every second input camera tells fronts from backs
_BETTER = 1.03  # by this factor a start must show more than what the search made of it, to stay
_CLOSED_AT_LAST = 0.3  # of that comparison is the closed shape's: it knows nothing of undersides
_LARGE_STEPS = 2 / 3  # of the steps are taken for large targets


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
        filmed = [coarse.scan(start)[0][0] for start in starts[::_FRONTS_FROM]]
        fine.fronts = coarse.fronts = _fronts(scene, target, np.array(filmed))
        if config.starts == "around":
            starts = np.concatenate([starts, starts_around(scene, target, config)])
        scanned = [_scan(coarse, start, target, fine.camera) for start in starts]
        shown = np.array([contributions for contributions, _ in scanned])
        if self._with_depth:
            starts = _at_target_distance(starts, np.array([z for _, z in scanned]), scene, target, config)
        closed = close_shape(scene, target)
        sights = closed.seen(starts, fine.camera)
        fixed = np.array([search.loss_of_place(start[:3, 3])[0] for start in starts])
        unseen = Unseen.of(_coverage(scene, target, shown.max(axis=0), config), closed.areas, sights)
        out: list[Viewpoint] = []
        while len(out) < config.views:
            coverage = unseen.coverage
            information = np.einsum("ksm,sm->k", shown, coverage.worth)
            fine.reference_px = max(float(information.max()), LEAST_PX)
            scores = unseen.worth_of(shown, sights) + _BY_PIXELS * information / fine.reference_px - fixed
            rows = _apart(starts, -scores, config.restarts)
            found = search.best_of(starts[rows], coverage.worth)
            if found is None:
                break
            # What counts is what is seen anew: more pixels of less are no progress.
            poses = np.array([found.pose, *(starts[row] for row in rows if fixed[row] == 0.0)])
            drawn = np.array([_scan(fine, pose, target, fine.camera)[0] for pose in poses])
            seen = closed.seen(poses, fine.camera)
            worth = unseen.worth_of(drawn, seen, _CLOSED_AT_LAST)
            worth[0] *= _BETTER
            best = int(np.argmax(worth))
            gain = unseen.gain(drawn[best], seen[best])
            if gain < config.min_gain:
                break
            fronts = float(drawn[best, 0].sum() / max(drawn[best].sum(), 1e-9))
            origin, anew = "start" if best else "optimized", coverage.gain(drawn[best])
            out.append(Viewpoint(poses[best], fine.camera, origin, anew, fronts))
            unseen = unseen.after(drawn[best], seen[best])
            if unseen.remaining < config.remaining_share:
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
