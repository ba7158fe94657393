"""A carpenter's kit for furniture families: boxes, turned legs, cushions, draped cloth, wavy sheets, materials.

Shapes are drawn from their own stream of random numbers, so that the fine and the coarse version agree whatever
the textures draw. Curved surfaces have a fixed number of segments.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from synthetic import textures
from synthetic.furniture import Workshop
from synthetic.shapes import Solid, box, flipped, grid_patch, lathe, moved, shifted, signed_volume, tube
from synthetic.textures import Texture
from synthetic.things import PALETTE, Place, Thing, pick_color, prefixed

OVERLAP_M = 0.004  # how far parts reach into each other
Height = Callable[[np.ndarray, np.ndarray], np.ndarray]  # over x, y
_WOODS = ((176, 122, 74), (206, 178, 138), (120, 78, 46), (150, 108, 76), (196, 160, 110), (84, 62, 48))
_QUIET = ((232, 230, 224), (210, 206, 198), (170, 172, 174), (92, 94, 98), (50, 52, 56), (198, 184, 160))


class Carpenter:
    """Collects parts and looks of one thing."""

    def __init__(self, shop: Workshop, name: str) -> None:
        """Draw one number for all dimensions; the rest of the workshop's stream is for looks."""
        self.shop, self.name = shop, name
        self.dims = np.random.default_rng(int(shop.rng.integers(2**62)))
        self.parts: list[Solid] = []
        self.look: dict[str, Texture] = {}

    def between(self, low: float, high: float) -> float:
        """Draw a dimension."""
        return float(self.dims.uniform(low, high))

    def chance(self, share: float) -> bool:
        """Draw yes or no."""
        return bool(self.dims.random() < share)

    def count(self, low: int, high: int) -> int:
        """Draw a whole number, both ends included."""
        return int(self.dims.integers(low, high + 1))

    def tex(self, look: str) -> str:
        """Return the room-wide name of a texture."""
        return f"{self.name}{look}"

    def add(self, solid: Solid, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> None:
        """Add a closed part, turned around z and shifted."""
        if yaw:
            turn = np.eye(4)
            turn[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
            solid = moved(solid, turn)
        self.parts.append(shifted(solid, x, y, z))

    def box(
        self, size: Sequence[float], x: float = 0.0, y: float = 0.0, z: float = 0.0, look: str = "*",
        upright: bool = True, yaw: float = 0.0,
    ) -> None:  # fmt: skip
        """Add a box on its bottom centre."""
        number = len(self.parts)
        offset = (0.31 * number % 1.3, 0.17 * number % 0.9)
        step = max(self.shop.step_m, min(size) / 2)
        solid = box(tuple(map(float, size)), self.tex(look), step, offset, upright)
        self.add(solid, x, y, z, yaw)

    def printed(
        self, size: Sequence[float], faces: dict[str, str], x: float = 0.0, y: float = 0.0, z: float = 0.0
    ) -> None:
        """Add a box with another look per face."""
        named = {side: self.tex(look) for side, look in faces.items()}
        self.add(box(tuple(map(float, size)), named, self.shop.step_m), x, y, z)

    def turned(
        self, outline: Sequence[Sequence[float]], x: float = 0.0, y: float = 0.0, z: float = 0.0, look: str = "*",
        segments: int = 32, smooth: bool = False, stretch: tuple[float, float] = (1.0, 1.0), hang: bool = False,
    ) -> None:  # fmt: skip
        """Add a turned body; the outline runs from the axis at the bottom to the axis at the top.

        `hang` lays it down so that its axis points to -y, away from the wall.
        """
        points = np.asarray(outline, float)
        pieces = [points] if smooth else [points[i : i + 2] for i in range(len(points) - 1)]
        solid = lathe([(piece, self.tex(look)) for piece in pieces], self.shop.step_m, segments)
        if stretch != (1.0, 1.0):
            solid = stretched(solid, (*stretch, 1.0))
        if hang:
            tilt = np.eye(4)
            tilt[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
            solid = moved(solid, tilt)
        self.add(solid, x, y, z)

    def post(
        self, radius: float, height: float, x: float = 0.0, y: float = 0.0, z: float = 0.0, look: str = "leg"
    ) -> None:
        """Add a round post."""
        self.turned([[0, 0], [radius, 0], [radius, height], [0, height]], x, y, z, look, 16)

    def legs(
        self, width: float, depth: float, height: float, leg: float, inset: float, style: int, look: str = "leg"
    ) -> None:  # fmt: skip
        """Add four legs: square, round, tapered, or two panels."""
        x, y = width / 2 - inset - leg / 2, depth / 2 - inset - leg / 2
        high = height + OVERLAP_M
        for sx in (-1, 1):
            if style == 3:
                self.box((leg, depth - 2 * inset, high), sx * x, 0, 0, look)
                continue
            for sy in (-1, 1):
                if style == 0:
                    self.box((leg, leg, high), sx * x, sy * y, 0, look, upright=False)
                elif style == 1:
                    self.post(leg / 2, high, sx * x, sy * y, 0, look)
                else:
                    thin, wide = 0.3 * leg, 0.62 * leg
                    self.turned([[0, 0], [thin, 0], [wide, high], [0, high]], sx * x, sy * y, 0, look, 16)

    def handle(self, width: float, x: float, y: float, z: float, style: int, look: str = "knob") -> None:
        """Add a grip that sticks out towards -y from a front at `y`: bar, knob, bow, or none."""
        if style == 0:
            self.box((width, 0.012, 0.012), x, y - 0.022, z, look)
            for sign in (-1, 1):
                self.box((0.01, 0.024, 0.01), x + sign * 0.42 * width, y - 0.009, z + 0.001, look)
        elif style == 1:
            outline = [[0, 0], [0.007, 0], [0.007, 0.012], [0.015, 0.018], [0.011, 0.027], [0, 0.027]]
            self.turned(outline, x, y + 0.002, z, look, 12, hang=True)
        elif style == 2:
            angles = np.linspace(np.pi, 0, 9)
            path = np.column_stack([0.5 * width * np.cos(angles), np.zeros(9), 0.03 * np.sin(angles)])
            bow = tube(path, (0.005, 0.005), self.tex(look), 8)
            tilt = np.eye(4)
            tilt[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
            self.add(moved(bow, tilt), x, y + 0.002, z)

    def drawers(
        self, width: float, height: float, y: float, z: float, rows: int, columns: int, style: int, x: float = 0.0
    ) -> None:  # fmt: skip
        """Add a field of drawer fronts with grooves between them; they stand 14 mm out of the front at `y`."""
        gap, thick = 0.005, 0.018
        wide, high = width / columns - gap, height / rows - gap
        for row in range(rows):
            for column in range(columns):
                at = x + (column + 0.5) * width / columns - width / 2
                low = z + row * height / rows + gap / 2
                self.box((wide, thick, high), at, y + thick / 2 - 0.014, low, "front")
                grip = min(0.16, 0.5 * wide)
                self.handle(grip, at, y - 0.014, low + 0.62 * high, style)

    def doors(
        self, width: float, height: float, y: float, z: float, columns: int, style: int, panel: bool
    ) -> None:
        """Add doors side by side, plain or with a raised panel."""
        gap, thick = 0.005, 0.018
        wide = width / columns - gap
        for column in range(columns):
            x = (column + 0.5) * width / columns - width / 2
            self.box(
                (wide, thick, height - gap), x, y + thick / 2 - 0.014, z + gap / 2, "front", upright=False
            )
            if panel:
                low, rim = z + 0.06, 0.055
                size = (wide - 2 * rim, 0.01, height - 2 * 0.06)
                if min(size) > 0.005:
                    self.box(size, x, y - 0.015, low, "front", upright=False)
            side = 1 if column % 2 == 0 and columns > 1 else -1
            at = x + side * (0.5 * wide - 0.035)
            if style == 0:
                self.box((0.012, 0.026, 0.16), at, y - 0.026, z + 0.45 * height, "knob")
            else:
                self.handle(0.09, at, y - 0.014, z + 0.5 * height, 1)

    def finish(self, label: str, places: tuple[Place, ...] = ()) -> Thing:
        """Return the thing; its size is measured."""
        points = np.concatenate([p.vertices for part in self.parts for p in part])
        used = {p.texture for part in self.parts for p in part}
        look = {key: made for key, made in prefixed(self.name, self.look).items() if key in used}
        return Thing(label, self.parts, look, tuple(np.ptp(points, axis=0).tolist()), places=places)

    # Materials

    def wood(self, width: float = 1.0, height: float = 0.7, density: float = 520.0) -> Texture:
        """Wood or stained board."""
        rng = self.shop.rng
        rgb = self.shop.color(_WOODS[int(rng.integers(len(_WOODS)))], 0.1)
        return textures.wood(rng, width, height, density * self.shop.density, rgb)

    def paint(self, width: float = 0.6, height: float = 0.6) -> Texture:
        """Paint with little grain, quiet or bright."""
        rng = self.shop.rng
        tones = _QUIET if rng.random() < 0.6 else PALETTE
        rgb = self.shop.color(tones[int(rng.integers(len(tones)))], 0.1)
        if rng.random() < 0.35:
            return textures.plain(rgb)
        return textures.plaster(rng, width, height, 400 * self.shop.density, rgb, float(rng.uniform(1.5, 6)))

    def board(self, width: float = 1.0, height: float = 0.7) -> Texture:
        """Wood or paint."""
        return self.wood(width, height) if self.shop.rng.random() < 0.6 else self.paint()

    def metal(self) -> Texture:
        """Steel, chrome, black iron, brass."""
        rng = self.shop.rng
        tone = ((178, 180, 184), (206, 208, 210), (44, 44, 48), (176, 146, 84))[int(rng.integers(4))]
        return textures.plaster(rng, 0.3, 0.3, 300 * self.shop.density, self.shop.color(tone), 4)

    def cloth(self, width: float = 0.8, height: float = 0.8, rgb=None) -> Texture:
        """Woven cloth of a drawn pattern."""
        return fabric(
            self.shop.rng, width, height, 500 * self.shop.density, rgb or pick_color(self.shop, 0.2)
        )


def fabric(
    rng: np.random.Generator, width_m: float, height_m: float, density: float, rgb: tuple[float, float, float]
) -> Texture:
    """Cloth: plain weave, melange, stripes, checks or dots."""
    shape = max(8, round(height_m * density)), max(8, round(width_m * density))
    base = np.array(rgb, np.float32)
    if rng.random() < 0.4:  # quiet colours are common
        base = 0.35 * base + 0.65 * np.array(_QUIET[int(rng.integers(len(_QUIET)))], np.float32)
    other = np.clip(base * rng.uniform(0.5, 1.3, 3).astype(np.float32), 15, 245)
    image = np.broadcast_to(base, (*shape, 3)).copy()
    row, column = np.arange(shape[0]) / density, np.arange(shape[1]) / density
    pattern, pitch = int(rng.integers(6)), float(rng.uniform(0.02, 0.12))
    if pattern == 1:
        image[:, np.mod(column, pitch) < 0.4 * pitch] = other
    elif pattern == 2:
        bars = (np.mod(column, pitch) < 0.5 * pitch)[None].astype(np.float32)
        bars = bars + (np.mod(row, pitch) < 0.5 * pitch)[:, None]
        image += 0.5 * bars[..., None] * (other - base)
    elif pattern == 3:
        odd = np.floor(row / pitch) % 2
        x = np.mod(column[None] + 0.5 * pitch * odd[:, None], pitch) / pitch - 0.5
        y = np.mod(row, pitch)[:, None] / pitch - 0.5
        image[x**2 + y**2 < 0.06] = other
    elif pattern == 4:
        blotch = textures.octave_noise(rng, shape, (0.1 * density, 0.1 * density), 5, 0.8)
        image += 14 * blotch[..., None]
    weave = textures.octave_noise(rng, shape, (5, 5), 2, 0.9)
    image += float(rng.uniform(2, 7)) * weave[..., None]
    return Texture(np.clip(image, 0, 255).astype(np.uint8), width_m, height_m)


def stretched(solid: Solid, scale: tuple[float, float, float]) -> Solid:
    """Scale along the axes."""
    factor = np.array(scale)
    out = []
    for patch in solid:
        normals = patch.normals / factor
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        out.append(replace(patch, vertices=patch.vertices * factor, normals=normals))
    return tuple(out)


def welded(solid: Solid) -> Solid:
    """Give corners in the same place one normal, so that patches join without an edge in the shading."""
    points = np.concatenate([p.vertices for p in solid])
    normals = np.concatenate([p.normals for p in solid])
    _, index = np.unique(np.round(points, 7), axis=0, return_inverse=True)
    index = index.ravel()
    total = np.stack([np.bincount(index, normals[:, k]) for k in range(3)], -1)[index]
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    ends = np.cumsum([len(p.vertices) for p in solid])[:-1]
    return tuple(replace(p, normals=n) for p, n in zip(solid, np.split(total, ends)))


def cushion(
    size: tuple[float, float, float], texture: str, rounding: float = 0.35, puff: float = 0.15, pinch: float = 0.0,
    middle: int = 6,
) -> Solid:  # fmt: skip
    """A rounded block on its bottom centre.

    `rounding` is the radius of the edges over the smallest half size; `puff` lifts the middle of the top above its
    rim (the height is that of the middle); `pinch` draws the sides in between the corners, as a pillow's.
    """
    half = np.array(size) / 2
    radius = rounding * half.min()
    patches = []
    for axis in range(3):
        u, v = [k for k in range(3) if k != axis]
        su, sv = (_knots(half[k], radius, middle) for k in (u, v))
        for sign in (-1.0, 1.0):
            points = np.zeros((len(su), len(sv), 3))
            points[..., u], points[..., v], points[..., axis] = su[:, None], sv[None], sign * half[axis]
            uvs = points[..., [u, v]] + half[[u, v]]
            core = np.clip(points, -(half - radius), half - radius)
            away = points - core
            away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-12)
            points = core + radius * away
            x, y = points[..., 0] / half[0], points[..., 1] / half[1]
            dome = (1 - x**2) * (1 - y**2)
            up = points[..., 2] > 0
            points[..., 2] *= np.where(up, 1 - puff * (1 - dome), 1.0)
            if pinch:
                points[..., 0] *= 1 - pinch * (1 - y**2)
                points[..., 1] *= 1 - pinch * (1 - x**2)
            points[..., 2] += half[2]
            turn = sign > 0 if axis != 1 else sign < 0
            patch = grid_patch(points if turn else points[:, ::-1], uvs if turn else uvs[:, ::-1], texture)
            patches.append(patch)
    solid = tuple(patches)
    return welded(solid if signed_volume(solid) > 0 else tuple(flipped(p) for p in solid))


def _knots(half: float, radius: float, middle: int) -> np.ndarray:
    """Return grid lines that are dense along the rounded edges; the middle is always among them."""
    edge = half - radius * (1 - np.tan(np.linspace(0, np.pi / 4, 3)))[:-1]
    inner = np.linspace(0, half - radius, middle // 2 + 1)[:-1]
    right = np.concatenate([inner, edge, [half]])
    return np.concatenate([-right[:0:-1], right])


def cushion_sag(size: tuple[float, float, float], puff: float) -> Height:
    """Return the height of a cushion's top over the height of its middle."""

    def sag(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        dome = (1 - (2 * x / size[0]) ** 2) * (1 - (2 * y / size[1]) ** 2)
        return -0.5 * size[2] * puff * (1 - dome)

    return sag


def slab(front: np.ndarray, back: np.ndarray, texture: str, uvs: np.ndarray) -> Solid:
    """Close the space between two grids (r, c, 3) of the same size with strips along their four sides."""
    patches = [grid_patch(front, uvs, texture), grid_patch(back[:, ::-1], uvs[:, ::-1], texture)]
    for a, b, uv in (
        (front[:, 0], back[:, 0], uvs[:, 0]),
        (front[-1], back[-1], uvs[-1]),
        (back[:, -1], front[:, -1], uvs[:, -1]),
        (back[0], front[0], uvs[0]),
    ):
        patches.append(grid_patch(np.stack([a, b]), np.stack([uv, uv + 0.01]), texture))
    solid = tuple(patches)
    return solid if signed_volume(solid) > 0 else tuple(flipped(p) for p in solid)


def waves(dims: np.random.Generator, amplitude: float, scale_m: float, count: int = 7) -> Height:
    """Return a smooth random height field between 0 and about `amplitude`, folds about `scale_m` wide."""
    angle, phase = dims.uniform(0, np.pi, count), dims.uniform(0, 2 * np.pi, count)
    length = scale_m * dims.uniform(0.7, 2.2, count)
    weight = dims.uniform(0.3, 1.0, count)
    weight /= weight.sum()

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = np.asarray(x, float)[..., None], np.asarray(y, float)[..., None]
        along = x * np.cos(angle) + y * np.sin(angle)
        total = (weight * np.sin(2 * np.pi * along / length + phase)).sum(-1)
        return amplitude * np.clip(0.5 + 1.3 * total, 0.02, 1.0)

    return height


def rounded_outline(width: float, depth: float, radius: float, corners: int = 96) -> np.ndarray:
    """Return a rounded rectangle (corners, 2), counter-clockwise, its points evenly spread along it."""
    hx, hy = width / 2 - radius, depth / 2 - radius
    arcs = []
    for cx, cy, start in ((hx, hy, 0.0), (-hx, hy, 0.5), (-hx, -hy, 1.0), (hx, -hy, 1.5)):
        a = np.pi * (start + np.linspace(0, 0.5, 9))
        arcs.append(np.column_stack([cx + radius * np.cos(a), cy + radius * np.sin(a)]))
    line = np.concatenate([*arcs, arcs[0][:1]])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0, length[-1], corners + 1)[:-1]
    return np.column_stack([np.interp(at, length, line[:, k]) for k in (0, 1)])


def draped(
    outline: np.ndarray, drop: float, texture: str, top: Height | None = None, fold: float = 0.012, folds: int = 14,
    flare: float = 0.02, phase: float = 0.0, thickness: float = 0.004, under: float | None = None,
) -> Solid:  # fmt: skip
    """A cloth that lies on an outline (k, 2) at z = 0 and hangs over its edge by `drop`, in folds.

    `top` lifts what lies, `under` is the depth of its lower side (it may sink into what carries it).
    """
    closed = np.concatenate([outline, outline[:1]])
    step = np.roll(outline, -1, axis=0) - np.roll(outline, 1, axis=0)
    normal = np.column_stack([step[:, 1], -step[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.concatenate([normal, normal[:1]])
    turn = np.linspace(0, 2 * np.pi, len(closed))
    rows_in = np.linspace(0, 1, 13)
    rows_down = np.linspace(0, 1, 8)[1:]
    ripple = np.sin(folds * turn + phase + 0.7 * np.sin(3 * turn + phase))
    lift = top or (lambda x, y: np.zeros(np.shape(x)))
    outer, inner = [], []
    thick = thickness if under is None else under
    for share in rows_in:
        flat = share * closed
        rim = 1 - share**8
        z = lift(flat[:, 0], flat[:, 1]) * rim
        outer.append(np.column_stack([flat, z]))
        inner.append(
            np.column_stack([flat * (1 - thickness / np.abs(outline).max()), np.full(len(flat), -thick)])
        )
    for share in rows_down:
        out = 0.004 + flare * share + fold * share**0.7 * (1 + ripple)
        edge = closed + normal * out[:, None]
        z = np.full(len(closed), -drop * share)
        outer.append(np.column_stack([edge, z]))
        inner.append(np.column_stack([edge - normal * thickness, np.minimum(z, -thick)]))
    points, back = np.stack(outer), np.stack(inner)
    inches = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=2).max(1))])
    around = np.linspace(0, np.linalg.norm(np.diff(closed, axis=0), axis=1).sum(), len(closed))
    uvs = np.stack(np.broadcast_arrays(around[None], inches[:, None]), -1)
    uvs[:13] = points[:13, :, :2]
    rim = np.stack([points[-1], back[-1]])
    solid = (
        grid_patch(points, uvs, texture),
        grid_patch(back[:, ::-1], uvs[:, ::-1], texture),
        grid_patch(rim, np.stack([uvs[-1], uvs[-1] + 0.004]), texture),
    )
    return solid if signed_volume(solid) > 0 else tuple(flipped(p) for p in solid)
