"""A ruler of one metre on the floor, with the uncertainty of the scene's scale as an error bar."""

from typing import Any

import numpy as np

from studio.layers.base import Layer
from studio.text import bare, plain

_INK, _ERROR = (45, 52, 60), (214, 104, 83)
_ABOVE_FLOOR_M, _GAP_M = 0.01, 0.2
_THICK_M, _TICK_M = 0.012, 0.05


class RulerLayer(Layer):
    """One metre in front of the objects, ticks every ten centimetres; the error bar is one standard deviation."""

    label = "Scale"
    hint = "One metre on the floor, and how sure it is"

    def build(self) -> list[Any]:
        """Add the ruler."""
        scene, scale = self.page.server.scene, self.page.bundle.scene["scale"]
        start, along, across = self._place()
        sigma = scale.get("uncertainty")

        def at(x: float, y: float) -> np.ndarray:
            return start + x * along + y * across

        ruler = [(at(0, 0), at(1, 0))]
        for tick in range(11):
            length = _TICK_M * (1.6 if tick in (0, 5, 10) else 0.8)
            ruler.append((at(tick / 10, 0), at(tick / 10, length)))
        nodes: list[Any] = [_lines(scene, "/layers/ruler/metre", ruler, _INK)]
        if sigma:
            low, high, row = 1 - sigma, 1 + sigma, -_TICK_M
            bar = [(at(low, row), at(high, row))]
            bar += [(at(x, row - _TICK_M / 2), at(x, row + _TICK_M / 2)) for x in (low, high)]
            nodes.append(_lines(scene, "/layers/ruler/error", bar, _ERROR))
        nodes.append(
            scene.add_label(
                "/layers/ruler/label",
                bare(scale_text(scale)),
                position=at(0.5, -2.2 * _TICK_M),
                anchor="top-center",
            )
        )
        return nodes

    def legend(self) -> str:
        """Say how the scale was found."""
        scale = self.page.bundle.scene["scale"]
        detail = scale.get("detail", "")
        return (
            f"Scale by {plain(scale['method'])}. {plain(detail)}"
            if detail
            else f"Scale by {plain(scale['method'])}."
        )

    def _place(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return start, direction and the direction of its ticks: on the side of the objects that the viewer is on."""
        corners = [self.page.pose_of(o.id)[:3, 3] for o in self.page.bundle.objects] or [np.zeros(3)]
        corners = np.array(corners)
        camera = self.page.server.initial_camera.position
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
        axis = int(np.argmax(np.abs((camera - middle)[:2])))  # towards the viewer: x or y
        side = np.sign((camera - middle)[axis]) or 1.0
        across, along = np.zeros(3), np.zeros(3)
        across[axis], along[1 - axis] = -side, 1.0
        edge = corners[:, axis].max() if side > 0 else corners[:, axis].min()
        start = np.zeros(3)
        reach = (
            max(0.25, *(o.scale[axis] / 2 for o in self.page.bundle.objects))
            if self.page.bundle.objects
            else 0.25
        )
        start[axis] = edge + side * (reach + _GAP_M)
        start[1 - axis] = middle[1 - axis] - 0.5
        start[2] = _ABOVE_FLOOR_M
        # Read from left to right by the viewer.
        if np.cross(along, across)[2] < 0:
            start[1 - axis] += 1.0
            along = -along
        return start, along, across


def scale_text(scale: dict) -> str:
    """Return the scale in words: "1 m ± 15 cm (camera-height-prior)"."""
    sigma = scale.get("uncertainty")
    if not sigma:
        return f"1 m, uncertainty unknown ({scale['method']})"
    length = f"{100 * sigma:.0f} cm" if sigma >= 0.01 else f"{1000 * sigma:.0f} mm"
    return f"1 m ± {length} ({scale['method']})"


def _lines(scene: Any, name: str, lines: list, color: tuple[int, int, int]) -> Any:
    points = np.array(lines, np.float32)
    return scene.add_line_segments(name, points, color, thickness=_THICK_M)
