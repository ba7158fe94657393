"""A bundle's 2D Gaussians, each with the body of the simulator that carries it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from registry import BundleError, SceneBundle
from registry.geometry import matrix_from_quat
from registry.plyfiles import read_vertices
from simrecon_envs.errors import SceneAssetsMissing
from simrecon_envs.occupancy import ConvexSolid
from simrecon_envs.scene_builder import Body

SIGMA_CUTOFF = 2.6  # standard deviations at which a splat ends, as in the fit
ALPHA_MIN = 1.0 / 255.0  # alpha below which a splat ends, as in the fit
_SH_C0 = 0.28209479177387814  # constant spherical harmonic: color = 0.5 + C0 * coefficient
_COLUMNS = (
    "x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "opacity", "f_dc_0", "f_dc_1", "f_dc_2",
    "instance_id",
)  # fmt: skip
# Gaussians up to this far outside of a movable thing's collision shapes are its own (the fit blurs outlines by about
# the size of a Gaussian, the shapes are within some millimetres of the surface), but not those at its foot: they show
# the top that it stands on.
_CLAIM_M, _FOOT_M = 0.01, 0.005
# Gaussians up to `_BELOW_M` below a movable thing's foot are covered by it where its shape is over them at one of these
# heights above the foot: as far as things overhang without showing what is below them.
_BELOW_M, _COVER_M = 0.06, (0.01, 0.03, 0.05)
UNOWNED = 0  # row of the body of Gaussians that belong to nothing


@dataclass(frozen=True)
class SplatScene:
    """Gaussians in world space as captured. Body 0 is no thing; bodies 1.. are `keys`, base entities first."""

    rows: np.ndarray  # float32 (n, 11) columns of `kernels`, metres
    colors: np.ndarray  # float32 (n, 3) sRGB values, 1 is white
    bodies: np.ndarray  # int32 (n,) row of the carrying body
    keys: tuple[int, ...]  # ids of base entities and of the bodies' root objects
    world_from_body: np.ndarray  # float64 (1 + keys, 4, 4) as captured


def read_splats(bundle: SceneBundle, bodies: Sequence[Body], solids: Sequence[ConvexSolid]) -> SplatScene:
    """Read the Gaussians of a bundle and assign them to bodies by `instance_id`.

    Gaussians of immovable or no things at the surface of a movable one show that one's color, and go with it. Those
    just below a movable thing were seen in no frame; their colors are arbitrary, and they are left out.

    Args:
        bundle: A scene.
        bodies: Of `scene_builder.bodies_of`; objects that are welded to another belong to its body.
        solids: Collision shapes of all things, world space.

    Raises:
        SceneAssetsMissing: The bundle has no Gaussians, or they have no instance ids.
    """
    scene_id = bundle.scene["id"]
    entry = bundle.scene.get("gaussians")
    advice = (
        f"make the scene again with `simrecon reconstruct VIDEO --scene {scene_id}`, or use renderer='mesh'"
    )
    if entry is None:
        raise SceneAssetsMissing(
            f"scene {scene_id}: renderer='splats' needs gaussians.ply, which this bundle does not have; {advice}"
        )
    try:
        found = read_vertices(bundle.resolve(entry["file"]))
    except BundleError as error:
        raise SceneAssetsMissing(f"scene {scene_id}: renderer='splats': {error}; {advice}") from error
    missing = [name for name in _COLUMNS if name not in found]
    if missing:
        raise SceneAssetsMissing(
            f"scene {scene_id}: renderer='splats': {entry['file']} has no property {', '.join(missing)}; {advice}"
        )
    base = [item.id for item in bundle.base]
    row_of = {key: row for row, key in enumerate(base, 1)}
    for row, body in enumerate(bodies, 1 + len(base)):
        row_of |= {spec.id: row for spec in body.specs}
    movable = {row_of[body.root] for body in bodies if body.dynamic}
    shapes = [(row_of[solid.owner], solid) for solid in solids if row_of.get(solid.owner, 0) in movable]
    world_from_body = [np.eye(4)] * (1 + len(base)) + [body.world_from_root for body in bodies]
    keys = (*base, *(body.root for body in bodies))
    scene = packed_scene(found, row_of, keys, np.array(world_from_body))
    _claim(scene, shapes)
    shown = ~_covered(scene, shapes)
    return replace(scene, rows=scene.rows[shown], colors=scene.colors[shown], bodies=scene.bodies[shown])


def packed_scene(
    found: dict[str, np.ndarray], row_of: dict[int, int], keys: tuple[int, ...], world_from_body: np.ndarray
) -> SplatScene:
    """Sort the columns of a file into a scene, each Gaussian in the frame of its body."""

    def take(*names: str) -> np.ndarray:
        return np.stack([np.asarray(found[name], np.float64) for name in names], axis=1)

    opacity = 1 / (1 + np.exp(-take("opacity")[:, 0]))
    shown = opacity > ALPHA_MIN
    axes = matrix_from_quat(_unit(take("rot_0", "rot_1", "rot_2", "rot_3")[shown]))
    scales = np.exp(take("scale_0", "scale_1")[shown])
    opacity = opacity[shown]
    reach2 = np.minimum(SIGMA_CUTOFF**2, 2 * np.log(opacity / ALPHA_MIN))
    columns = [
        take("x", "y", "z")[shown], axes[:, :, 0] * scales[:, :1], axes[:, :, 1] * scales[:, 1:], opacity[:, None],
        reach2[:, None],
    ]  # fmt: skip
    colors = np.maximum(0.5 + _SH_C0 * take("f_dc_0", "f_dc_1", "f_dc_2")[shown], 0)
    ids = np.asarray(found["instance_id"])[shown]
    bodies = np.array([row_of.get(int(key), UNOWNED) for key in ids], np.int32)
    return SplatScene(
        rows=np.ascontiguousarray(np.concatenate(columns, axis=1), np.float32),
        colors=np.ascontiguousarray(colors, np.float32),
        bodies=bodies,
        keys=keys,
        world_from_body=world_from_body,
    )


def _claim(scene: SplatScene, shapes: list[tuple[int, ConvexSolid]]) -> None:
    """Assign Gaussians at the surface of movable bodies to them, in place, unless they are of another movable body."""
    bottoms = _bottoms(shapes)
    centers = scene.rows[:, :3].astype(np.float64)
    free = ~np.isin(scene.bodies, list(bottoms))
    for row, solid in shapes:
        near = (
            free
            & (centers >= solid.lower - _CLAIM_M).all(axis=1)
            & (centers <= solid.upper + _CLAIM_M).all(axis=1)
        )
        near &= centers[:, 2] > bottoms[row] + _FOOT_M
        index = np.flatnonzero(near)
        apart = (centers[index] @ solid.half_spaces[:, :3].T + solid.half_spaces[:, 3]).max(
            axis=1, initial=-np.inf
        )
        scene.bodies[index[apart < _CLAIM_M]] = row


def _covered(scene: SplatScene, shapes: list[tuple[int, ConvexSolid]]) -> np.ndarray:
    """Return the mask (n,) of Gaussians that a movable body, not their own, covers from above."""
    bottoms = _bottoms(shapes)
    centers = scene.rows[:, :3].astype(np.float64)
    covered = np.zeros(len(centers), bool)
    for row, solid in shapes:
        below = bottoms[row] + _FOOT_M - centers[:, 2]
        near = (scene.bodies != row) & (below > 0) & (below < _BELOW_M)
        near &= (centers[:, :2] >= solid.lower[:2]).all(axis=1) & (centers[:, :2] <= solid.upper[:2]).all(
            axis=1
        )
        index = np.flatnonzero(near)
        for height in _COVER_M:
            raised = np.column_stack([centers[index, :2], np.full(len(index), bottoms[row] + height)])
            inside = (raised @ solid.half_spaces[:, :3].T + solid.half_spaces[:, 3]).max(
                axis=1, initial=-np.inf
            ) < 0
            covered[index[inside]] = True
    return covered


def _bottoms(shapes: list[tuple[int, ConvexSolid]]) -> dict[int, float]:
    """Return the height of each body's lowest point, metres."""
    bottoms: dict[int, float] = {}
    for row, solid in shapes:
        bottoms[row] = min(bottoms.get(row, np.inf), float(solid.lower[2]))
    return bottoms


def _unit(quats: np.ndarray) -> np.ndarray:
    return quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
