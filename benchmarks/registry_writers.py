"""Many processes write to a registry on local disk and on S3, and to a place in a folder and on S3: is anything lost?

Usage:
    python -m benchmarks.registry_writers --processes 8 --publishes 500 [--targets registry,…] [--json FILE]

Four of five bundles have an id of their own; every fifth is another revision of one id that all processes write. While
they write, a reader lists all the time: what it has once seen must stay, and it must never see damage.

Afterwards, of a registry: every id is there, every scene verifies, no temporary folder is left, and an index that is
rebuilt after it was deleted says the same. Of a place: every push has its entry and its pack, and every scene and
revision is pulled and verified. The writers of the registry on S3 have a home of their own, as on different machines;
its entries are deleted and rebuilt from the packs, too.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing.synchronize import Barrier, Event
from pathlib import Path
from typing import Any

from benchmarks.registry_kills import check_registry
from benchmarks.s3_server import s3_server
from registry import SceneBundle, SceneRegistry, open_registry
from registry.errors import SimReconError, UsageError
from registry.exchange import list_place, open_place, pull_scene, push_scene
from registry.exchange.remote import RemoteRegistry
from registry.exchange.sharing import entries_of, revisions_of
from synthetic.small_bundle import write_small_bundle

TARGETS = ("registry", "folder", "s3", "s3_registry")
SHARED = "shared"
_BUCKET = "writers"
_SPAWN = multiprocessing.get_context("spawn")  # clients of S3 do not survive a fork


def scene_of(number: int) -> str:
    """Return the id under which a bundle is written."""
    return SHARED if number % 5 == 0 else f"scene{number:04d}"


def write_some(target: str, address: str, bundles: Path, numbers: list[int], start: Barrier) -> None:
    """Write bundles one after the other (the work of one process)."""
    if target == "s3_registry":  # of a machine of its own
        os.environ["SIMRECON_HOME"] = str(bundles.parent / f"home{numbers[0]}")
    registry = open_registry(address) if "registry" in target else None
    place = open_place(address)
    start.wait()
    for number in numbers:
        folder = bundles / f"{number}"
        if registry is not None:
            registry.publish(folder, scene_of(number))
        else:
            push_scene(SceneBundle.open(folder), place)


def read_all_the_time(target: str, address: str, start: Barrier, end: Event, said: Any) -> None:
    """List until the end; put (number of lists, problems) in a queue."""
    known: set[str] = set()
    problems: list[str] = []
    lists = 0
    start.wait()
    place = None if target == "registry" else open_place(address)
    while not end.is_set():
        try:
            if place is None:
                records, malformed = SceneRegistry(Path(address)).list_with_problems()
                problems += malformed
                found = {record.scene_id for record in records}
            else:
                found = {shared.scene_id for shared in list_place(place)}
        except SimReconError as error:
            problems.append(f"a reader: {error}")
            continue
        problems += [f"a reader: {name} vanished" for name in sorted(known - found)]
        known |= found
        lists += 1
    said.put((lists, problems))


def run_writers(home: Path, target: str, address: str, processes: int, publishes: int) -> dict[str, Any]:
    """Write so many bundles by so many processes; return counts, seconds and problems.

    Args:
        home: A folder that does not exist.
        target: One of `TARGETS`.
        address: Folder of the registry, or address of the place.
        processes: Writers.
        publishes: Bundles in all.
    """
    bundles = home / "bundles"
    revisions = [write_small_bundle(bundles / f"{n}", scene_of(n), f"{n}") for n in range(publishes)]
    start, end, said = _SPAWN.Barrier(processes + 2), _SPAWN.Event(), _SPAWN.Queue()
    writers = [
        _SPAWN.Process(
            target=write_some, args=(target, address, bundles, list(range(n, publishes, processes)), start)
        )
        for n in range(processes)
    ]
    reader = _SPAWN.Process(target=read_all_the_time, args=(target, address, start, end, said))
    for process in (*writers, reader):
        process.start()
    start.wait()  # until all have imported what they need
    began = time.monotonic()
    for process in writers:
        process.join()
    seconds = time.monotonic() - began
    end.set()
    lists, problems = said.get(timeout=60)
    reader.join()
    problems += [f"a writer: exit code {w.exitcode}" for w in writers if w.exitcode]
    pushed = {(scene_of(n), revision) for n, revision in enumerate(revisions)}
    judge: Callable[..., list[str]] = judge_registry if target == "registry" else judge_place
    if target == "s3_registry":
        judge = judge_remote
    began = time.monotonic()
    problems += judge(home, address, pushed)
    return {
        "processes": processes,
        "publishes": publishes,
        "scenes": len({scene for scene, _ in pushed}),
        "write_s": round(seconds, 1),
        "lists_meanwhile": lists,
        "judge_s": round(time.monotonic() - began, 1),
        "problems": problems,
    }


def judge_registry(home: Path, address: str, pushed: set[tuple[str, str]]) -> list[str]:
    """Check a registry against what was published, rebuild its index; return one line for each loss or fault."""
    registry = SceneRegistry(Path(address))
    problems = list(check_registry(registry, {scene for scene, _ in pushed}))
    found = registry.revisions()
    problems += [f"{pair}: nobody published it" for pair in found.items() if pair not in pushed]
    problems += [f"left: {path}" for path in registry.scenes_folder.glob("*/.*")]
    for path in registry.root.glob("index.sqlite*"):
        path.unlink()
    problems += registry.rebuild()[1]
    if registry.revisions() != found:
        problems.append("the rebuilt index differs")
    return problems


def judge_place(home: Path, address: str, pushed: set[tuple[str, str]]) -> list[str]:
    """Check a place against what was pushed, pull all of it; return one line for each loss or fault."""
    place, mine = open_place(address), SceneRegistry(home / "pulled")
    entries = {
        (s.scene_id, s.revision) for scene in {s for s, _ in pushed} for s in revisions_of(place, scene)
    }
    packs = {
        tuple(k.removesuffix(".simrecon").split("/")) for k in place.keys("packs") if k.endswith(".simrecon")
    }
    problems = [f"{pair}: no entry" for pair in sorted(pushed - entries)]
    problems += [f"{pair}: no pack" for pair in sorted(pushed - packs)]
    problems += [f"{pair}: nobody pushed it" for pair in sorted((entries | packs) - pushed)]
    if {s.scene_id for s in list_place(place)} != {scene for scene, _ in pushed}:
        problems.append("the list of scenes differs")
    for scene, revision in sorted(pushed):
        try:
            pull_scene(place, f"{scene}@{revision}", mine, replace=True)
        except SimReconError as error:
            problems.append(f"{scene}@{revision}: {error}")
    return problems + list(check_registry(mine, {scene for scene, _ in pushed}))


def judge_remote(home: Path, address: str, pushed: set[tuple[str, str]]) -> list[str]:
    """Check a registry at an address as a place, then rebuild its index from its packs and check that."""
    problems = judge_place(home, address, pushed)
    place = open_place(address)
    place.remove([shared.entry_key for shared in entries_of(place)])
    records, said = RemoteRegistry(home / "judge", address).rebuild()
    found = {(record.scene_id, record.revision) for record in records}
    problems += said + [f"{pair}: rebuilt, never published" for pair in sorted(found - pushed)]
    if {scene for scene, _ in found} != {scene for scene, _ in pushed}:
        problems.append("the rebuilt index has other scenes")
    return problems


def measure(home: Path, targets: list[str], processes: int, publishes: int) -> dict[str, dict[str, Any]]:
    """Write to all targets; return {target: result of `run_writers`}."""
    found: dict[str, dict[str, Any]] = {}
    for target in targets:
        with s3_server(_BUCKET) if target.startswith("s3") else contextlib.nullcontext():
            address = f"s3://{_BUCKET}/place" if target.startswith("s3") else str(home / target / "written")
            found[target] = run_writers(home / target, target, address, processes, publishes)
        print(f"{target}: {found[target]}", flush=True)
    return found


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.registry_writers",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--processes", type=int, default=8, help="writers (default 8)")
    parser.add_argument("--publishes", type=int, default=500, help="bundles in all (default 500)")
    parser.add_argument("--targets", default=",".join(TARGETS), help=f"default {','.join(TARGETS)}")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Write, judge and print; return 1 if something was lost or damaged."""
    options = build_parser().parse_args(arguments)
    targets = options.targets.split(",")
    try:
        if not set(targets) <= set(TARGETS) or not 1 <= options.processes <= options.publishes:
            raise UsageError(
                f"--targets: of {', '.join(TARGETS)}; --publishes: at least one for each process"
            )
        with tempfile.TemporaryDirectory() as temporary:
            found = measure(Path(temporary), targets, options.processes, options.publishes)
    except SimReconError as error:
        print(f"benchmarks.registry_writers: {error}", file=sys.stderr)
        return error.exit_code
    problems = [f"{target}: {line}" for target, result in found.items() for line in result["problems"]]
    print("\n".join(problems) or "nothing lost")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
