"""Read the rows of a batch: a folder or a CSV list in, checked `VideoRow`s out; all problems in one message."""

import csv
import io
import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from reconstruction.batch import sources
from reconstruction.batch.naming import assign_ids
from reconstruction.batch.rows import AnyPath, VideoRow, check_there
from reconstruction.phone_exports.exports import natural
from registry.errors import SimReconError, UsageError, did_you_mean
from registry.roots import is_address
from registry.schema import check_scene_id

COLUMNS = ("path", "id", "preset", "options", "marker_size", "scale", "poses", "overrides", "seed")
_SHOWN_PROBLEMS = 50


@dataclass(frozen=True)
class Listing:
    """The rows of a batch."""

    name: str
    rows: tuple[VideoRow, ...]
    left_out: tuple[str, ...] = ()  # names in a folder that are no videos


@dataclass
class _Problems:
    found: list[str] = field(default_factory=list)

    def add(self, where: str, error: object) -> None:
        self.found.append(f"{where}: {error}" if where else str(error))

    def finish(self, name: str) -> None:
        if not self.found:
            return
        shown = sorted(self.found, key=natural)[:_SHOWN_PROBLEMS]
        more = len(self.found) - len(shown)
        count = "1 problem" if len(self.found) == 1 else f"{len(self.found)} problems"
        lines = [f"{name}: {count}, nothing was run", *(f"  {line}" for line in shown)]
        raise UsageError("\n".join(lines + ([f"  and {more} more"] if more else [])))


def read_rows(address: str, defaults: VideoRow, known: Mapping[str, str] | None = None) -> Listing:
    """Return the checked rows of a folder or a list.

    Args:
        address: a folder of videos, or a CSV file with a row for each video (columns: `COLUMNS`, `path` is needed).
        defaults: the options of rows that say nothing else; its id and video are not used.
        known: ids of an earlier run by path.

    Raises:
        UsageError: the address cannot be read, or rows are wrong; the message names every problem.
    """
    place = sources.path_of(address)
    with sources.reading(place):
        return _read_rows(place, defaults, known)


def _read_rows(place: AnyPath, defaults: VideoRow, known: Mapping[str, str] | None) -> Listing:
    left_out: list[str] = []
    problems = _Problems()
    if place.is_dir():
        videos, left_out = sources.videos_in(place)
        if not videos:
            holds = f"it holds {', '.join(left_out[:6])}" if left_out else "it is empty"
            raise UsageError(f"{place}: no video and no folder of images ({holds})")
        rows = [replace(defaults, scene_id="", video=video, where=video.name) for video in videos]
    elif place.is_file():
        rows = _rows_of_list(place, defaults, problems)
    else:
        raise UsageError(f"{place}: no such file or folder")
    rows = _with_ids(rows, problems, known)
    for row in rows:
        check_row(row, problems.add)
    problems.finish(place.name)
    return Listing(place.stem if place.is_file() else place.name, tuple(rows), tuple(left_out))


def _rows_of_list(path: AnyPath, defaults: VideoRow, problems: _Problems) -> list[VideoRow]:
    text = sources.read_list(path)
    header = text.split("\n", 1)[0]
    delimiter = max(",;\t", key=header.count)
    reader = csv.DictReader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True)
    names = [(name or "").strip().lower() for name in reader.fieldnames or []]
    if "path" not in names:
        raise UsageError(
            f"{path}: the first line must name the columns, `path` among them; it is {header.strip()[:80]!r}. "
            f"The columns are {', '.join(COLUMNS)}"
        )
    for name in names:
        if name not in COLUMNS:
            problems.add(
                f"line 1, column {name!r}",
                f"unknown.{did_you_mean(name, COLUMNS)} There are {', '.join(COLUMNS)}",
            )
    for name in sorted({name for name in names if names.count(name) > 1}):
        problems.add("line 1", f"column {name!r} is there twice")
    reader.fieldnames = names
    rows = []
    try:
        for cells in reader:
            where = f"line {reader.line_num}"
            extra = cells.pop(None, None)
            if extra:
                problems.add(
                    where, f"{len(extra)} more cells than columns; quote a cell that holds {delimiter!r}"
                )
            values = {key: (value or "").strip() for key, value in cells.items()}
            if any(values.values()):
                rows.append(_row_of(values, where, path.parent, defaults, problems))
    except csv.Error as error:
        problems.add(f"line {reader.line_num}", error)
    if not rows and not problems.found:
        raise UsageError(f"{path}: no row below the names of the columns")
    return rows


def _row_of(
    values: dict[str, str], where: str, folder: AnyPath, defaults: VideoRow, problems: _Problems
) -> VideoRow:
    """Return the row of one line; a value that cannot be parsed is a problem, and the default stays."""

    def path_of(column: str) -> "AnyPath | None":
        text = values.get(column, "")
        try:
            return sources.path_of(text if is_address(text) else str(folder / text)) if text else None
        except SimReconError as error:
            problems.add(f"{where}, {column}", error)
            return None

    def local_path_of(column: str) -> Path | None:
        path = path_of(column)
        if path is None or isinstance(path, Path):
            return path
        problems.add(
            f"{where}, {column}", f"{path}: only videos are read from addresses; copy the file first"
        )
        return None

    def number(column: str, kind: type) -> float | int | None:
        text = values.get(column, "")
        try:
            return kind(text) if text else None
        except ValueError:
            problems.add(f"{where}, {column}", f"{text!r} is no {'whole ' if kind is int else ''}number")
            return None

    try:
        options = tuple(shlex.split(values.get("options", "")))
    except ValueError as error:
        problems.add(f"{where}, options", error)
        options = ()
    marker, seed = number("marker_size", float), number("seed", int)
    return replace(
        defaults,
        scene_id=values.get("id", ""),
        video=path_of("path") or Path(),
        preset=values.get("preset") or defaults.preset,
        options=(*defaults.options, *options),
        marker_size_m=defaults.marker_size_m if marker is None else float(marker),
        scale=values.get("scale") or defaults.scale,
        poses=local_path_of("poses") or defaults.poses,
        overrides=local_path_of("overrides") or defaults.overrides,
        seed=defaults.seed if seed is None else int(seed),
        where=where,
    )


def _with_ids(rows: list[VideoRow], problems: _Problems, known: Mapping[str, str] | None) -> list[VideoRow]:
    """Fill in missing ids; ids that are wrong or there twice are problems."""
    given: dict[str, VideoRow] = {}
    for row in rows:
        if not row.scene_id:
            continue
        try:
            check_scene_id(row.scene_id)
        except UsageError as error:
            problems.add(f"{row.where}, id", error)
        if row.scene_id in given:
            problems.add(
                f"{row.where}, id", f"{row.scene_id!r} is the id of {given[row.scene_id].where}, too"
            )
        given.setdefault(row.scene_id, row)
    nameless = [row for row in rows if not row.scene_id]
    seen: dict[AnyPath, VideoRow] = {}
    for row in nameless:
        if row.video in seen:
            problems.add(
                row.where,
                f"{row.video.name} is {seen[row.video].where}, too; give both an id to run it twice",
            )
        seen.setdefault(row.video, row)
    ids = assign_ids(list(seen), {key: row.video for key, row in given.items()}, known)
    return [row if row.scene_id else replace(row, scene_id=ids[row.video]) for row in rows]


def check_row(row: VideoRow, report) -> None:
    """Check the files and options of a row; call `report(where, message)` for each problem."""
    if row.video == Path():
        report(f"{row.where}, path", "missing")
    elif problem := _video_problem(row.video):
        report(f"{row.where}, path", problem)
    for name, path in (("poses", row.poses), ("overrides", row.overrides)):
        if path is not None and not path.exists():
            report(f"{row.where}, {name}", f"{path}: no such file")
        elif path is not None and name == "overrides" and (problem := _overrides_problem(path)):
            report(f"{row.where}, overrides", problem)
    if row.marker_size_m is not None and not (math.isfinite(row.marker_size_m) and row.marker_size_m > 0):
        report(f"{row.where}, marker_size", f"{row.marker_size_m:g} is no length in metres; 0.10 is 10 cm")
    if problem := _option_problem(row.preset, row.options, row.scale):
        report(f"{row.where}, {problem[0]}", problem[1])


def _video_problem(video: AnyPath) -> str:
    try:
        check_there(video)
        return ""
    except SimReconError as error:
        return str(error)


@cache
def _option_problem(preset: str, options: tuple[str, ...], scale: str | None) -> tuple[str, str] | None:
    """Return (column, message) of the first option that the pipeline refuses, or None."""
    from reconstruction.config import PipelineConfig
    from reconstruction.world import parse_scale

    column = "preset"
    try:
        config = PipelineConfig.from_preset(preset)
        column = "options"
        for option in options:
            config = config.with_option(option)
        column = "scale"
        if scale is not None:
            parse_scale(scale)
    except SimReconError as error:
        return column, str(error)
    return None


@cache
def _overrides_problem(path: Path) -> str | None:
    from reconstruction.editing.overrides import Overrides

    try:
        Overrides.load(path)
    except SimReconError as error:
        return str(error)
    return None
