"""Outlines drawn by hand as a section of the report: figures, a table of things, outlines over the scene's ids."""

import cv2
import numpy as np

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

_WIDTH_PX = 640
_FOUND, _MISSED, _IGNORED = (22, 138, 64), (214, 40, 57), (120, 124, 130)
_SUBPIXEL_BITS = 4
_HEADLINE = (
    ("outline_recall_25", "things found, IoU 0.25"),
    ("outline_recall_50", "things found, IoU 0.5"),
    ("outline_precision_25", "objects that are things, IoU 0.25"),
    ("outline_precision_50", "objects that are things, IoU 0.5"),
    ("outline_edges", "right parents"),
)


def outline_section(g: Gathered) -> Section | None:
    """Return recall, precision, the things, and each labelled frame; None where there are no labels."""
    if g.outlines is None:
        return None
    metrics = g.outlines.metrics
    tiles = [Tile(f"{metrics[key]:.0%}", text) for key, text in _HEADLINE if metrics[key] is not None]
    blocks: list[Block] = [Tiles(tiles, columns=5)]
    blocks.append(Pictures([_view(g, view) for view in g.outlines.views], 2, phone_columns=1))
    blocks.append(
        Text(
            "Lines were drawn by hand: green things were found, red ones missed, gray is not judged. "
            "Areas and numbers are the objects of the scene at the same camera."
        )
    )
    for index in g.outlines.without_camera:
        blocks.append(left_out(f"Frame {index}", "the scene has no camera of it"))
    blocks.append(_things(g))
    extra = [f"{item['label']} {item['id']}" for item in g.outlines.extra]
    if extra:
        blocks.append(Text(f"Objects in these frames that match no outlined thing: {', '.join(extra)}."))
    return Section("outlines", "Against outlines drawn by hand", blocks, short="Outlines")


def _things(g: Gathered) -> Table:
    rows = []
    for item in g.outlines.things:
        match, right = item["match"], item["parent_right"]
        status = "" if right is None else "good" if right else "bad"
        rows.append(
            [
                Cell(item["name"].replace("_", " ")),
                Cell("missed", "bad")
                if match is None
                else Cell(g.names[match], swatch=drawing.css_color(g.colors[match])),
                Cell(f"{item['iou']:.2f}", "" if item["found_50"] else "warn"),
                Cell((item["parent"] or "–").replace("_", " "), status),
            ]
        )
    return Table(["thing", "found as", "IoU", "parent"], rows, numeric=[2])


def _view(g: Gathered, view: OutlineView) -> Picture:
    """Draw one labelled frame: the scene's ids as areas, the outlines as lines over them."""
    frame = view.frame
    image, what = _image(g, frame.index)
    height = round(_WIDTH_PX * frame.height / frame.width)
    image = cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    drawn = np.array(drawing.outlined(image, view.shown, g.colors, tint=0.5, line_px=0))
    scale = np.array([_WIDTH_PX / frame.width, height / frame.height])
    found = {item["name"] for item in g.outlines.things if item["match"] is not None}
    asked = {item["name"] for item in g.outlines.things}
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
    """Return a frame as filmed, or the scene at its camera where the frames are gone; and what it is."""
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
