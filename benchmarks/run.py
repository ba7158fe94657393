"""Reconstruct and evaluate captures in variants, and write docs/benchmarks.md.

    python -m benchmarks.run --captures ../shared/bench ../shared/real --variants default fast oracle-poses

Each capture and variant is one `simrecon reconstruct` and one `simrecon evaluate` in processes of their own; the result
is kept as <out>/<capture>/<variant>.json, also where it failed. What is done with the same code, arguments and inputs
is not done again, so an interrupted run goes on where it stopped. See docs/benchmarking.md.
"""

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

from benchmarks.captures import Capture, find_captures
from benchmarks.command import KEPT_RESULTS, guarded
from benchmarks.machine import ROOT, describe_code, describe_machine
from benchmarks.results import Result, Status, last_line, load_result, load_results, result_path, save_result
from benchmarks.spread import save_spreads
from benchmarks.table import DEFAULT_OUT, DEFAULT_PAGE, write_page
from benchmarks.variants import VARIANTS, Variant, choose_variants, home_of, perturbed_variants, scene_id
from registry.errors import UsageError

_ERROR_LINES = 20
_GRACE_S = 60.0  # for a command to stop after Ctrl-C


def build_parser() -> argparse.ArgumentParser:
    """Build the command line's parser."""
    text = "\n".join(f"  {variant.name:<18}{variant.meaning}" for variant in VARIANTS)
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.run",
        description=__doc__,
        epilog=f"variants:\n{text}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_arguments(parser)
    parser.add_argument("--page", type=Path, default=DEFAULT_PAGE, metavar="FILE", help="the page to write")
    parser.add_argument(
        "--perturb",
        type=int,
        default=1,
        metavar="N",
        help="N runs of each variant, depth maps changed in their last bits: mean and spread of every figure",
    )
    return parser


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what every command takes that measures captures in variants."""
    parser.add_argument(
        "--captures",
        type=Path,
        nargs="+",
        required=True,
        metavar="DIR",
        help="captures, or folders of captures",
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these captures")
    parser.add_argument(
        "--variants", nargs="+", default=[], metavar="NAME", help="see below (default: default)"
    )
    parser.add_argument(
        "--variant", action="append", default=[], metavar="NAME=ARGUMENTS", help="one more, of your own"
    )
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT, metavar="DIR", help="where results are kept")
    parser.add_argument("--force", action="store_true", help="do again what is done")
    parser.add_argument("--retry-failed", action="store_true", help="do again what failed")
    parser.add_argument(
        "--keep-stale", action="store_true", help="keep results of other code; the page names their commit"
    )
    parser.add_argument("--timeout-s", type=float, default=4 * 3600.0, metavar="S", help="for one command")
    parser.add_argument(
        "--discard-stages", action="store_true", help="delete a capture's stage results when it is done"
    )
    parser.add_argument("--dry-run", action="store_true", help="only say what would be done")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0 if everything has figures, 1 if something failed, 130 if interrupted."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    captures = find_captures(arguments.captures, arguments.only)
    names = arguments.variants or ([] if arguments.variant else ["default"])
    variants = choose_variants(names, arguments.variant)
    if arguments.perturb < 1:
        raise UsageError(f"--perturb {arguments.perturb}: at least one run is needed")
    runs = [run for variant in variants for run in perturbed_variants(variant, arguments.perturb)]
    out = arguments.out.resolve()
    failed = measure_scenes(captures, runs, out, arguments)
    if not arguments.dry_run:
        results = load_results(out)
        save_spreads(results, out)
        write_page(results, arguments.page, describe_code())
        print(f"{arguments.page} is written", flush=True)
    return 1 if failed else 0


def measure_scenes(
    captures: Sequence[Capture], variants: Sequence[Variant], out: Path, arguments: argparse.Namespace
) -> int:
    """Reconstruct and evaluate what is not done yet, and keep the results; return how many failed.

    `arguments` has `force`, `retry_failed`, `keep_stale`, `timeout_s`, `discard_stages` and `dry_run`.
    """
    machine = describe_machine()
    failed = 0
    for capture in captures:
        inputs = capture.digest()
        for variant in variants:
            label = f"{capture.name} / {variant.name}"
            if not variant.applies_to(capture):
                print(f"{label}: left out, needs a ground truth with {variant.needs}.json", flush=True)
                continue
            code = describe_code()  # each time: a long run may see changes
            known = _known(out, capture, variant, inputs, code, arguments)
            if known is not None:
                print(f"{label}: {known.status} at {known.commit}, kept", flush=True)
                failed += known.failed
                continue
            if arguments.dry_run:
                print(f"{label}: to do", flush=True)
                continue
            print(f"{label}: ...", flush=True)
            result = run_variant(capture, variant, out, inputs, code, machine, arguments.timeout_s)
            if describe_code()["sources"] != code["sources"]:
                print(
                    f"{label}: the sources changed meanwhile; it is marked and will be done again", flush=True
                )
                result = replace(result, dirty=True, sources="changed during the run")
            save_result(result, out)
            print(f"{label}: {_summary(result)}", flush=True)
            failed += result.failed
        if arguments.discard_stages and not arguments.dry_run:
            shutil.rmtree(home_of(out, capture) / "work", ignore_errors=True)
    return failed


def _known(
    out: Path, capture: Capture, variant: Variant, inputs: str, code: dict, arguments: argparse.Namespace
) -> Result | None:
    """Return the result that is already there, None where it has to be made (again)."""
    path = result_path(out, capture.name, variant.name)
    if arguments.force or not path.is_file():
        return None
    result = load_result(path)
    if result.inputs != inputs or result.arguments != list(variant.arguments):
        return None
    if result.failed and arguments.retry_failed:
        return None
    return result if result.sources == code["sources"] or arguments.keep_stale else None


def run_variant(
    capture: Capture, variant: Variant, out: Path, inputs: str, code: dict, machine: dict, timeout_s: float
) -> Result:
    """Reconstruct one capture in one variant and evaluate it; a failure becomes a result, too."""
    home = home_of(out, capture)
    scene, registry = scene_id(variant), home / "registry"
    log = result_path(out, capture.name, variant.name).with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    wall_s: dict[str, float] = {}

    def command(verb: str, *words: str) -> tuple[int, str]:
        line = [sys.executable, "-m", "reconstruction.cli", verb, *words, "--registry", str(registry)]
        began = time.perf_counter()
        done = run_command(line, home, log, timeout_s)
        wall_s[verb] = round(time.perf_counter() - began, 1)
        return done

    def result(status: Status, exit_code: int, error: str, **found: object) -> Result:
        return Result(
            capture=capture.name,
            truth=capture.truth,
            variant=variant.name,
            arguments=list(variant.arguments),
            meaning=variant.meaning,
            status=status,
            exit_code=exit_code,
            error=error.replace(str(home), "<home>").replace(str(capture.source), capture.source.name),
            commit=code["commit"],
            dirty=code["dirty"],
            date=datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
            machine=machine,
            load_before=round(load, 2),
            inputs=inputs,
            sources=code["sources"],
            wall_s=wall_s,
            **found,
        )

    log.write_text("")
    _forget(registry, scene)
    words = [str(capture.source), "--scene", scene, "--keep-results", str(KEPT_RESULTS)]
    exit_code, error = command("reconstruct", *words, *variant.arguments_for(capture))
    if exit_code != 0:
        return result("reconstruct failed", exit_code, error)
    found = _bundle_facts(registry, scene)
    figures = log.with_suffix(".evaluation")
    figures.unlink(missing_ok=True)
    known = [path for path in (capture.ground_truth, capture.labels) if path is not None]
    truth = [word for path in known for word in ("--ground-truth", str(path))]
    exit_code, error = command("evaluate", scene, *truth, "--json", str(figures))
    if exit_code != 0:
        return result("evaluate failed", exit_code, error, **found)
    try:
        evaluation = json.loads(figures.read_text())
    except (OSError, ValueError) as problem:
        return result("evaluate failed", exit_code, f"{figures.name}: {problem}", **found)
    figures.unlink()
    return result("done", 0, "", evaluation=evaluation, **found)


def _forget(registry: Path, scene: str) -> None:
    """Remove the scene of an earlier run: an equal bundle would not be published again and keep its old timings."""
    from registry import SceneRegistry

    opened = SceneRegistry(registry, create=True)
    if scene in {record.scene_id for record in opened.list()}:
        opened.remove(scene)


def _bundle_facts(registry: Path, scene: str) -> dict:
    from registry import SceneRegistry

    document = SceneRegistry(registry).load(scene).scene
    report = {key: value for key, value in document["report"].items() if key not in ("config", "physics")}
    return {"report": report, "objects": len(document["objects"])}


def run_command(line: list[str], home: Path, log: Path, timeout_s: float) -> tuple[int, str]:
    """Run a command with a home of its own, its output appended to a log.

    Returns:
        Its exit code (124: out of time) and the last lines of what it wrote to stderr.
    """
    home.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "SIMRECON_HOME": str(home), "PYTHONUNBUFFERED": "1"}
    environment.pop("SIMRECON_DEBUG", None)  # Failures are to be the messages that users see.
    with log.open("ab") as sink:
        sink.write(f"$ {' '.join(line)}\n".encode())
        sink.flush()
        began = sink.tell()
        # In a session of its own: Ctrl-C reaches this process only, which then stops the command in an orderly way.
        process = subprocess.Popen(
            line, cwd=ROOT, env=environment, stdout=sink, stderr=sink, start_new_session=True
        )
        with _stopped_on_error(process):
            try:
                code = process.wait(timeout=timeout_s)
            except subprocess.TimeoutExpired:
                _stop(process)
                return 124, f"stopped after {timeout_s:.0f} s (--timeout-s)"
    with log.open("rb") as written:
        written.seek(began)
        lines = written.read().decode(errors="replace").splitlines()
    return code, "\n".join(lines[-_ERROR_LINES:]) if code else ""


@contextlib.contextmanager
def _stopped_on_error(process: subprocess.Popen) -> Iterator[None]:
    try:
        yield
    except BaseException:
        _stop(process)
        raise


def _stop(process: subprocess.Popen) -> None:
    """Ask a command and its children to stop as Ctrl-C does, then make them."""
    for number, patience_s in ((signal.SIGINT, _GRACE_S), (signal.SIGKILL, _GRACE_S)):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        try:
            process.wait(timeout=patience_s)
        except subprocess.TimeoutExpired:
            continue
        return


def _summary(result: Result) -> str:
    if result.failed:
        return f"{result.status} (exit code {result.exit_code}): {last_line(result.error)}"
    shown = []
    for name in ("object_recall_25", "object_precision_25", "cd_cm", "psnr_db", "stable_rate", "time_s"):
        value = result.metrics.get(name)
        if value is not None:
            shown.append(f"{name} {value:.3g}")
    return f"done in {sum(result.wall_s.values()):.0f} s; {', '.join(shown)}"


if __name__ == "__main__":
    # Also where a shell started this in the background, with Ctrl-C ignored; commands then inherit the default.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    sys.exit(main())
