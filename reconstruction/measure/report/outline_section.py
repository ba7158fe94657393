"""Build the report's section on outlines drawn by hand: figures, a table, outlines over rendered object ids."""

import cv2
import numpy as np

from reconstruction.measure.outline_scores import OutlineScores
from reconstruction.measure.outline_views import OutlineView
from reconstruction.measure.report import drawing
from reconstruction.measure.report.blocks import (
    Block,
    Cell,
    Picture,
    Pictures,
    Section,
    Table,
    Text,
    Tile,
    Tiles,
    left_out,
)
from reconstruction.measure.report.collect import Gathered
from reconstruction.measure.report.pictures import picture
from reconstruction.publish.preview import render_textured

_WIDTH_PX = 640  # of the images
_FOUND, _MISSED, _IGNORED = (22, 138, 64), (214, 40, 57), (120, 124, 130)
_SUBPIXEL_BITS = 4
_HEADLINE = (
    ("outline_recall_25", "outlined objects found, IoU 0.25"),
    ("outline_recall_50", "outlined objects found, IoU 0.5"),
    ("outline_precision_25", "objects that match an outline, IoU 0.25"),
    ("outline_precision_50", "objects that match an outline, IoU 0.5"),
    ("outline_edges", "right parents"),
)


def outline_section(g: Gathered) -> Section | None:
    """Return recall, precision, a table of outlined objects and each labelled frame; None without labels."""
    scores = g.outlines
    if scores is None:
        return None
    metrics = scores.metrics
    tiles = [Tile(f"{metrics[key]:.0%}", text) for key, text in _HEADLINE if metrics[key] is not None]
    blocks: list[Block] = [Tiles(tiles, columns=5)]
    blocks.append(Pictures([_view(g, scores, view) for view in scores.views], 2, phone_columns=1))
    blocks.append(
        Text(
            "Lines are the outlines drawn by hand: green is found, red is missed, gray is not evaluated. "
            "Areas and numbers are the objects of the scene at the same camera."
        )
    )
    blocks += [left_out(f"Frame {i}", "the scene has no camera for it") for i in scores.without_camera]
    blocks.append(_things(g, scores))
    extra = [f"{item['label']} {item['id']}" for item in scores.extra]
    if extra:
        blocks.append(Text(f"Objects in these frames that match no outline: {', '.join(extra)}."))
    return Section("outlines", "Against outlines drawn by hand", blocks, short="Outlines")


def _things(g: Gathered, scores: OutlineScores) -> Table:
    rows = []
    for item in scores.things:
        match, right = item["match"], item["parent_right"]
        status = "" if right is None else "good" if right else "bad"
        found = Cell("missed", "bad")
        if match is not None:
            found = Cell(g.names[match], swatch=drawing.css_color(g.colors[match]))
        rows.append(
            [
                Cell(item["name"].replace("_", " ")),
                found,
                Cell(f"{item['iou']:.2f}", "" if item["found_50"] else "warn"),
                Cell((item["parent"] or "–").replace("_", " "), status),
            ]
        )
    return Table(["thing", "found as", "IoU", "parent"], rows, numeric=[2])


def _view(g: Gathered, scores: OutlineScores, view: OutlineView) -> Picture:
    """Draw one labelled frame: rendered object ids as areas, outlines as lines."""
    frame = view.frame
    image, what = _image(g, frame.index)
    height = round(_WIDTH_PX * frame.height / frame.width)
    image = cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    drawn = np.array(drawing.outlined(image, view.shown, g.colors, tint=0.5, line_px=0))
    scale = np.array([_WIDTH_PX / frame.width, height / frame.height])
    found = {item["name"] for item in scores.things if item["match"] is not None}
    asked = {item["name"] for item in scores.things}
    lines = [(polygon, _IGNORED) for polygon in frame.ignored]
    for outline in frame.outlines:
        color = _IGNORED if outline.name not in asked else _FOUND if outline.name in found else _MISSED
        lines.append((outline.polygon, color))
    for thickness in (4, 2):
        for polygon, color in lines:
            pixels = ((polygon * scale - 0.5) * (1 << _SUBPIXEL_BITS)).round().astype(np.int32)
            shown = color if thickness == 2 else (255, 255, 255)
            cv2.polylines(drawn, [pixels], True, shown, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    missed = [o.name.replace("_", " ") for o in frame.outlines if o.name in asked - found]
    text = f"{what} {frame.index}" + (f"; missed: {', '.join(dict.fromkeys(missed))}" if missed else "")
    return picture(drawn, f"outlines over ids in frame {frame.index}", text)


def _image(g: Gathered, index: int) -> tuple[np.ndarray, str]:
    """Return a video frame, or the scene rendered at its camera if frames are missing; and a word for it."""
    frames = g.stages.get("frames")
    if frames is not None:
        for images, indices in (
            (frames.held_out_images, frames.held_out_indices),
            (frames.images, frames.indices),
        ):
            rows = np.flatnonzero(np.asarray(indices) == index)
            if len(rows):
                return np.asarray(images[rows[0]]), "frame"
    meshes = [(m.visual, m.world_from_mesh) for m in g.meshes]
    return render_textured(meshes, g.camera, g.poses[index])[0], "the scene at the camera of frame"
