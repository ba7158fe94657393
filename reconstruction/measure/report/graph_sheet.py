"""Draw the steps of scene graph inference: per step the view, its local graph and the merged graph."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np
from PIL import Image, ImageDraw

from reconstruction.measure.report import drawing

_ROW_PX, _INDENT_PX, _TREE_PX, _VIEW_PX, _GAP_PX = 24, 26, 330, 560, 16
_INK, _FAINT = (28, 31, 36), (150, 156, 166)
_VERDICT_COLORS = {
    "new": (24, 138, 74), "conflict": (206, 40, 52), "replaced": (206, 40, 52), "loose": (214, 128, 16),
    "refused": (214, 128, 16),
}  # fmt: skip
_WORDS = {
    "region": "region of",
    "adjudication": "another look at the conflict of",
    "rest": "another look, because no view connects all of",
    "fallback": "decided without a view:",
}
Triple = tuple[int, str, int]  # child, relation, parent


def write_graph_steps(
    steps: Sequence[Mapping], names: Mapping[int, str], views: Sequence[np.ndarray | None], folder: Path
) -> list[Path]:
    """Write `step_01.png` and so on; return their paths. Deterministic.

    Args:
        steps: `graph.steps` of a bundle.
        names: name of each object and base surface by id.
        views: uint8 (h, w, 3) annotated view of each step; None without an image.
        folder: created if missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    before: set[Triple] = set()
    for number, (step, view) in enumerate(zip(steps, views, strict=True), start=1):
        merged = {_triple(edge) for edge in step["merged"]}
        title = f"step {number} of {len(steps)}: {_WORDS[step['kind']]} {_listed(step['about'])}"
        picture = draw_step(title, step, names, view, merged - before)
        written.append(folder / f"step_{number:02d}.png")
        Image.fromarray(picture).save(written[-1])
        before = merged
    return written


def draw_step(
    title: str, step: Mapping, names: Mapping[int, str], view: np.ndarray | None, changed: set[Triple]
) -> np.ndarray:
    """Draw one step: view, local graph, merged graph, and conflicts as text; uint8 (h, w, 3).

    Args:
        title: first line.
        step: entry of a bundle's `graph.steps`.
        names: by id.
        view: annotated view; may be None.
        changed: new edges of the merged graph.
    """
    verdicts = {_triple(d): d["verdict"] for d in step["decisions"]}
    said = [_triple(edge) for edge in step["said"]]
    local = draw_tree(said, names, {t: _VERDICT_COLORS.get(verdicts.get(t, ""), _INK) for t in said})
    merged = [_triple(edge) for edge in step["merged"]]
    whole = draw_tree(merged, names, {t: _VERDICT_COLORS["new"] if t in changed else _INK for t in merged})
    lines = [
        f"{d['child']} {d['relation'].replace('_', ' ')} {d['parent']}: {d['verdict']}"
        + (f" ({d['why']})" if d["why"] else "")
        for d in step["decisions"]
        if d["verdict"] not in ("new", "known", "kept")
    ]
    lines = [part for line in [*lines, *step["notes"]] for part in wrap(line, 60)]
    shown = drawing.fit_width(view, _VIEW_PX) if view is not None else _no_view()
    width = _VIEW_PX + 2 * _TREE_PX + 4 * _GAP_PX
    top = 3 * _GAP_PX + _ROW_PX
    left_column = shown.shape[0] + _GAP_PX + _ROW_PX * len(lines)
    height = top + max(left_column, local.shape[0], whole.shape[0]) + _GAP_PX
    image = Image.new("RGB", (width, height), (255, 255, 255))
    draw = ImageDraw.Draw(image)
    draw.text((_GAP_PX, _GAP_PX), title, font=drawing.font(17), fill=_INK)
    image.paste(Image.fromarray(shown), (_GAP_PX, top))
    for k, line in enumerate(lines):
        at = (_GAP_PX, top + shown.shape[0] + _GAP_PX + _ROW_PX * k)
        draw.text(at, line, font=drawing.font(13, ""), fill=_INK)
    for column, (words, tree) in enumerate((("graph of this view", local), ("merged graph", whole))):
        left = 2 * _GAP_PX + _VIEW_PX + column * (_TREE_PX + _GAP_PX)
        draw.text((left, 2 * _GAP_PX + 12), words, font=drawing.font(13, ""), fill=_FAINT)
        image.paste(Image.fromarray(tree), (left, top))
    return np.asarray(image)


def draw_tree(
    edges: Sequence[Triple], names: Mapping[int, str], colors: Mapping[Triple, tuple[int, int, int]]
) -> np.ndarray:
    """Draw a forest as an indented list, uint8 (h, w, 3); attachments are dashed."""
    children: dict[int, list[Triple]] = {}
    for edge in sorted(edges):
        children.setdefault(edge[2], []).append(edge)
    below = {edge[0] for edge in edges}
    rows: list[tuple[int, int, Triple | None, int]] = []  # id, depth, its edge, row of its parent

    def walk(node: int, depth: int, edge: Triple | None, parent_row: int) -> None:
        rows.append((node, depth, edge, parent_row))
        own = len(rows) - 1
        for child in children.get(node, []):
            walk(child[0], depth + 1, child, own)

    for root in sorted(set(children) - below):
        walk(root, 0, None, -1)
    image = Image.new("RGB", (_TREE_PX, max(_ROW_PX * len(rows), _ROW_PX)), (255, 255, 255))
    draw = ImageDraw.Draw(image)
    for row, (node, depth, edge, parent_row) in enumerate(rows):
        y, x = _ROW_PX * row + _ROW_PX // 2, _INDENT_PX * depth
        color = _INK if edge is None else colors.get(edge, _INK)
        if edge is not None:
            dash = 4 if edge[1] == "attached_to" else 0
            stem, start = x - _INDENT_PX + 10, _ROW_PX * parent_row + _ROW_PX - 3
            _line(draw, (stem, start), (stem, y), color, dash)
            _line(draw, (stem, y), (x - 2, y), color, dash)
        text = f"{node} {names.get(node, '')}"
        font = drawing.font(14, "Bold" if edge is None else "")
        draw.text((x + 2, y), text, font=font, fill=color, anchor="lm")
    return np.asarray(image)


def _line(
    draw: ImageDraw.ImageDraw,
    start: tuple[int, int],
    end: tuple[int, int],
    color: tuple[int, int, int],
    dash: int,
) -> None:
    """Draw a horizontal or vertical line, with dashes of `dash` pixels unless 0."""
    length = abs(end[0] - start[0]) + abs(end[1] - start[1])
    step = 2 * dash or max(length, 1)
    for at in range(0, max(length, 1), step):
        a, b = at / max(length, 1), min(at + (dash or length), length) / max(length, 1)
        points = [(start[0] + t * (end[0] - start[0]), start[1] + t * (end[1] - start[1])) for t in (a, b)]
        draw.line(points, fill=color, width=2)


def _no_view() -> np.ndarray:
    image = Image.new("RGB", (_VIEW_PX, 3 * _ROW_PX), (236, 238, 241))
    words = "no view of this step"
    ImageDraw.Draw(image).text((_GAP_PX, _ROW_PX), words, font=drawing.font(14, ""), fill=_FAINT)
    return np.asarray(image)


def _triple(edge: Mapping) -> Triple:
    return edge["child"], edge["relation"], edge["parent"]


def _listed(ids: Sequence[int]) -> str:
    text = ", ".join(map(str, ids[:24]))
    return text + (f" and {len(ids) - 24} more" if len(ids) > 24 else "")
