"""Write an A4 sheet with one marker at true size, as PDF (vectors) or PNG (with its resolution as metadata)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reconstruction.world.markers import printed_cells
from registry.errors import UsageError

_PAGE_M = (0.210, 0.297)
_POINT_M = 0.0254 / 72
_PRINTER_MARGIN_M = 0.006
_LEAST_SIDE_M = 0.02
_PIXELS_PER_M = 11_811  # 300 dots per inch


@dataclass(frozen=True)
class MarkerSheet:
    """A marker to print."""

    dictionary: str  # name of cv2.aruco
    id: int
    side_m: float  # of the black square

    def __post_init__(self) -> None:
        """Check that the marker and its white border fit the page."""
        cells = len(printed_cells(self.dictionary, self.id))
        largest = (_PAGE_M[0] - 2 * _PRINTER_MARGIN_M) / (1 + 2 / cells)
        if not _LEAST_SIDE_M <= self.side_m <= largest:
            raise UsageError(
                f"a marker of {self.side_m:g} m: an A4 sheet takes {_LEAST_SIDE_M:g} to {largest:.3f} m "
                "(side of the black square; a white border must fit around it)"
            )

    @property
    def caption(self) -> tuple[str, str]:
        """Return the two lines of text below the marker."""
        name = self.dictionary.removeprefix("DICT_").replace("APRILTAG_", "AprilTag ")
        return (
            f"{name}, id {self.id}. Print at 100 %, then measure: the black square is {1000 * self.side_m:.1f} mm.",
            f"simrecon reconstruct VIDEO --marker-size {self.side_m:g}   (or the side that you measured, in metres)",
        )

    def black_cells(self) -> list[tuple[float, float, float]]:
        """Return (x, y, width) of every black cell, in metres from the page's lower left corner."""
        cells = printed_cells(self.dictionary, self.id)
        size, n = self.side_m / len(cells), len(cells)
        left, top = (_PAGE_M[0] - self.side_m) / 2, (_PAGE_M[1] + self.side_m) / 2
        return [
            (left + x * size, top - (y + 1) * size, size)
            for y in range(n)
            for x in range(n)
            if cells[y, x] == 0
        ]


def write_marker(sheet: MarkerSheet, file: Path) -> None:
    """Write the sheet as PDF or PNG, by the file's suffix.

    Raises:
        UsageError: another suffix, or the folder does not exist.
    """
    writers = {".pdf": _write_pdf, ".png": _write_png}
    if file.suffix.lower() not in writers:
        raise UsageError(f"{file}: a marker is written as .pdf or .png")
    if not file.parent.is_dir():
        raise UsageError(f"{file}: the folder {file.parent} does not exist")
    writers[file.suffix.lower()](sheet, file)


def _write_pdf(sheet: MarkerSheet, file: Path) -> None:
    commands = ["0 g"]
    for x, y, size in sheet.black_cells():
        commands.append(
            f"{x / _POINT_M:.5f} {y / _POINT_M:.5f} {size / _POINT_M:.5f} {size / _POINT_M:.5f} re"
        )
    commands.append("f")
    below = (_PAGE_M[1] - sheet.side_m) / 2 / _POINT_M
    for n, line in enumerate(sheet.caption):
        text = line.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        commands.append(f"BT /F1 9 Tf 60 {max(below - 60 - 14 * n, 30 - 14 * n):.2f} Td ({text}) Tj ET")
    stream = "\n".join(commands).encode("ascii")
    width, height = (m / _POINT_M for m in _PAGE_M)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.3f} {height:.3f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, places = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, start=1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    head = b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    tail = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, len(out))
    file.write_bytes(out + head + table + tail)


def _write_png(sheet: MarkerSheet, file: Path) -> None:
    import cv2
    from PIL import Image

    cells = printed_cells(sheet.dictionary, sheet.id)
    # Whole pixels per cell; the resolution makes up for the rounding.
    cell_px = round(sheet.side_m * _PIXELS_PER_M / len(cells))
    per_m = cell_px * len(cells) / sheet.side_m
    page = np.full((round(_PAGE_M[1] * per_m), round(_PAGE_M[0] * per_m)), 255, np.uint8)
    square = cells.repeat(cell_px, 0).repeat(cell_px, 1)
    top, left = (page.shape[0] - len(square)) // 2, (page.shape[1] - len(square)) // 2
    page[top : top + len(square), left : left + len(square)] = square
    line_px = 0.005 * per_m
    for n, line in enumerate(sheet.caption):
        x, y = round(0.02 * per_m), round(top + len(square) + (4 + 1.4 * n) * line_px)
        at = (x, min(y, page.shape[0] - 20))
        cv2.putText(page, line, at, cv2.FONT_HERSHEY_SIMPLEX, line_px / 60, 0, 2, cv2.LINE_AA)
    Image.fromarray(page).save(file, dpi=(per_m * 0.0254, per_m * 0.0254))
