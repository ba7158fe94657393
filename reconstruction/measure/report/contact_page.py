"""Write the contact sheets of a scene: images, an HTML page that converts clicks to anchors, an overrides template."""

import html
import json
from pathlib import Path

import cv2
import numpy as np

from reconstruction.measure.report import drawing
from reconstruction.measure.report.contact_sheet import (
    FRAME_PX,
    ContactSheet,
    anchor_text,
    crops_sheet,
    frame_sheet,
)

_STYLE = """body{font:15px/1.5 system-ui,sans-serif;margin:24px auto;max-width:1500px;padding:0 16px;color:#1c1f24}
img{max-width:100%;height:auto;border:1px solid #dfe2e7;margin:6px 0;cursor:crosshair}
td,th{padding:2px 14px 2px 0;text-align:left}code{background:#f1f3f5;padding:1px 5px;border-radius:4px;cursor:copy}
#said{position:sticky;top:0;background:#fff;padding:8px 0;border-bottom:1px solid #dfe2e7;min-height:1.6em}
i{display:inline-block;width:11px;height:11px;border-radius:3px;margin-right:7px}"""

_SCRIPT = """const video = %s, said = document.querySelector('#said code');
function say(text) {
  said.textContent = text;
  if (navigator.clipboard) navigator.clipboard.writeText(text).catch(() => {});
}
for (const image of document.querySelectorAll('img[data-frame]')) image.addEventListener('click', event => {
  const k = image.naturalWidth / image.clientWidth;
  const x = event.offsetX * k / image.dataset.width, y = event.offsetY * k / image.dataset.height;
  const [u, v] = [(x * video[0]).toFixed(1), (y * video[1]).toFixed(1)];
  if (x <= 1 && y <= 1) say(`pixel: {frame: ${image.dataset.frame}, x: ${u}, y: ${v}}`);
});
for (const code of document.querySelectorAll('td code')) code.addEventListener('click', () => say(code.textContent));
"""


def write_contact_sheets(sheet: ContactSheet, folder: Path) -> list[Path]:
    """Write `frame_NNNNN.jpg` per frame, `things.jpg` and `index.html`; return their paths. Deterministic."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    pictures = [(f"frame_{frame.index:05d}.jpg", frame_sheet(sheet, frame)) for frame in sheet.frames]
    for name, picture in [*pictures, ("things.jpg", crops_sheet(sheet))]:
        written.append(folder / name)
        save_picture(picture, written[-1])
    written.append(folder / "index.html")
    written[-1].write_text(_page(sheet), encoding="utf-8")
    return written


def save_picture(picture: np.ndarray, path: Path, quality: int = 84) -> None:
    """Write uint8 RGB (h, w, 3) as a JPEG."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    path.write_bytes(cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), flags)[1].tobytes())


def _page(sheet: ContactSheet) -> str:
    source, name = sheet.scene["source"], html.escape(sheet.scene["id"])
    rows = []
    for number, item in sheet.objects.items():
        chip = f'<i style="background:{drawing.css_color(sheet.colors[number])}"></i>'
        cells = [f"{chip}{number}", *(html.escape(word) for word in sheet.facts(number))]
        cells.append(f"<code>{html.escape(anchor_text(item))}</code>")
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    frames = []
    for frame in sheet.frames:
        scale = FRAME_PX / max(frame.image.shape[:2])
        height, width = (round(side * scale) for side in frame.image.shape[:2])
        frames.append(
            f'<img src="frame_{frame.index:05d}.jpg" alt="things in frame {frame.index}" '
            f'data-frame="{frame.index}" data-width="{width}" data-height="{height}">'
        )
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{name}: things</title><style>{_STYLE}</style>'
        f"<h1>{name}: {len(rows)} things</h1><p>Click on an object in a frame, or on an anchor, to copy the anchor. "
        f"Paste it into a file for <code>simrecon reconstruct --overrides</code>.</p>"
        f'<div id="said"><code>pixel: …</code></div><table><tr><th>id<th>label<th>sure<th>size<th>held<th>anchor</tr>'
        f"{''.join(rows)}</table>{''.join(frames)}"
        f'<img src="things.jpg" alt="every thing for itself">'
        f"<script>{_SCRIPT % json.dumps([source['width'], source['height']])}</script></html>\n"
    )


def overrides_template(sheet: ContactSheet) -> str:
    """Return the text of an overrides file with one commented line per object."""
    lines = [
        f"# Corrections of {sheet.scene['id']}. Uncomment and edit lines, then run the same `simrecon reconstruct`",
        "# command again with --overrides and this file. All options: docs/overrides.md.",
        "# Anchors are pixels of video frames: they stay valid with other options, presets and scales.",
        "#",
        "# - {pixel: ..., relabel: mug}            # or drop: true, make_base: wall, mass_kg: 0.3, material: ceramic",
        "# - merge: [{pixel: ...}, {pixel: ...}]   # two instances that are one object",
        "# - split: [{pixel: ...}, {pixel: ...}]   # one instance that is two objects, a pixel on each",
        "# - {pixel: ..., parent: {pixel: ...}}    # stands on another object",
        "",
    ]
    for number, item in sheet.objects.items():
        label, confidence, size, held = sheet.facts(number)
        lines.append(f"# {number}: {label}{f' ({confidence})' if confidence else ''}, {size}, {held}")
        lines.append(f"# - {{{anchor_text(item)}, relabel: {json.dumps(item['label'])}}}")
    return "\n".join(lines) + "\n"
