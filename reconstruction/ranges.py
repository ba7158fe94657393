"""Ranges of the numeric options of all stages: a stage's options in, `UsageError` out if one is out of its range.

A range is looked up by `stage.field`, then by the end of the field's name, which says the unit. NaN and infinity are
in no range.
"""

import dataclasses
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

from registry.errors import UsageError


@dataclass(frozen=True)
class Range:
    """A closed interval."""

    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"{self.low:.10g} to {self.high:.10g}"


_MANY = Range(1, 1e9)
_SHARE = Range(0, 1)
_POSITIVE_SHARE = Range(1e-6, 1)
_LENGTH_M = Range(1e-3, 1000)
_ONE: dict[str, Range] = {
    "frames.min_keyframes": Range(2, 100_000),
    "frames.max_keyframes": Range(2, 100_000),
    "frames.min_usable_frames": Range(2, 100_000),
    "frames.step": Range(1e-4, 1),
    "frames.widest_gap": Range(1e-4, 1),
    "frames.max_analysis_fps": Range(0.1, 10_000),
    "poses.max_features": Range(16, 1_000_000),
    "poses.contrast_threshold": _POSITIVE_SHARE,
    "poses.sequential_overlap": Range(1, 10_000),
    "poses.max_pairs_per_frame": _MANY,
    "poses.min_inliers": _MANY,
    "poses.max_point_error_px": Range(0.01, 1000),
    "poses.min_track_length": Range(2, 1000),
    "depth.planes": Range(2, 10_000),
    "depth.sources": Range(1, 1000),
    "depth.neighbors": Range(1, 10_000),
    "depth.noise_gray": Range(0.01, 255),
    "depth.min_correlation": Range(-1, 1),
    "depth.agree_depth": _POSITIVE_SHARE,
    "depth.agree_px": Range(0.01, 1000),
    "depth.prior_agree_depth": _POSITIVE_SHARE,
    "depth.prior_agree_px": Range(0.01, 1000),
    "depth.smooth_small": Range(0, 60),  # path costs are numbers of 16 bits
    "depth.smooth_large": Range(0, 60),
    "depth.threads": Range(0, 4096),
    "depth.perturb": Range(0, 2**32 - 1),
    "world.object_measured_height_m": Range(0, 1000),
    "world.marker_size_m": Range(0, 5),
    "world.camera_height_prior_m": Range(0.05, 20),
    "world.camera_height_sigma": Range(1e-3, 1),
    "world.table_height_prior_m": Range(0.05, 20),
    "world.subject_distance_prior_m": Range(0.05, 100),
    "world.max_frames": Range(1, 100_000),
    "world.samples_per_frame": Range(16, 10_000_000),
    "gaussians.iterations": _MANY,
    "gaussians.max_gaussians": _MANY,
    "gaussians.densify_every": _MANY,
    "gaussians.ssim_weight": _SHARE,
    "gaussians.depth_scale": Range(1e-6, 1000),
    "gaussians.clear_depth": _POSITIVE_SHARE,
    "gaussians.confirmed_depth": _POSITIVE_SHARE,
    "gaussians.sigma_cutoff": Range(0.5, 10),
    "gaussians.transmittance_stop": _SHARE,
    "surface.voxel_size_m": _LENGTH_M,
    "surface.truncation_voxels": Range(1, 100),
    "surface.max_depth_m": Range(0.05, 1000),
    "surface.reference_depth_m": Range(0.05, 1000),
    "surface.min_views": Range(1, 10_000),
    "surface.max_blocks": _MANY,
    "surface.slab_blocks": Range(2, 1e9),
    "surface.max_vertices": Range(100, 1e9),
    "surface.space_voxel_m": _LENGTH_M,
    "surface.free_min_rays": Range(1, 10_000),
    "surface.max_space_cells": Range(1000, 1e10),
    "instances.masks_points": Range(1, 1024),
    "instances.snap_radius_px": Range(0, 1000),
    "avo.views": Range(1, 1000),
    "avo.remaining_share": _SHARE,
    "avo.min_gain": _SHARE,
    "avo.fov_deg": Range(5, 140),
    "avo.fill": _POSITIVE_SHARE,
    "avo.steps": Range(0, 100_000),
    "avo.restarts": Range(1, 1000),
    "avo.sigma_cutoff": Range(0.5, 10),
    "avo.alpha_min": _SHARE,
    "avo.transmittance_stop": _SHARE,
    "assets.voxel_min_m": Range(1e-4, 10),
    "assets.cells_along_longest": Range(4, 10_000),
    "assets.max_voxels": Range(1000, 1e10),
    "assets.faces_small": Range(8, 10_000_000),
    "assets.faces_furniture": Range(8, 10_000_000),
    "assets.faces_structure": Range(8, 10_000_000),
    "assets.texture_min_px": Range(4, 16_384),
    "assets.texture_max_px": Range(4, 16_384),
    "assets.texture_frames": Range(1, 10_000),
    "assets.base_texel_m": Range(1e-4, 10),
    "assets.hulls_small": Range(1, 10_000),
    "assets.hulls_furniture": Range(1, 10_000),
    "assets.hulls_ring": Range(1, 10_000),
    "assets.hulls_scene": Range(1, 1_000_000),
    "assets.hulls_structure": Range(1, 10_000),
    "assets.convex_enough": _SHARE,
    "assets.collision_faces": Range(8, 10_000_000),
    "assets.coacd_threshold": Range(0.01, 1),
    "assets.hull_vertices": Range(4, 255),
    "assets.generator_views": Range(1, 100),
    "assets.generator_timeout_s": Range(1, 86_400),
    "assets.generator_max_mb": Range(1e-3, 100_000),
    "assets.generator_missed": _SHARE,
    "assets.generator_intruding": _SHARE,
    "assets.generator_filling": _SHARE,
    "scene_graph.adjudications": Range(1, 100),
    "scene_graph.region_radius_m": _LENGTH_M,
    "scene_graph.region_min_objects": Range(1, 1_000_000),
    "scene_graph.picture_side_px": Range(128, 16_384),
    "scene_graph.least_visible": _SHARE,
    "assembly.joint_rounds": Range(0, 1000),
    "assembly.mcmc_sweeps": Range(0, 1_000_000),
}  # fmt: skip
_BY_END: tuple[tuple[str, Range], ...] = (
    ("seed", Range(0, 2**32 - 1)),
    ("side_px", Range(16, 16_384)),
    ("share", _SHARE),
    ("_below", _SHARE),
    ("opacity", _SHARE),
    ("surety", _SHARE),
    ("growth", _SHARE),
    ("_until", _SHARE),
    ("rate", _SHARE),
    ("weight", Range(0, 1e6)),
    ("_deg", Range(0, 180)),
    ("_m", Range(0, 1000)),
    ("_m2", Range(0, 1e6)),
    ("_mm", Range(0, 1000)),
    ("_s", Range(0, 86_400)),
    ("", Range(0, 1e9)),
)


def range_of(option: str) -> Range:
    """Return the range of a numeric option, given as `stage.field`."""
    if option in _ONE:
        return _ONE[option]
    return next(found for end, found in _BY_END if option.endswith(end))


def numeric_options(stage: str, config: Any) -> Iterator[tuple[str, Any]]:
    """Yield each numeric option of a stage as (`stage.field`, value); the value of some is a tuple of numbers."""
    for name in _numeric_fields(type(config)):
        yield f"{stage}.{name}", getattr(config, name)


@cache
def _numeric_fields(cls: type) -> tuple[str, ...]:
    hints = typing.get_type_hints(cls)
    listed = [name for name, hint in hints.items() if typing.get_origin(hint) is tuple]
    numbers = [name for name in listed if typing.get_args(hints[name])[0] in (int, float)]
    return (*(name for name, hint in hints.items() if hint in (int, float)), *numbers)


def check_ranges(config: Any) -> None:
    """Check the numbers of all stages of a `PipelineConfig`.

    Raises:
        UsageError: a number is not finite or out of its range; names the option and the range.
    """
    for stage in dataclasses.fields(config):
        for option, value in numeric_options(stage.name, getattr(config, stage.name)):
            numbers = value if isinstance(value, tuple) else (value,)
            allowed = range_of(option)
            if not numbers:
                raise UsageError(f"{option}: at least one number is needed, each from {allowed}")
            for number in numbers:
                if isinstance(number, bool) or not isinstance(number, int | float) or number not in allowed:
                    raise UsageError(f"{option} is {number!r}; it must be a number from {allowed}")
