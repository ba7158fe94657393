"""The page of a check: verdicts, the frames that show the trouble, the map of directions in view."""

import cv2
import numpy as np

from reconstruction.measure.report.blocks import Block, Cell, Pictures, Section, Table
from reconstruction.measure.report.page import render_template
from reconstruction.measure.report.pictures import picture
from reconstruction.precheck.judge import FilmReport
from reconstruction.world.samples import choose_frames

_GRADES = {"pass": "good", "warn": "warn", "fail": "bad"}
_CELL_PX = 18


def check_page(report: FilmReport) -> str:
    """Return the report as one self-contained HTML page."""
    rows = [
        [Cell(x.status, _GRADES[x.status]), Cell(x.name), Cell(x.text), Cell(x.advice)] for x in report.lines
    ]
    title = "Unlikely to be reconstructed" if report.fails else "Fine to reconstruct"
    sections = [Section("verdict", title, [Table(["", "property", "measured", "advice"], rows)])]
    sections += [
        Section(line.name, line.name, [_frames(report, line.frames)], lead=line.text)
        for line in report.lines
        if line.status != "pass" and line.frames
    ]
    lead = "Frames that show each direction; the center is the first frame's view, above is up."
    sections.append(
        Section("directions", "Directions in view", [_map(report.measured.coverage.seen)], lead=lead)
    )
    every = choose_frames(len(report.film.images), 12)
    sections.append(Section("frames", "Frames", [_frames(report, tuple(every.tolist()))]))
    return render_template(
        "plain.html.j2", title="Check of a film", source=report.film.file, sections=sections
    )


def _frames(report: FilmReport, rows: tuple[int, ...]) -> Block:
    film = report.film
    return Pictures(
        [picture(film.images[r], f"frame at {film.names[r]}", film.names[r]) for r in rows], columns=4
    )


def _map(seen: np.ndarray) -> Block:
    level = (255 * np.minimum(seen / max(seen.max(), 1), 1) ** 0.5).astype(np.uint8)
    size = (seen.shape[1] * _CELL_PX, seen.shape[0] * _CELL_PX)
    large = cv2.resize(level, size, interpolation=cv2.INTER_NEAREST)
    image = cv2.cvtColor(cv2.applyColorMap(large, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    caption = "yaw from -180 to 180 degrees, pitch from 90 to -90; dark: not in view"
    return Pictures([picture(image, "map of directions in view", caption)], columns=1, phone_columns=1)
