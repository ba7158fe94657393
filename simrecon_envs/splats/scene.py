"""A bundle's 2D Gaussians, each with the body of the simulator that carries it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from registry import BundleError, SceneBundle
from registry.geometry import matrix_from_quat
from registry.plyfiles import read_vertices
from simrecon_envs.errors import SceneAssetsMissing
from simrecon_envs.scene_builder import Body

SIGMA_CUTOFF = 2.6  # standard deviations at which a splat ends, as in the fit
ALPHA_MIN = 1.0 / 255.0  # alpha below which a splat ends, as in the fit
_SH_C0 = 0.28209479177387814  # constant spherical harmonic: color = 0.5 + C0 * coefficient
_COLUMNS = (
    "x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "opacity", "f_dc_0", "f_dc_1", "f_dc_2",
    "instance_id",
)  # fmt: skip
UNOWNED = 0  # row of the body of Gaussians that belong to nothing


@dataclass(frozen=True)
class SplatScene:
    """Gaussians in world space as captured. Body 0 is no thing; bodies 1.. are `keys`, base entities first."""

    rows: np.ndarray  # float32 (n, 11) columns of `kernels`, metres
    colors: np.ndarray  # float32 (n, 3) sRGB values, 1 is white
    bodies: np.ndarray  # int32 (n,) row of the carrying body
    keys: tuple[int, ...]  # ids of base entities and of the bodies' root objects
    world_from_body: np.ndarray  # float64 (1 + keys, 4, 4) as captured


def read_splats(bundle: SceneBundle, bodies: Sequence[Body]) -> SplatScene:
    """Read the Gaussians of a bundle and assign them to bodies by `instance_id`.

    Args:
        bundle: A scene.
        bodies: Of `scene_builder.bodies_of`; objects that are welded to another belong to its body.

    Raises:
        SceneAssetsMissing: The bundle has no Gaussians, or they have no instance ids.
    """
    scene_id = bundle.scene["id"]
    entry = bundle.scene.get("gaussians")
    advice = f"make the scene again with `simrecon reconstruct VIDEO --scene {scene_id}`, or use renderer='mesh'"
    if entry is None:
        raise SceneAssetsMissing(
            f"scene {scene_id}: renderer='splats' needs the file gaussians.ply, which this bundle does not have; {advice}"
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
    world_from_body = [np.eye(4)] * (1 + len(base)) + [body.world_from_root for body in bodies]
    keys = (*base, *(body.root for body in bodies))
    return _pack(found, row_of, keys, np.array(world_from_body))


def _pack(
    found: dict[str, np.ndarray], row_of: dict[int, int], keys: tuple[int, ...], world_from_body: np.ndarray
) -> SplatScene:
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


def _unit(quats: np.ndarray) -> np.ndarray:
    return quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
