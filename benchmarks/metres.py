"""Measure the error of the scale without marker: camera height alone, and with usual sizes of furniture and rooms.

    python -m benchmarks.metres [--rooms 60] [--seed 1000]

Rooms are drawn, filmed by true depth from median heights of 1.0 to 1.8 m, and their depth is spoilt: 1 % noise, 1 %
outliers, 30 % missing patches. About six seconds a room.
"""

import argparse
from types import SimpleNamespace

import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import DepthMaps
from reconstruction.world.config import WorldConfig
from reconstruction.world.floor import find_floor
from reconstruction.world.frame import rotate_samples
from reconstruction.world.gravity import find_gravity
from reconstruction.world.posterior import infer_scale
from reconstruction.world.samples import SurfaceSamples, sample_surface
from reconstruction.world.scale import CAMERA_SIGMA, camera_heights
from reconstruction.world.supports import highest_point, measure_supports
from reconstruction.world.yaw import level_rotation
from registry.errors import InputError, UsageError
from synthetic.camera_paths import look_at, phone_camera
from synthetic.procedural import furnish, plan_room
from synthetic.random_rooms import draw_room
from synthetic.shape_families import SHAPE_FAMILIES
from synthetic.walks import walk_path

_WALKS = ("arc", "two_heights", "strafe", "pan", "handheld_wander")
_SIZE = (240, 180)


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    about = (__doc__ or "").split("\n\n")[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.metres", description=about)
    parser.add_argument("--rooms", type=int, default=60, help="how many (default: %(default)s)")
    parser.add_argument(
        "--seed", type=int, default=1000, help="number of the first room (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    rows, config, number = [], WorldConfig(), options.seed
    while len(rows) < options.rooms:
        try:
            samples = film_samples(number, config)
        except (InputError, UsageError):  # a draw that no layout fits
            samples = None
        floor = find_floor(samples) if samples is not None else None
        if samples is not None and floor is not None and floor.observed:
            eye = float(np.median(camera_heights(samples))) - floor.height
            supports = measure_supports(samples, floor.height, eye)
            top, camera_m = highest_point(samples, floor.height), config.camera_height_prior_m
            found = infer_scale(eye, supports, top, camera_height_m=camera_m, camera_sigma=CAMERA_SIGMA)
            inside = found.low <= 1 <= found.high
            rows.append((abs(eye / camera_m - 1), abs(1 / found.per_unit - 1), inside, found.sigma))
            print(
                f"{number}: camera alone {100 * rows[-1][0]:.1f} %, usual sizes {100 * rows[-1][1]:.1f} %",
                flush=True,
            )
        number += 1
    alone, joint, inside, sigma = (np.array(column) for column in zip(*rows))
    for name, errors in (("camera alone", alone), ("usual sizes", joint)):
        print(f"{name}: median {100 * np.median(errors):.1f} %, 90 % {100 * np.quantile(errors, 0.9):.1f} %")
    print(
        f"usual sizes: {100 * inside.mean():.0f} % within the 68 % interval, sigma {100 * sigma.mean():.1f} %"
    )
    return 0


def film_samples(number: int, config: WorldConfig) -> SurfaceSamples:
    """Draw and film a room of this number; return its upright samples in metres."""
    shapes = tuple(SHAPE_FAMILIES)
    plan = plan_room(draw_room(700_000 + number, shapes=shapes, objects=(8, 26), step_m=0.15, density=0.08))
    patches = [patch for entity in furnish(plan).entities for patch in entity.patches]
    starts = np.cumsum([0] + [len(p.vertices) for p in patches[:-1]])
    vertices = np.concatenate([p.vertices for p in patches]).astype(np.float64)
    faces = np.concatenate([p.faces + start for p, start in zip(patches, starts)])
    rng = np.random.default_rng([number, 5])
    kind, hand = str(rng.choice(_WALKS)), int(rng.integers(2**31))
    path = walk_path(plan.shape, kind, 200, hand, float(rng.uniform(0.5, 1.5)))[::8]
    rise = np.array([0, 0, rng.uniform(1.0, 1.8) - np.median(path[:, 2, 3])])
    rolls = np.radians(rng.normal(0, 2, len(path)))
    # From the other height, the camera still looks at what lies ahead.
    poses = np.stack([look_at(p[:3, 3] + rise, p[:3, 3] + 1.8 * p[:3, 2], r) for p, r in zip(path, rolls)])
    camera = phone_camera(*_SIZE, float(rng.uniform(55, 75)))
    z = np.stack([rasterize_mesh(vertices, faces, camera, pose).depth for pose in poses])
    z = (
        z
        * (1 + 0.01 * rng.standard_normal(z.shape))
        * rng.choice([1, 0.6, 1.7], z.shape, p=[0.99, 0.005, 0.005])
    )
    z[(rng.random((len(z), 18, 24)) < 0.3).repeat(10, 1).repeat(10, 2)] = 0
    depth = DepthMaps(camera, z.astype(np.float32), np.where(z > 0, 2, 0).astype(np.uint8))
    posed = SimpleNamespace(world_from_camera=poses, images=z)
    samples = sample_surface(posed, depth, config)  # pyright: ignore[reportArgumentType]
    return rotate_samples(samples, level_rotation(find_gravity(posed, samples).up))  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    raise SystemExit(main())
