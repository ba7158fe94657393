"""A rollout in the page: the robot's meshes, poses at a time, and plots of reward and contacts."""

import time
from typing import TYPE_CHECKING, Any

import numpy as np
import viser
import viser.uplot

from registry.geometry import matrix_from_quat, rigid
from studio.playing.rollout import CONTACTS, RolloutFrame, RolloutHead
from studio.text import plain_markdown

if TYPE_CHECKING:
    from studio.scene_view import StudioPage

_PLOT_EVERY_S = 1.0  # while steps arrive
_PLOT_PX = 160
_REWARD, _TARGET, _OTHERS = "#266e8e", "#c2571a", "#7a7a7a"


class RolloutView:
    """Shows the steps of a rollout that have been received so far."""

    def __init__(self, page: "StudioPage", head: RolloutHead, plots: viser.GuiFolderHandle) -> None:
        """Add the robot to the scene, and the plots to a folder of the panel."""
        self.head = head
        self._page = page
        self._frames: list[RolloutFrame] = []
        self._plotted_at = 0.0
        self._shown: tuple[np.ndarray, np.ndarray] | None = None
        scene = page.server.scene
        self._root = scene.add_frame("/rollout", show_axes=False)
        self._links = []
        for name, parts in zip(head.link_names, head.link_parts):
            self._links.append(scene.add_frame(f"/rollout/{name}", show_axes=False))
            for number, part in enumerate(parts):
                scene.add_mesh_simple(
                    f"/rollout/{name}/{number}", part.vertices, part.faces, color=part.color, flat_shading=False,
                    side="double", cast_shadow=False, receive_shadow=False,
                )  # fmt: skip
        if head.pedestal is not None:
            box = head.pedestal
            scene.add_mesh_simple(
                "/rollout/pedestal", box.vertices, box.faces, color=box.color, cast_shadow=False
            )
        with plots:
            self._plots = self._make_plots()

    @property
    def count(self) -> int:
        """Number of states, that of the reset included."""
        return len(self._frames)

    @property
    def last_s(self) -> float:
        """Time of the last state, seconds."""
        return max(len(self._frames) - 1, 0) / self.head.fps

    def add(self, frame: RolloutFrame) -> None:
        """Append a state."""
        self._frames.append(frame)
        if time.monotonic() - self._plotted_at > _PLOT_EVERY_S:
            self._plot()

    def finish(self) -> None:
        """Draw the plots of all states."""
        self._plot()

    def step_at(self, time_s: float) -> int:
        """Return the number of the last step at a time."""
        return min(int(time_s * self.head.fps + 1e-6), max(len(self._frames) - 1, 0))

    def show(self, time_s: float) -> None:
        """Move objects and links to where they are at a time, between the two nearest states; send what moves."""
        if not self._frames:
            return
        at = time_s * self.head.fps
        first = self.step_at(time_s)
        second = min(first + 1, len(self._frames) - 1)
        share = float(np.clip(at - first, 0.0, 1.0))
        a, b = self._frames[first], self._frames[second]
        objects, links = (
            _between(a.object_poses, b.object_poses, share),
            _between(a.link_poses, b.link_poses, share),
        )
        with self._page.server.atomic():
            for row, key in enumerate(self.head.object_ids):
                if self._shown is None or not np.array_equal(objects[row], self._shown[0][row]):
                    rotation = matrix_from_quat(objects[row, 3:].astype(np.float64))
                    self._page.set_pose(key, rigid(rotation, objects[row, :3].astype(np.float64)))
            for row, link in enumerate(self._links):
                link.position, link.wxyz = links[row, :3], links[row, 3:]
        self._shown = objects, links

    def text_at(self, step: int) -> str:
        """Return Markdown about the rollout and one step."""
        head = self.head
        lines = [f"**{plain_markdown(head.title)}**", plain_markdown(head.instruction)]
        if self._frames:
            frame = self._frames[step]
            so_far = sum(f.reward for f in self._frames[: step + 1])
            values = f"step {step} ({step / head.fps:.2f} s): reward {frame.reward:.2f}, sum {so_far:.1f}"
            if head.has_contacts:
                values += f"; contacts {frame.contacts_n[0]:.0f} N on the target, {frame.contacts_n[1]:.0f} N on others"
            lines.append(f"{values}. **success**" if frame.success else values)
        if head.note:
            lines.append(plain_markdown(head.note))
        return "\n\n".join(line for line in lines if line)

    def close(self) -> None:
        """Remove the robot and the plots."""
        for plot in self._plots:
            plot.remove()
        self._root.remove()

    # ---- Plots.

    def _make_plots(self) -> list[Any]:
        series = viser.uplot.Series
        axes = (viser.uplot.Axis(size=32), viser.uplot.Axis(size=40))
        common: dict[str, Any] = {
            "scales": {"x": viser.uplot.Scale(time=False), "y": viser.uplot.Scale(auto=True)},
            "axes": axes,
            "height": _PLOT_PX,
            "legend": viser.uplot.Legend(show=True),
        }
        empty = np.zeros(1)
        gui = self._page.server.gui
        time_s = series(label="s")
        plots = [
            gui.add_uplot(
                (empty, empty),
                (time_s, series(label="reward", stroke=_REWARD, width=2)),
                title="Reward",
                **common,
            )
        ]
        if self.head.has_contacts:
            both = (
                time_s,
                series(label=CONTACTS[0], stroke=_TARGET, width=2),
                series(label=CONTACTS[1], stroke=_OTHERS, width=1),
            )
            plots.append(
                gui.add_uplot((empty, empty, empty), both, title="Contact forces of the robot", **common)
            )
        return plots

    def _plot(self) -> None:
        self._plotted_at = time.monotonic()
        frames = self._frames or [RolloutFrame(np.zeros((0, 7)), np.zeros((0, 7)), 0.0, False, (0.0, 0.0))]
        times = np.arange(len(frames)) / self.head.fps
        self._plots[0].data = (times, np.array([frame.reward for frame in frames], np.float64))
        if self.head.has_contacts:
            forces = np.array([frame.contacts_n for frame in frames], np.float64)
            self._plots[1].data = (times, forces[:, 0].copy(), forces[:, 1].copy())


def _between(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """Return poses (n, 7) between two: positions linear, quaternions normalized linear on the shorter way."""
    if share == 0.0:
        return a
    sign = np.where(np.einsum("ij,ij->i", a[:, 3:], b[:, 3:]) < 0, -1.0, 1.0)[:, None]
    out = (1 - share) * a + share * np.concatenate([b[:, :3], sign * b[:, 3:]], axis=1)
    out[:, 3:] /= np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
    same = (a == b).all(axis=1)
    out[same] = a[same]
    return out
