"""Draw plots as inline SVG with matplotlib: camera path, scene graph, bars."""

import io
import re
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, MUTED, LINE, ACCENT = "#1d2330", "#6b7280", "#d5d9e0", "#2f6fde"
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text: selectable and in the page's font
    "text.parse_math": False,  # labels may contain dollar signs
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.edgecolor": LINE,
    "axes.labelcolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": INK,
    "text.color": INK,
}


def new_figure(width: float, height: float) -> "Figure":
    """Return a figure of this size in inches, without a window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def to_svg(figure: "Figure", name: str, title: str) -> str:
    """Render a figure as an SVG element without dates, with `name` as prefix of its ids."""
    import matplotlib

    out = io.StringIO()
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": name}):
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r'font: (?:[\w.]+ )?([\d.]+px)[^;"]*', r"font-size: \1", text)
    text = re.sub(r'(<(?:g|clipPath|path|defs) id=")', rf"\g<1>{name}-", text)
    text = re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", text)
    return re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', f'role="img" aria-label="{title}"', text, count=1)


def camera_path(
    positions: np.ndarray, forward: np.ndarray, is_keyframe: np.ndarray, size: tuple[int, int]
) -> str:
    """Draw the camera path as an overlay of a top view.

    Args:
        positions: (n, 2) in pixels of the view, in time order.
        forward: (n, 2) projected viewing directions, in pixels, at most unit length.
        is_keyframe: bool (n,); the others are held out.
        size: width and height of the view.
    """
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        figure = new_figure(size[0] / 100, size[1] / 100)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, size[0]), ylim=(size[1], 0))
        axes.axis("off")
        axes.plot(*positions.T, color="white", linewidth=4.5, solid_capstyle="round")
        axes.plot(*positions.T, color=ACCENT, linewidth=2, solid_capstyle="round")
        step = max(1, len(positions) // 24)
        reach = 0.055 * max(size)
        for start, ahead in zip(positions[::step], forward[::step]):
            axes.plot(*np.stack([start, start + reach * ahead]).T, color=ACCENT, linewidth=1, alpha=0.75)
        axes.scatter(*positions[is_keyframe].T, s=9, color=ACCENT, zorder=3)
        axes.scatter(
            *positions[~is_keyframe].T, s=9, color="white", edgecolors=ACCENT, linewidths=0.8, zorder=4
        )
        for place, text in ((positions[0], "start"), (positions[-1], "end")):
            axes.annotate(
                text, place, xytext=(0, 9), textcoords="offset points", ha="center", fontsize=11,
                fontweight="bold", color="white",
                bbox={"boxstyle": "round,pad=0.25", "facecolor": ACCENT, "edgecolor": "none"},
            )  # fmt: skip
        return to_svg(figure, "path", "the camera's path from above")


def bars(names: list[str], values: list[float], title: str, unit: str, color: str, name: str) -> str:
    """Draw one horizontal bar per name, with its value."""
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        figure = new_figure(3.6, 0.5 + 0.27 * len(names))
        axes = figure.add_axes((0.27, 0.02, 0.55, 0.98 - 0.36 / figure.get_figheight()))
        rows = np.arange(len(names))[::-1]
        axes.barh(rows, values, color=color, height=0.66)
        axes.set_yticks(rows, names)
        axes.tick_params(left=False, bottom=False, labelbottom=False)
        axes.set_xlim(0, max([*values, 1e-9]))
        axes.set_ylim(-0.6, len(names) - 0.4)
        for row, value in zip(rows, values):
            shown = f"{value:.0f}" if value >= 100 else f"{value:.1f}"
            axes.annotate(
                f"{shown} {unit}", (value, row), xytext=(4, 0), textcoords="offset points", va="center",
                color=MUTED, fontsize=9,
            )  # fmt: skip
        axes.spines[["top", "right", "bottom"]].set_visible(False)
        figure.text(0.27, 1 - 0.22 / figure.get_figheight(), title, fontweight="bold", va="center")
        return to_svg(figure, name, title)


def scene_graph(edges: list[dict[str, Any]], names: dict[int, str], colors: dict[int, str]) -> str:
    """Draw the forest of support and attachment relations, roots to the left."""
    import matplotlib
    from matplotlib.patches import FancyBboxPatch, PathPatch
    from matplotlib.path import Path as Curve

    places, depth = _tree_layout(edges, names)
    columns, rows = max(depth.values(), default=0) + 1, max((y for _, y in places.values()), default=0) + 1
    with matplotlib.rc_context(_STYLE):
        figure = new_figure(2.15 * columns, 0.36 * rows + 0.2)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(-0.12, columns - 0.1), ylim=(rows - 0.4, -0.6))
        axes.axis("off")
        for edge in edges:
            (x0, y0), (x1, y1) = places[edge["parent"]], places[edge["child"]]
            x0, middle = x0 + 0.62, (x0 + 0.62 + x1) / 2
            curve = Curve([(x0, y0), (middle, y0), (middle, y1), (x1, y1)], [1, 4, 4, 4])
            hangs = edge["relation"] == "attached_to"
            axes.add_patch(
                PathPatch(
                    curve, facecolor="none", edgecolor="#c2577a" if hangs else "#8a94a6", linewidth=1.4,
                    linestyle=(0, (3, 2)) if hangs else "-", alpha=0.4 + 0.6 * min(1.0, edge["confidence"]),
                )
            )  # fmt: skip
        for item, (x, y) in places.items():
            box = FancyBboxPatch(
                (x, y - 0.33), 0.62, 0.66, boxstyle="round,pad=0,rounding_size=0.09", mutation_aspect=3.5,
                facecolor="#ffffff", edgecolor=colors.get(item, "#9aa3b2"), linewidth=1.8,
            )  # fmt: skip
            axes.add_patch(box)
            axes.text(x + 0.31, y + 0.01, names[item], ha="center", va="center", fontsize=9.5)
        return to_svg(figure, "graph", "the scene graph")


def _tree_layout(
    edges: list[dict[str, Any]], names: dict[int, str]
) -> tuple[dict[int, tuple[float, float]], dict[int, int]]:
    """Lay out a forest: leaves on successive rows, parents centered on their children; return (x, y) and depths."""
    children: dict[int, list[int]] = {item: [] for item in names}
    for edge in sorted(edges, key=lambda e: e["child"]):
        children[edge["parent"]].append(edge["child"])
    roots = sorted(set(names) - {edge["child"] for edge in edges})
    places: dict[int, tuple[float, float]] = {}
    depth: dict[int, int] = {}
    rows = count()

    def place(item: int, level: int) -> float:
        depth[item] = level
        below = [place(child, level + 1) for child in children[item]]
        row = (below[0] + below[-1]) / 2 if below else next(rows)
        places[item] = (level, row)
        return row

    for root in roots:
        place(root, 0)
    return places, depth
