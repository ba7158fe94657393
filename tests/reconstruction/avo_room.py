"""A small room of Gaussians: a box on the floor, a panel that hides it from the input cameras, free space known."""

import numpy as np

from reconstruction.core.types import BaseEntity, Camera, InstanceSet, Plane, SpaceGrid, Surface
from reconstruction.gaussians.model import from_packed
from reconstruction.views import prepare_scene
from reconstruction.views.cameras import look_at
from registry.geometry import quat_from_matrix

FLOOR, BOX, PANEL, BALL = 1, 2, 3, 4
BOX_CENTER, BOX_SIDE = np.array([0.0, 0.3, 0.15]), 0.3
PANEL_Y, PANEL_WIDTH, PANEL_HEIGHT = -0.15, 0.5, 0.28
HALF_ROOM, HEIGHT, CELL = 1.5, 1.6, 0.05
CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
_SPACING = 0.03


def plate(center, u, v, normal, color):
    """Splats on a rectangle: half sides u and v (3,)."""
    u, v = np.asarray(u, float), np.asarray(v, float)
    nu, nv = (max(int(2 * np.linalg.norm(a) / _SPACING), 2) for a in (u, v))
    s, t = (np.linspace(-1 + 1 / n, 1 - 1 / n, n) for n in (nu, nv))
    means = np.asarray(center) + s[:, None, None] * u + t[None, :, None] * v
    axis = u / np.linalg.norm(u)
    rotation = np.stack([axis, np.cross(normal, axis), normal], axis=1)
    out = np.zeros((nu * nv, 13))
    out[:, :3] = means.reshape(-1, 3)
    out[:, 3:7] = quat_from_matrix(rotation)
    out[:, 7:9], out[:, 9] = np.log(0.6 * _SPACING), 3.0
    out[:, 10:] = (np.asarray(color) - 0.5) / 0.2820948
    return out


def box(center, side, color):
    """Splats on the five upper faces of a cube."""
    half, x, y, z = 0.5 * side, *np.eye(3)
    c = np.asarray(center)
    faces = [(x, y, z), (-x, y, z), (y, x, z), (-y, x, z), (z, x, y)]
    return np.concatenate([plate(c + half * n, half * u, half * v, n, color) for n, u, v in faces])


def room(with_panel=True):
    """Return the prepared scene."""
    parts = {FLOOR: plate([0, 0, 0], [HALF_ROOM, 0, 0], [0, HALF_ROOM, 0], [0, 0, 1], [0.6, 0.6, 0.6])}
    parts[BOX] = box(BOX_CENTER, BOX_SIDE, [0.9, 0.2, 0.2])
    parts[BALL] = box([0.7, 0.5, 0.06], 0.12, [0.2, 0.2, 0.9])
    if with_panel:
        parts[PANEL] = plate(
            [0, PANEL_Y, 0.5 * PANEL_HEIGHT], [0.5 * PANEL_WIDTH, 0, 0], [0, 0, 0.5 * PANEL_HEIGHT], [0, -1, 0],
            [0.2, 0.8, 0.2],
        )  # fmt: skip
    packed = np.concatenate(list(parts.values()))
    owner = np.repeat(list(parts), [len(p) for p in parts.values()]).astype(np.int32)
    eyes = [np.array([x, -1.3, 0.5]) for x in np.linspace(-0.3, 0.3, 5)]
    poses = np.stack([look_at(eye, BOX_CENTER, 80.0) for eye in eyes])
    vertices = packed[:, :3].astype(np.float32)
    zeros = np.zeros_like(vertices)
    surface = Surface(
        vertices,
        np.zeros((0, 3), np.int32),
        zeros,
        zeros.astype(np.uint8),
        zeros[:, 0],
        0.01,
        _space(vertices),
    )
    floor = BaseEntity(FLOOR, "floor", Plane(np.array([0, 0, 1.0, 0]), np.zeros((4, 3))), True)
    found = InstanceSet(owner, (floor,), (), np.zeros((0, 1, 1), np.uint16))
    return prepare_scene(from_packed(packed, world_from_camera=poses), surface, found, CAMERA)


def _space(vertices):
    """All of the room is free but what things fill."""
    shape = (int(2 * HALF_ROOM / CELL), int(2 * HALF_ROOM / CELL), int(HEIGHT / CELL))
    state = np.ones(shape, np.uint8)
    origin = np.array([-HALF_ROOM, -HALF_ROOM, 0.0])
    cell = np.floor((vertices - origin) / CELL).astype(int)
    cell = cell[((cell >= 0) & (cell < shape)).all(axis=1)]
    state[tuple(cell.T)] = 2
    centers = (
        np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1) * CELL + CELL / 2 + origin
    )
    inside = (np.abs(centers - BOX_CENTER) < 0.5 * BOX_SIDE).all(axis=-1)
    state[inside] = 0
    return SpaceGrid(origin, CELL, state)
