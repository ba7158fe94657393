"""Tables of a batch: `results.csv`, `results.parquet`, the same of single objects, and previews beside them."""

import csv
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from PIL import Image

from reconstruction.batch.figures import object_figures, scene_figures
from reconstruction.batch.journal import VideoState
from reconstruction.batch.rows import VideoRow
from registry import SceneRegistry
from registry.errors import SimReconError
from registry.files import write_whole

FIRST = (
    "scene",
    "video",
    "state",
    "kind",
    "cause",
    "cure",
    "attempts",
    "wall_s",
    "host",
    "revision",
    "env_id",
)
_PREVIEW_PX = 480
Table = list[dict[str, Any]]


class Results:
    """Reads the figures of published scenes, each revision once, and writes the tables."""

    def __init__(self, out: Path, registry: SceneRegistry) -> None:
        self._out, self._registry = out, registry
        self._scenes: dict[tuple[str, str], tuple[dict[str, Any], Table]] = {}

    def tables(self, rows: Iterable[VideoRow], states: Mapping[str, VideoState]) -> tuple[Table, Table]:
        """Return (a row for each video, a row for each object of published scenes)."""
        scenes, objects = [], []
        for row in rows:
            state = states.get(row.scene_id, VideoState(row.scene_id))
            line = _state_columns(row, state)
            if state.result == "published":
                figures, things = self._figures(row.scene_id, state.revision)
                line |= figures
                objects += [{"scene": row.scene_id, **thing} for thing in things]
            scenes.append(line)
        return scenes, objects

    def _figures(self, scene_id: str, revision: str) -> tuple[dict[str, Any], Table]:
        key = (scene_id, revision)
        if key not in self._scenes:
            try:
                bundle = self._registry.load(scene_id)
                if bundle.revision != revision:
                    return {}, []
                self._scenes[key] = scene_figures(bundle), object_figures(bundle)
                self._copy_preview(bundle.root, scene_id)
            except (SimReconError, OSError):  # replaced or removed since
                return {}, []
        return self._scenes[key]

    def _copy_preview(self, folder: Path, scene_id: str) -> None:
        source = folder / "preview.png"
        if source.is_file():
            target = self._out / "previews" / f"{scene_id}.jpg"
            target.parent.mkdir(parents=True, exist_ok=True)
            with Image.open(source) as picture:
                picture.thumbnail((_PREVIEW_PX, _PREVIEW_PX))
                picture.convert("RGB").save(target, quality=85)

    def write(self, scenes: Table, objects: Table) -> list[str]:
        """Write the tables; return notes about what could not be written."""
        notes = []
        for name, table in (("results", scenes), ("objects", objects)):
            write_whole(self._out / f"{name}.csv", to_csv(table).encode())
            notes += write_parquet(self._out / f"{name}.parquet", table)
        return notes[:1]


def _state_columns(row: VideoRow, state: VideoState) -> dict[str, Any]:
    values = {
        "scene": row.scene_id,
        "video": _text(str(row.video)),
        "state": {"": "unfinished" if state.attempts else "waiting", "retry": "unfinished"}.get(
            state.result, state.result
        ),
        "kind": state.kind if state.result != "published" else "",
        "cause": state.cause,
        "cure": state.cure,
        "attempts": state.attempts,
        "wall_s": round(state.wall_s, 2),
        "host": state.host,
        "revision": state.revision,
        "env_id": f"SimRecon/{row.scene_id}" if state.result == "published" else "",
        "preset": row.preset,
        "options": " ".join(row.options),
    }
    return values


def columns_of(table: Table) -> list[str]:
    """Return all columns: first those of `FIRST`, then the others in order of appearance."""
    names = dict.fromkeys(name for row in table for name in row)
    return [name for name in FIRST if name in names] + [name for name in names if name not in FIRST]


def to_csv(table: Table) -> str:
    """Return a table as CSV; an unknown value is an empty cell."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns_of(table), lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows({key: "" if value is None else value for key, value in row.items()} for row in table)
    return text.getvalue()


def write_parquet(path: Path, table: Table) -> list[str]:
    """Write a table as Parquet; without pyarrow return a note that names the extra."""
    try:
        import pyarrow
        import pyarrow.parquet as parquet
    except ImportError:
        return [f"no {path.name}: Parquet needs pyarrow: pip install 'simrecon[lerobot]'"]
    columns = {name: _typed([row.get(name) for row in table]) for name in columns_of(table)}
    partial = path.with_suffix(".part")
    parquet.write_table(pyarrow.table(columns), str(partial))
    partial.replace(path)
    return []


def _typed(values: list[Any]) -> list[Any]:
    """Return values of one type: all bool, all numbers, or all texts; None stays."""
    known = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in known):
        return values
    if all(isinstance(value, int) and not isinstance(value, bool) for value in known):
        return values
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in known):
        return [None if value is None else float(value) for value in values]
    return [None if value is None else str(value) for value in values]


def _text(name: str) -> str:
    """Return a path as text that UTF-8 can hold."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
