"""`simrecon batch`: reconstructs many videos, on this machine or on a cluster."""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from reconstruction.commands.options import add_common, add_verb

if TYPE_CHECKING:
    from reconstruction.batch.driver import Summary, Task
    from reconstruction.batch.journal import Journal
    from reconstruction.batch.listing import Listing
    from reconstruction.batch.plan import Step
    from reconstruction.batch.rows import VideoRow
    from registry import SceneRegistry

_SHOWN_OPTIONS = 100  # characters in the table of --dry-run

_DESCRIPTION = """Reconstruct every video of a folder or of a list, several at once. Each video runs
`simrecon reconstruct` in its own process. A journal on the disk records every start and end: after Ctrl-C, a crash or
a power cut, the same command does what is missing, and finished stages are not done again. A video that ended is run
again only if its options or its files changed. Tables of all figures and a page with all scenes are written beside
the journal."""

_EPILOG = """a folder: each video in it, and each folder of images in it; scene ids come from the file names.
a list: CSV with a row for each video. Only `path` is needed; paths count from the list's folder,
and may be addresses:
  path,id,preset,options,marker_size,scale,poses,overrides,seed
  kitchen.mp4,,,,0.10,,,,
  photos/dorm,dorm,quality,depth.depth_side_px=640 frames.max_keyframes=80,,camera-height=1.5,,dorm.yaml,

results, in NAME.batch or --out DIR:
  index.html        all scenes with pictures, figures and reports; all failures with cause and cure
  results.csv       a row for each video: every figure of the report cards; also results.parquet, objects.csv
  journal.jsonl     every start and end; logs/SCENE.log is what a run printed

attempts: what the machine is to blame for (a killed process, memory, a full disk, something missing) is tried
again; what the video or its row is to blame for is not. Both end in the table with one line of cause and one of cure.

exit codes: 0 all published; 3 some videos cannot be reconstructed; 4 the machine failed some; 2 wrong use (nothing ran)

examples:
  simrecon batch films/ --dry-run               # what would run, and why
  simrecon batch films/                         # as many at once as cores and memory allow
  simrecon batch rooms.csv --preset fast --at-once 4 --out rooms
  simrecon batch films/ --engine ray            # local Ray; pip install 'simrecon[ray]'
  simrecon batch /nfs/films --engine ray --address auto --registry /nfs/registry --work-dir /nfs/work
  simrecon batch s3://lab/films --engine ray --address auto --registry s3://lab/scenes --work-dir s3://lab/work
  simrecon batch films/ --retry-failed          # after a new version, or new films under the old names
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(verbs, "batch", "reconstruct many videos, several at once", _DESCRIPTION, _EPILOG)
    add = parser.add_argument
    add(
        "videos",
        metavar="FOLDER|LIST.csv",
        help="a folder of videos, or a list of them; also at an address (s3://bucket/films)",
    )
    add("--out", type=Path, metavar="DIR", help="folder of journal and results (default: ./NAME.batch)")
    add("--dry-run", action="store_true", help="print what would run, and why; change nothing")
    of_rows = parser.add_argument_group("options of rows that say nothing else")
    of_rows.add_argument("--preset", choices=("fast", "default", "quality"), default="default")
    of_rows.add_argument(
        "--set", action="append", default=[], metavar="STAGE.FIELD=VALUE", help="set any option"
    )
    of_rows.add_argument("--scale", metavar="HOW", help="as for `simrecon reconstruct`")
    of_rows.add_argument(
        "--marker-size", type=float, metavar="METRES", help="side of a printed marker in view"
    )
    of_rows.add_argument("--seed", type=int, default=0, help="seed of all random numbers (default 0)")
    for_all = parser.add_argument_group("options of all rows")
    for_all.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    for_all.add_argument(
        "--require-stable", action="store_true", help="do not publish a scene with a moving object"
    )
    for_all.add_argument(
        "--work-dir",
        metavar="DIR",
        help="folder of the stage caches, DIR/SCENE each; $VARIABLES are those of the machine that runs the video. At "
        "an address (s3://bucket/work) lie copies of them: a video goes on from its finished stages on any machine",
    )
    for_all.add_argument(
        "--drop-work", action="store_true", help="with --work-dir: delete the cache of a published scene"
    )
    for_all.add_argument(
        "--no-reports", action="store_true", help="no page of `simrecon report` for each scene"
    )
    _add_running(parser)
    add_common(parser, json=False)
    parser.set_defaults(run=run)


def _add_running(parser: argparse.ArgumentParser) -> None:
    """Add what says where, and how often, videos run."""
    choice = parser.add_argument_group("rows that run beside the missing ones")
    choice.add_argument(
        "--retry-failed", action="store_true", help="also videos that failed by their own fault"
    )
    choice.add_argument("--rerun", action="store_true", help="all videos; cached stages are still used")
    choice.add_argument(
        "--replace", action="store_true", help="replace scenes that were made by something else"
    )
    where = parser.add_argument_group("where they run")
    where.add_argument(
        "--engine", default="local", metavar="NAME", help="local (default), ray, or module:Class of your own"
    )
    where.add_argument(
        "--address", help="with --engine ray: address of a cluster; auto: the one of this machine"
    )
    where.add_argument("--at-once", type=int, default=0, metavar="N", help="most videos at the same time")
    where.add_argument(
        "--cores", type=int, default=0, metavar="N", help="CPU cores of a video (default by preset)"
    )
    where.add_argument(
        "--gpus", type=float, default=0.0, metavar="N", help="GPUs of a video, for Ray (0.5: two share one)"
    )
    where.add_argument(
        "--memory", type=float, default=0.0, metavar="GB", help="memory of a video (default by preset)"
    )
    where.add_argument(
        "--memory-limit", type=float, default=0.0, metavar="GB", help="end a video that takes more"
    )
    where.add_argument(
        "--time-limit", type=float, default=0.0, metavar="MINUTES", help="end a video that takes longer"
    )
    where.add_argument(
        "--retries",
        type=int,
        default=3,
        metavar="N",
        help="attempts after one that failed, without reaching a further stage (default 3)",
    )
    where.add_argument("--quiet", action="store_true", help="no progress")


def run(arguments: argparse.Namespace) -> int:
    """Run the batch; return the exit code."""
    from reconstruction.batch.journal import Journal
    from reconstruction.batch.listing import read_rows
    from reconstruction.batch.plan import Choice, make_plan
    from reconstruction.batch.sources import path_of, reading
    from registry import open_registry

    _check_flags(arguments)
    place = path_of(arguments.videos)
    with reading(place):
        name = place.stem if place.is_file() else place.name
    out = Path(arguments.out or f"{name}.batch").absolute()
    journal = Journal(out)
    registry = open_registry(arguments.registry)
    registry.root = registry.root.absolute()
    listing = read_rows(arguments.videos, _defaults(arguments), journal.known_ids())
    choice = Choice(arguments.retry_failed, arguments.rerun, arguments.replace)
    common = _common(arguments)
    if arguments.dry_run:
        _print_plan(make_plan(listing, journal.states(), registry, common, choice), listing, journal)
        return 0
    _make_folder(out)
    with journal.held():
        steps = make_plan(listing, journal.states(), registry, common, choice)
        return _run_steps(arguments, listing, steps, journal, registry)


def _check_flags(arguments: argparse.Namespace) -> None:
    from registry.errors import UsageError

    for name in ("at_once", "cores", "gpus", "memory", "memory_limit", "time_limit", "retries"):
        value = getattr(arguments, name)
        if not 0 <= value < 1e9:
            raise UsageError(f"--{name.replace('_', '-')} {value:g}: it must be 0 or more")
    if arguments.drop_work and not arguments.work_dir:
        raise UsageError("--drop-work needs --work-dir: other runs share the default folder")
    if arguments.address and arguments.engine != "ray":
        raise UsageError("--address needs --engine ray")


def _make_folder(out: Path) -> None:
    from registry.errors import EnvironmentMissing

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EnvironmentMissing(f"--out {out}: {error.strerror or error}; choose another folder") from error


def _defaults(arguments: argparse.Namespace) -> "VideoRow":
    from reconstruction.batch.rows import VideoRow

    return VideoRow(
        scene_id="",
        video=Path(),
        preset=arguments.preset,
        options=tuple(arguments.set),
        marker_size_m=arguments.marker_size,
        scale=arguments.scale,
        seed=arguments.seed,
    )


def _common(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the arguments that all rows share and that change results."""
    found = [] if arguments.device == "auto" else ["--device", arguments.device]
    return tuple(found + (["--require-stable"] if arguments.require_stable else []))


def _run_steps(
    arguments: argparse.Namespace,
    listing: "Listing",
    steps: "list[Step]",
    journal: "Journal",
    registry: "SceneRegistry",
) -> int:
    from reconstruction.batch.display import make_display
    from reconstruction.batch.driver import Driver, Policy
    from reconstruction.batch.engines import Resources, load_engine
    from reconstruction.batch.outcomes import MACHINE, TRANSIENT
    from reconstruction.batch.overview import Overview

    overview = Overview(journal, listing, registry)
    tasks = _tasks(arguments, steps, journal, registry)
    summary = None
    if tasks:
        cores = (
            0 if not arguments.at_once else min(os.cpu_count() or 1, arguments.at_once * tasks[0].job.cores)
        )
        engine = load_engine(arguments.engine, Resources(arguments.at_once, cores, arguments.address))
        journal.append("batch", videos=len(steps), runs=len(tasks), engine=engine.name)
        with make_display(arguments.quiet) as display:
            driver = Driver(journal, engine, registry, display, Policy(arguments.retries), overview.refresh)
            summary = driver.run(tasks)
    notes = overview.write()
    _print_end(steps, summary, journal, notes)
    if summary is None:
        kinds = [state.kind for state in journal.states().values() if state.result == "failed"]
    elif summary.interrupted:
        return 130
    else:
        kinds = [*summary.kinds, *(["machine"] if summary.trouble else [])]
    if any(kind in MACHINE | TRANSIENT | {"bug"} for kind in kinds):
        return 4
    return 3 if kinds else 0


def _tasks(
    arguments: argparse.Namespace, steps: "list[Step]", journal: "Journal", registry: "SceneRegistry"
) -> "list[Task]":
    """Return a task for each step that runs."""
    from reconstruction.batch.attempt import Job
    from reconstruction.batch.driver import Task
    from reconstruction.batch.engines.base import CORES, MEMORY_MB
    from reconstruction.batch.rows import size_bytes
    from registry.roots import is_address

    out, common = journal.path.parent, _common(arguments)
    work_dir = None
    if arguments.work_dir:
        as_it_is = "$" in arguments.work_dir or is_address(arguments.work_dir)
        work_dir = arguments.work_dir if as_it_is else str(Path(arguments.work_dir).absolute())
    tasks = []
    for step in steps:
        if not step.runs:
            continue
        scene, preset = step.row.scene_id, step.row.preset
        job = Job(
            scene_id=scene,
            fingerprint=step.fingerprint,
            arguments=(*step.row.arguments(), *common),
            registry=registry.where,
            log=out / "logs" / f"{scene}.log",
            work_dir=work_dir,
            report=None if arguments.no_reports else out / "reports" / f"{scene}.html",
            cores=arguments.cores or CORES[preset],
            gpus=arguments.gpus,
            memory_mb=round(1024 * arguments.memory) or MEMORY_MB[preset],
            memory_limit_mb=round(1024 * arguments.memory_limit),
            time_limit_s=60 * arguments.time_limit,
            keep_work=not arguments.drop_work,
        )
        own_folder = work_dir is not None and not is_address(work_dir)
        apart = None if own_folder else size_bytes(step.row.video)
        tasks.append(Task(job, str(step.row.video), apart=apart))
    return tasks


def _print_plan(steps: "list[Step]", listing: "Listing", journal: "Journal") -> None:
    """Print the table of --dry-run."""
    from reconstruction.batch.display import duration
    from reconstruction.batch.outcomes import plain

    width = max(len(step.row.scene_id) for step in steps)
    for step in steps:
        row = step.row
        said = [row.preset, *row.options]
        said += [f"marker {row.marker_size_m:g} m"] if row.marker_size_m is not None else []
        said += [f"scale {row.scale}"] if row.scale else []
        said += [f"overrides {row.overrides.name}"] if row.overrides else []
        does = f"run ({step.reason})" if step.runs else f"keep ({step.reason})"
        told = plain(" ".join(said))
        told = told if len(told) <= _SHOWN_OPTIONS else f"{told[: _SHOWN_OPTIONS - 1]}…"
        print(f"{row.scene_id:<{width}}  {does:<24} {plain(row.video.name)}  {told}")
    runs = [step for step in steps if step.runs]
    print(f"{len(steps)} videos: {len(runs)} would run, {len(steps) - len(runs)} would not")
    if listing.left_out:
        shown = ", ".join(plain(name) for name in listing.left_out[:8])
        more = len(listing.left_out) - 8
        print(f"left out, no video: {shown}{f' and {more} more' if more > 0 else ''}")
    times = [state.last_wall_s for state in journal.states().values() if state.result == "published"]
    if times and runs:
        each = sum(times) / len(times)
        print(f"a video took {duration(each)}: about {duration(each * len(runs))} one after the other")


def _print_end(steps: "list[Step]", summary: "Summary | None", journal: "Journal", notes: list[str]) -> None:
    """Print how the batch ended and where the results are."""
    from reconstruction.batch.outcomes import plain

    states = journal.states()
    ends = [states.get(step.row.scene_id) for step in steps]
    published = sum(state is not None and state.result == "published" for state in ends)
    failed = [state for state in ends if state is not None and state.result == "failed"]
    left = len(steps) - published - len(failed)
    if summary is None:
        print("nothing to do: every video has ended (--retry-failed and --rerun run them again)")
    print(f"{len(steps)} videos: {published} published, {len(failed)} failed, {left} not ended")
    for state in failed[:20]:
        print(f"  {state.scene_id}: {plain(state.cause)}. {plain(state.cure)}")
    if len(failed) > 20:
        print(f"  and {len(failed) - 20} more in results.csv")
    if summary is not None and summary.trouble:
        print(f"stopped early: {summary.trouble}")
    if left:
        print("run the same command again: it does what is missing")
    for note in notes:
        print(f"note: {note}")
    print(f"all results: {journal.path.parent / 'index.html'}")
