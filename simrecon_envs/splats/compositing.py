"""Put Gaussians before SAPIEN's picture of a scene's meshes, its robot and everything that was added.

SAPIEN's picture says for every pixel which actor it shows and how far away that is. Color is the sum of the Gaussians
plus the light that they let through times the picture's color. Three kinds of pixels differ in which Gaussians count:

| the picture shows            | Gaussians that count                                          |
|------------------------------|---------------------------------------------------------------|
| nothing, or a base surface   | all                                                           |
| an object of the scene       | its own; others only before its mesh, with a margin           |
| the robot, or an added thing | those before it, fading out over 1 cm                         |
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from simrecon_envs.splats.kernels import DEPTH_SUM, LIGHT, RED_SUM, WX, WY, XC, YC, ZC, compiled
from simrecon_envs.splats.rasterizer import Drawn

NOTHING = np.float32(1e6)  # a depth behind everything, metres
# Depths that differ by less (relative, or in metres) are of one surface.
_AGREE, _AGREE_M = 0.02, 0.02
_MAX_MM = 32767.0


@dataclass(frozen=True)
class Actors:
    """For each segmentation id of SAPIEN: what it is. Unknown ids are robot and added things."""

    body: np.ndarray  # int32 (k,) row in `SplatScene.world_from_body`, -1 for robot and added things
    margin_m: np.ndarray  # float32 (k,) depth behind the actor's mesh at which other Gaussians end
    tint: np.ndarray  # float32 (k, 3) factor of the picture's color
    segmentation: np.ndarray  # int16 (b,) the reverse: segmentation id of each body, 0 for none


@dataclass(frozen=True)
class Picture:
    """Color, depth and segmentation images of one camera."""

    rgb: np.ndarray  # uint8 (h, w, 3)
    depth_mm: np.ndarray  # int16 (h, w), 0 is nothing
    segmentation: np.ndarray  # int16 (h, w), 0 is nothing


def limits_of(picture: Picture, actors: Actors) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth limit (m) and the body (h, w) of each pixel, as `Rasterizer.draw` takes them."""
    ids = picture.segmentation
    owners = actors.body[ids]
    limits = picture.depth_mm.astype(np.float32) * np.float32(1e-3) + actors.margin_m[ids]
    limits[ids == 0] = NOTHING
    return limits, owners


def composite(
    picture: Picture,
    actors: Actors,
    drawn: Drawn,
    bodies: np.ndarray,
    gain: np.ndarray,
    shade: Callable[[np.ndarray, np.ndarray], None] | None = None,
) -> Picture:
    """Return the picture with Gaussians before it.

    Args:
        picture: SAPIEN's.
        actors: What its ids are.
        drawn: The Gaussians, drawn with `limits_of` of the picture.
        bodies: int32 (n,) row of each Gaussian's body.
        gain: float32 (3,) factor of the colors of the scene, without robot and added things.
        shade: Darkens colors, float32 (h, w, 3), in place; called with them and the new depth, int16 (h, w) in mm.
    """
    height, width = picture.depth_mm.shape
    colors = np.empty((height, width, 3), np.float32)
    rgb = np.empty((height, width, 3), np.uint8)
    depth, ids = np.empty((height, width), np.int16), np.empty((height, width), np.int16)
    _composite(
        picture.rgb, picture.depth_mm, picture.segmentation, actors.body, actors.tint, actors.segmentation,
        drawn.planes, drawn.front, drawn.splats, bodies, gain, colors, depth, ids,
    )  # fmt: skip
    if shade is not None:
        shade(colors, depth)
    _soften(colors, picture.segmentation, actors.body, rgb)
    return Picture(rgb, depth, ids)


@compiled(nogil=True)
def _composite(
    mesh_rgb,
    mesh_mm,
    mesh_ids,
    body_of,
    tint_of,
    id_of,
    planes,
    front,
    splats,
    bodies,
    gain,
    colors,
    depth,
    ids,
):
    height, width = mesh_mm.shape
    for y in range(height):
        for x in range(width):
            key, light = mesh_ids[y, x], planes[LIGHT, y, x]
            added = body_of[key] < 0
            for c in range(3):
                behind = light * np.float32(mesh_rgb[y, x, c]) * np.float32(1 / 255)
                scale = np.float32(1.0) if added else tint_of[key, c] * gain[c]
                colors[y, x, c] = planes[RED_SUM + c, y, x] * gain[c] + behind * scale
            depth[y, x], ids[y, x] = mesh_mm[y, x], key
            index = front[y, x]
            if index < 0:
                continue
            s = splats[index]
            w = 1.0 + s[WX] * (x - s[XC]) + s[WY] * (y - s[YC])
            z = s[ZC] * min(max(1.0 / w if w > 0.0 else 1.1, 1 / 1.1), 1.1)
            expected = planes[DEPTH_SUM, y, x] / (np.float32(1.0) - light)
            if abs(expected - z) < _AGREE * z:
                z = expected
            depth[y, x] = np.int16(min(1000.0 * z + 0.5, _MAX_MM))
            behind_m = 1e-3 * mesh_mm[y, x]
            agree = key != 0 and abs(behind_m - z) < max(_AGREE_M, _AGREE * z)
            if not agree and id_of[bodies[index]] != 0:
                ids[y, x] = id_of[bodies[index]]


@compiled(nogil=True)
def _soften(colors, ids, body_of, rgb):
    """Write colors as bytes; smooth the outlines of robot and added things, which SAPIEN does not anti-alias."""
    height, width = ids.shape
    for y in range(height):
        for x in range(width):
            added, edge = body_of[ids[y, x]] < 0, False
            for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                v, u = min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)
                edge = edge or (body_of[ids[v, u]] < 0) != added
            for c in range(3):
                value = colors[y, x, c]
                if edge:
                    value *= np.float32(0.5)
                    for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                        v, u = min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)
                        value += np.float32(0.125) * colors[v, u, c]
                rgb[y, x, c] = np.uint8(
                    min(max(value, np.float32(0.0)), np.float32(1.0)) * np.float32(255.0) + 0.5
                )
