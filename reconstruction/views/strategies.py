"""Strategies that choose viewpoints, as compared in the paper, behind one interface."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from reconstruction.core.plugins import load_plugin
from reconstruction.core.types import Camera
from reconstruction.views.cameras import look_at, square_camera
from reconstruction.views.closure import close_shape
from reconstruction.views.config import AvoConfig
from reconstruction.views.coverage import LEAST_PX, Coverage, Unseen
from reconstruction.views.initial_views import input_starts, starts_around, starts_below, zoomed_camera
from reconstruction.views.scene import Target, ViewScene, reach_of, thinned
from reconstruction.views.search import Search
from registry.geometry import matrix_from_quat

if TYPE_CHECKING:
    from reconstruction.views.objective import Objective

_APART_DEG = 25.0  # smallest angle between the viewing directions of optimized starts
_CANONICAL_PITCH_DEG = 25.0  # from which `canonical` looks down
_BY_PIXELS = 0.15  # weight of the number of pixels relative to the newly seen share
_FRONTS_FROM = 2  # every second input camera is used to tell fronts from backs
_FURNITURE_M = 0.35  # radius above which a target may stand on legs and have a visible underside
_LARGE_STEPS = 2 / 3  # share of the steps for large targets


@dataclass(frozen=True)
class Viewpoint:
    """One chosen camera."""

    world_from_camera: np.ndarray  # float64 (4, 4) rigid
    camera: Camera  # at the working resolution
    origin: str  # how it was found, for users
    gain: float  # share of the target's opacity that no earlier viewpoint showed
    fronts: float = (
        1.0  # share of fronts in the visible target; 1 if the strategy does not tell them from backs
    )


class Strategy(Protocol):
    """Chooses the viewpoints of a target."""

    name: str

    def choose(self, scene: ViewScene, target: Target, config: AvoConfig) -> list[Viewpoint]:
        """Return at most `config.views` viewpoints, the most informative first; empty if the target cannot be seen."""
        ...


def _coverage(scene: ViewScene, target: Target, most: np.ndarray, config: AvoConfig) -> Coverage:
    opacities = 1.0 / (1.0 + np.exp(-scene.packed[target.rows, 9].astype(np.float64)))
    return Coverage(opacities, most, config.back_weight)


def _objective(scene: ViewScene, target: Target, camera: Camera, config: AvoConfig) -> "Objective":
    from reconstruction.views.objective import Objective

    reach = reach_of(scene.packed, config.sigma_cutoff)
    return Objective(scene.packed, reach, target.rows, camera, config)


class ActiveViews:
    """Active viewpoint optimization (SimRecon, section on AVO): greedy selection of optimized viewpoints."""

    def __init__(self, name: str, with_depth: bool) -> None:
        self.name, self._with_depth = name, with_depth

    def choose(self, scene: ViewScene, target: Target, config: AvoConfig) -> list[Viewpoint]:
        """See `Strategy.choose`."""
        weight = config.depth_weight if self._with_depth else 0.0
        closed = close_shape(scene, target)
        config, scene, target = _affordable(config, scene, target)
        fine = _objective(scene, target, square_camera(config.side_px, config.fov_deg), config)
        search = Search(fine, scene.clearance, target.distance_m, weight, config)
        fine.fronts = _fronts(scene, target, fine, config)
        starts = self._starts(scene, target, config)
        shown = np.array([_scan(fine, start, target)[0] for start in starts])
        sights = closed.seen(starts, fine.camera)
        fixed = np.array([search.loss_of_place(start[:3, 3])[0] for start in starts])
        unseen = Unseen.of(_coverage(scene, target, shown.max(axis=0), config), closed.areas, sights)
        pool = _Pool(starts[fixed == 0.0], shown[fixed == 0.0], sights[fixed == 0.0])
        free, first, chosen = len(pool.poses), unseen, []
        while len(chosen) < config.views:
            coverage = unseen.coverage
            information = np.einsum("ksm,sm->k", shown, coverage.worth)
            fine.reference_px = max(float(information.max()), LEAST_PX)
            scores = unseen.worth_of(shown, sights) + _BY_PIXELS * information / fine.reference_px - fixed
            rows = _apart(starts, -scores, config.restarts)
            found = search.best_of(starts[rows], coverage.worth)
            if found is None:
                break
            drawn = _scan(fine, found.pose, target)[0]
            pool = pool.with_one(found.pose, drawn, closed.seen(found.pose[None], fine.camera)[0])
            pixels = np.einsum("ksm,sm->k", pool.shown, coverage.worth) / fine.reference_px
            best = int(np.argmax(unseen.worth_of(pool.shown, pool.sights) + _BY_PIXELS * pixels))
            if unseen.gain(pool.shown[best], pool.sights[best]) < config.min_gain:
                break
            chosen.append(best)
            unseen = unseen.after(pool.shown[best], pool.sights[best])
            if unseen.remaining < config.remaining_share:
                break
        return pool.viewpoints(first.revised(chosen, pool.shown, pool.sights), first, fine.camera, free)

    def _starts(self, scene: ViewScene, target: Target, config: AvoConfig) -> np.ndarray:
        """Return the start poses (k, 4, 4) that the config asks for."""
        starts = input_starts(scene, target, config)
        if config.starts == "around":
            starts = np.concatenate([starts, starts_around(scene, target, config)])
            if target.radius_m > _FURNITURE_M:
                starts = np.concatenate([starts, starts_below(scene, target, config)])
        return _at_target_distance(starts, scene, target, config) if self._with_depth else starts


@dataclass(frozen=True)
class _Pool:
    """Candidate poses: the starts in free space, then the optimized ones."""

    poses: np.ndarray  # float64 (k, 4, 4)
    shown: np.ndarray  # float64 (k, 2, m) contributions of the target's Gaussians
    sights: np.ndarray  # float32 (k, n) visibilities of the closed shape's points

    def with_one(self, pose: np.ndarray, shown: np.ndarray, sight: np.ndarray) -> "_Pool":
        """Return the pool with one candidate appended."""
        added = ((self.poses, pose), (self.shown, shown), (self.sights, sight))
        return _Pool(*(np.concatenate([many, one[None]]) for many, one in added))

    def viewpoints(self, rows: Sequence[int], unseen: Unseen, camera: Camera, starts: int) -> list[Viewpoint]:
        """Return the viewpoints of rows in greedy order of gain; rows below `starts` are start poses."""
        left, out = list(dict.fromkeys(rows)), []
        while left:
            row = max(left, key=lambda one: unseen.gain(self.shown[one], self.sights[one]))
            left.remove(row)
            drawn, anew = self.shown[row], unseen.coverage.gain(self.shown[row])
            fronts = float(drawn[0].sum() / max(drawn.sum(), 1e-9))
            origin = "start" if row < starts else "optimized"
            out.append(Viewpoint(self.poses[row], camera, origin, anew, fronts))
            unseen = unseen.after(drawn, self.sights[row])
        return out


def _affordable(config: AvoConfig, scene: ViewScene, target: Target) -> tuple[AvoConfig, ViewScene, Target]:
    """Return config, scene and target; for a large target at lower resolution, with fewer steps and Gaussians."""
    if not 0 < config.large_gaussians < len(target.rows):
        return config, scene, target
    side, steps = min(config.side_px, config.scan_side_px), round(_LARGE_STEPS * config.steps)
    return replace(config, side_px=side, steps=steps), *thinned(scene, target, config.large_gaussians)


def _scan(objective: "Objective", pose: np.ndarray, target: Target) -> tuple[np.ndarray, float]:
    """Return the contributions (2, m) at a pose in pixels as from the target distance, and the target's depth.

    This scaling makes them independent of the camera's distance.
    """
    contributions, depth = objective.scan(pose)
    return contributions * (depth / target.distance_m) ** 2, depth


def _at_target_distance(
    starts: np.ndarray, scene: ViewScene, target: Target, config: AvoConfig
) -> np.ndarray:
    """Return the starts (n, 4, 4) moved along their view towards the target distance, within free space."""
    out = starts.copy()
    away = np.linalg.norm(starts[:, :3, 3] - target.center, axis=1)
    for row, forward in enumerate(away - target.distance_m - target.radius_m):
        for share in (1.0, 0.8, 0.6, 0.4, 0.2):
            eye = starts[row, :3, 3] + share * forward * starts[row, :3, 2]
            if scene.clearance.at(eye) >= config.clearance_m:
                out[row, :3, 3] = eye
                break
    return out


def _fronts(scene: ViewScene, target: Target, objective: "Objective", config: AvoConfig) -> np.ndarray:
    """Return the normals (m, 3) of the target's Gaussians, oriented towards the input cameras that see them."""
    packed = scene.packed[target.rows].astype(np.float64)
    normals = matrix_from_quat(packed[:, 3:7])[:, :, 2]
    side = np.zeros(len(packed))
    for pose in input_starts(scene, target, config)[::_FRONTS_FROM]:
        shown = objective.scan(pose, zoomed_camera(pose, target, config.scan_side_px))[0].sum(axis=0)
        toward = pose[:3, 3] - packed[:, :3]
        facing = np.einsum("mc,mc->m", toward, normals) / np.linalg.norm(toward, axis=1)
        side += (shown + 1e-9) * facing
    return normals * np.where(side < 0, -1.0, 1.0)[:, None]


def _apart(starts: np.ndarray, losses: np.ndarray, count: int) -> list[int]:
    """Return up to `count` rows of starts (n, 4, 4) by ascending loss, with viewing directions _APART_DEG apart."""
    chosen: list[int] = []
    for row in np.argsort(losses, kind="stable"):
        ahead = starts[row, :3, 2]
        if all(starts[other, :3, 2] @ ahead < math.cos(math.radians(_APART_DEG)) for other in chosen):
            chosen.append(int(row))
            if len(chosen) == count:
                break
    return chosen


class InputFrames:
    """Greedy selection of input frames by newly visible opacity."""

    name = "max-visibility"

    def choose(self, scene: ViewScene, target: Target, config: AvoConfig) -> list[Viewpoint]:
        """See `Strategy.choose`."""
        scale = config.side_px / max(scene.camera.width, scene.camera.height)
        camera = scene.camera.resized(round(scene.camera.width * scale), round(scene.camera.height * scale))
        objective = _objective(scene, target, camera, config)
        shown = np.array([_scan(objective, pose, target)[0] for pose in scene.inputs])
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
    """Evenly spaced viewpoints around the target, the first on the side of the input cameras; ignores the room."""

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
        shown = np.array([_scan(objective, pose, target)[0] for pose in poses])
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
    return STRATEGIES[name] if name in STRATEGIES else load_plugin("avo.strategy", name, AvoConfig)()
