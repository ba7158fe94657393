"""The page of the generation benchmark."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.avo_page import picture_lines, write_lines
from benchmarks.machine import machine_line
from benchmarks.table import table_lines

_HEAD = """# Generation benchmark

<!-- Written by `python -m benchmarks.generation`; run it again instead of changing this file. -->

What a view is worth to whoever completes an object from it ([views](avo.md), [generation](generation.md)), as in the
paper's Figures 4 and 6. For every half hidden object that stands on something in generated rooms, the first view of
each strategy, without what hides the object, goes through the client of Hunyuan3D's server; the mesh that comes back
is recorded, replayed from the records, registered to what was seen, and compared with the true surface, unseen sides
too.

**No generative model was run.** The meshes were made by a stand-in on this machine (`benchmarks/one_view.py`) that
answers with what can be known from the view sent: its color, mask and the reconstruction's depth there, carved, and
closed by a half turn or a mirror; never the truth, no other view. A generative model knows more about things and less
about depth: the figures compare views, not generators. The objects are the true ones (`oracle-instances`).

*Taken* counts each mesh as it was registered, *checked* as the pipeline does: what disagrees with the video is
rejected and the embedded completion stands in. The embedded completion is built from all frames and is the same for
all strategies."""


def write_generation_page(kept: Sequence[dict[str, Any]], page: Path) -> None:
    """Write the page from the kept results of captures."""
    records = [record for one in kept for record in one["objects"]]
    lines = [_HEAD, "", f"## Completed objects ({len(records)})", "", *_table(records)]
    least = min(record["hidden"] for record in records)
    machines = sorted({machine_line(one["machine"]) for one in kept})
    commits = ", ".join(sorted({one["commit"] for one in kept}))
    lines += [
        "",
        f"{len(records)} objects of {len(kept)} rooms, of which other things hide {100 * least:.0f} % or more of the "
        "outline over the film. Distances in centimeters, F at 1 cm.",
        "",
        f"Measured on {'; '.join(machines)}; commits {commits}.",
    ]
    words = (
        "From the left: the truth, the embedded completion, then for `avo`, `max-visibility`, `canonical` and "
        "`avo-no-depth` the picture that was sent and what was made of it, unchecked."
    )
    lines += picture_lines(kept, page, "avo_generation", "Completed things in", words)
    write_lines(lines, page)


def _table(records: Sequence[dict[str, Any]]) -> list[str]:
    rows = []
    names = [name for name in records[0]["made"] if not name.endswith(", checked")]
    for name in names:
        taken = [record["made"][name] for record in records]
        row = ["embedded completion" if name == "embedded" else f"one view of `{name}`", *_figures(taken)]
        if name == "embedded":
            row += ["", "", ""]
        else:
            checked = [record["made"][f"{name}, checked"] for record in records]
            used = np.mean([entry["generated"] for entry in checked])
            row += [f"{100 * used:.0f} %", *_figures(checked)]
        rows.append(row)
    head = ["made from", "taken: Chamfer", "F", "accepted", "checked: Chamfer", "F"]
    return table_lines(head, rows, 1)


def _figures(entries: Sequence[dict[str, Any]]) -> list[str]:
    cd, f = (np.mean([entry[key] for entry in entries]) for key in ("cd_cm", "f_1cm"))
    return [f"{cd:.2f}", f"{f:.1f}"]
