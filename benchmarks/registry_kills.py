"""kill -9 at random moments of publish, pack, add and push: is everything that can be seen whole, and does it go on?

Usage:
    python -m benchmarks.registry_kills --kills 200 [--verbs publish,pack,…] [--seed N] [--json FILE]

The kills are spread evenly over the verbs. A process repeats its verb with two revisions of a scene in turn; it is
killed up to 0.25 s after its first turn, which is a random moment of a turn. After every kill:

- publish, add: the index has no malformed row, the scenes of the turns that were done are there, every scene verifies,
  every folder with the name of a revision is an intact bundle, no lock is held;
- pack: the file is that of one of the revisions, byte by byte;
- push (to a folder, and to an S3 server), publish_s3 (to a registry on that server): every entry of the index has its
  pack, every pack verifies, the scenes of the turns that were done are there.

At the end a new process does the verb again, or finishes every interrupted push. It must not wait, and must remove what
killed ones left more than a minute ago (the times of the files are set back). `left` counts kills that left a temporary
file or folder, or a pack without an entry: those certainly came in the middle of writing.
"""

import argparse
import contextlib
import itertools
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.s3_server import s3_server
from registry import SceneBundle, SceneRegistry, open_registry
from registry.errors import SimReconError, UsageError
from registry.exchange import add_scene, list_place, open_place, pack_scene, pull_scene, push_scene
from registry.exchange.sharing import entries_of, revisions_of
from registry.exchange.wholefile import scratch_folder
from registry.index_rows import is_revision
from registry.locks import is_locked
from synthetic.small_bundle import write_small_bundle

VERBS = ("publish", "pack", "add", "push", "push_s3", "publish_s3")
NAMES = ("one", "two")
_SCENES = ("room", "hall")  # of publish
_LONGEST_S = 0.25
_BUCKET = "kills"
_NEXT_S = 30.0  # a process that waits for a lock of a dead one would never end
ROOT = Path(__file__).parents[1]


# ---- The process that is killed.


def turn(verb: str, home: Path, number: int, address: str) -> None:
    """Do a verb once; the number chooses the revision, and the scene of a publish or the place of a push."""
    name = NAMES[number % 2]
    if verb == "publish":
        SceneRegistry(home / "registry").publish(home / name, _SCENES[number // 2 % 2])
    elif verb == "publish_s3":
        open_registry(address).publish(home / name, _SCENES[number // 2 % 2])
    elif verb == "pack":
        pack_scene(SceneBundle.open(home / name), home / "packed" / "room.simrecon")
    elif verb == "add":
        add_scene(home / f"{name}.simrecon", SceneRegistry(home / "registry"), replace=True)
    else:
        push_scene(SceneBundle.open(home / name), open_place(f"{address}_{number // 2}"))


def work(verb: str, home: Path, addresses: list[str], turns: int | None) -> None:
    """Repeat a verb, forever or some turns, and print the number of each turn that is done; or finish killed pushes."""
    if verb == "finish":
        for place, name in itertools.product(map(open_place, addresses), NAMES):
            push_scene(SceneBundle.open(home / name), place)
        return
    for number in itertools.count() if turns is None else range(turns):
        turn(verb, home, number, addresses[0])
        sys.stdout.write(f"{number}\n")
        sys.stdout.flush()


def _start(verb: str, home: Path, *addresses: str, turns: int | None = None) -> subprocess.Popen:
    command = [sys.executable, "-m", "benchmarks.registry_kills", "--worker", verb, str(home), *addresses]
    command += [] if turns is None else ["--turns", str(turns)]
    environment = {**os.environ, "TMPDIR": str(home / "tmp"), "SIMRECON_HOME": str(home)}
    return subprocess.Popen(command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True)


# ---- The judge.


def make_home(home: Path) -> None:
    """Write two revisions of a scene, as bundles and as packs."""
    (home / "tmp").mkdir(parents=True)
    for name in NAMES:
        write_small_bundle(home / name, "room", name)
        pack_scene(SceneBundle.open(home / name), home / f"{name}.simrecon")


def check_registry(registry: SceneRegistry, expected: set[str]) -> Iterator[str]:
    """Yield what is wrong with a registry in which no process is at work."""
    records, problems = registry.list_with_problems()
    yield from problems
    for missing in expected - {record.scene_id for record in records}:
        yield f"{missing}: lost"
    for record in records:
        yield from (f"{record.scene_id}: {line}" for line in registry.verify(record.scene_id).problems)
    for folder in registry.scenes_folder.glob("*/*"):
        if is_revision(folder.name):
            try:
                SceneBundle.open(folder, check_hashes=True)
            except SimReconError as error:
                yield f"half a scene: {error}"
    for lock in (registry.root / "locks").iterdir():
        if is_locked(lock):
            yield f"{lock.name}: held by nobody"


def check_place(address: str, checked: SceneRegistry) -> Iterator[str]:
    """Yield what is wrong with a place; every scene that it lists and every pack in it is verified."""
    place = open_place(address)
    entries = {(shared.scene_id, shared.revision) for shared in entries_of(place)}
    packs = [key for key in place.keys("packs") if key.endswith(".simrecon")]
    for scene, revision in sorted(entries):
        try:
            pull_scene(place, f"{scene}@{revision}", checked, replace=True)
        except SimReconError as error:
            yield f"{scene}@{revision} is listed: {error}"
    for key in packs:
        scene, revision = key.removesuffix(".simrecon").split("/")
        if (scene, revision) in entries:
            continue
        try:
            with scratch_folder("simrecon-kills-") as folder:
                place.fetch(f"packs/{key}", folder / "copy", 1 << 30)
                add_scene(folder / "copy", checked, replace=True, expected=(scene, revision))
        except SimReconError as error:
            yield f"{key} is half a pack: {error}"


def leftovers(home: Path, places: list[str]) -> set[str]:
    """Return the temporary files and folders below a home, and the packs without an entry in places."""
    found = [*(home / "tmp").iterdir(), *home.rglob(".*.tmp")]
    found += [*home.rglob("scenes/*/.publishing-*"), *home.rglob("scenes/*/.removing-*")]
    names = {str(path) for path in found}
    for place in map(open_place, places):
        entered = {f"{s.scene_id}/{s.revision}.simrecon" for s in entries_of(place)}
        packs = {key for key in place.keys("packs") if key.endswith(".simrecon")}
        names |= {f"{place.url}/packs/{key}" for key in packs - entered}
    return names


def run_kills(home: Path, verb: str, kills: int, chance: random.Random, address: str = "") -> dict[str, Any]:
    """Kill a verb so many times; return counts and problems.

    Args:
        home: A folder that does not exist.
        verb: One of `VERBS`.
        kills: How many processes are started and killed.
        chance: Chooses the moments.
        address: Beginning of the addresses that are pushed to; "" for folders below `home`.
    """
    make_home(home)
    address = address or str(home / "places" / "p")
    registry, checked = SceneRegistry(home / "registry"), SceneRegistry(home / "checked")
    problems: list[str] = []
    unfinished: list[str] = []
    turns = left = 0
    for number in range(kills):
        before = leftovers(home, [address] if verb == "publish_s3" else [])
        process = _start(verb, home, address if verb == "publish_s3" else f"{address}{number}")
        assert process.stdout is not None
        first = process.stdout.readline()  # the imports are over, and one turn is done
        time.sleep(chance.uniform(0, _LONGEST_S))
        process.kill()
        done = 1 + len(process.stdout.read().split())  # turns that are certainly done
        process.wait()
        if first != "0\n":
            problems.append(f"kill {number}: the process ended by itself")
            continue
        turns += done
        places = [f"{address}{number}_{k}" for k in sorted({0, done // 2})] if verb.startswith("push") else []
        if verb == "publish_s3":
            places = [address]
        else:
            unfinished += places[-1:]
        left += bool(leftovers(home, places[-1:]) - before)
        problems += [f"kill {number}: {line}" for line in _check(home, verb, done, places, registry, checked)]
    began = time.monotonic()
    problems += _go_on(home, verb, unfinished, address)
    next_s = round(time.monotonic() - began, 2)
    places = [address] if verb == "publish_s3" else unfinished
    problems += _check(home, verb, len(NAMES) * len(_SCENES), places, registry, checked)
    return {"kills": kills, "turns": turns, "left": left, "next_s": next_s, "problems": problems}


def _check(
    home: Path, verb: str, done: int, places: list[str], registry: SceneRegistry, checked: SceneRegistry
) -> Iterator[str]:
    """Yield what is wrong after so many turns."""
    if verb in ("publish", "add"):
        scenes = _SCENES if verb == "publish" and done > 2 else _SCENES[:1]
        yield from check_registry(registry, set(scenes))
    elif verb == "pack":
        whole = {(home / f"{name}.simrecon").read_bytes() for name in NAMES}
        if (home / "packed" / "room.simrecon").read_bytes() not in whole:
            yield "the pack is not whole"
    for place in places:
        yield from check_place(place, checked)
    if verb == "publish_s3":
        scenes = {shared.scene_id for shared in list_place(open_place(places[0]))}
        yield from (f"{name}: lost" for name in set(_SCENES if done > 2 else _SCENES[:1]) - scenes)


def _go_on(home: Path, verb: str, unfinished: list[str], address: str) -> Iterator[str]:
    """Do the verb again in a new process; yield what is wrong: it fails, waits, or leaves what killed ones left."""
    for path in leftovers(home, []):
        os.utime(path, (0, 0))  # younger ones could belong to a process at work
    process = _start("finish", home, *unfinished) if unfinished else _start(verb, home, address, turns=4)
    try:
        process.communicate(timeout=_NEXT_S + len(unfinished))
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
    if process.returncode:
        yield f"{verb} afterwards: exit code {process.returncode}"
    for path in sorted(leftovers(home, unfinished)):
        yield f"left for good: {path}"
    newest = SceneBundle.open(home / NAMES[-1]).revision
    for address in unfinished:
        found = [shared.revision for shared in revisions_of(open_place(address), "room")]
        if len(set(found)) != len(NAMES) or found[-1] != newest:
            yield f"{address}: {found}, expected both revisions and {newest} last"


def measure(home: Path, verbs: list[str], kills: int, seed: int) -> dict[str, dict[str, Any]]:
    """Spread the kills over the verbs; return {verb: result of `run_kills`}."""
    found: dict[str, dict[str, Any]] = {}
    with contextlib.ExitStack() as stack:
        if any(verb.endswith("_s3") for verb in verbs):
            stack.enter_context(s3_server(_BUCKET))
        for number, verb in enumerate(verbs):
            share = kills * (number + 1) // len(verbs) - kills * number // len(verbs)
            address = f"s3://{_BUCKET}/{verb}" if verb.endswith("_s3") else ""
            began = time.monotonic()
            found[verb] = run_kills(home / verb, verb, share, random.Random(f"{seed} {verb}"), address)
            found[verb]["wall_s"] = round(time.monotonic() - began, 1)
            print(f"{verb}: {found[verb]}", flush=True)
    return found


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.registry_kills",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--kills", type=int, default=200, help="kills in all (default 200)")
    parser.add_argument("--verbs", default=",".join(VERBS), help=f"default {','.join(VERBS)}")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    parser.add_argument("--worker", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--turns", type=int, help=argparse.SUPPRESS)
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Kill, judge and print; return 1 if something was half there, lost or stuck."""
    options = build_parser().parse_args(arguments)
    if options.worker:
        verb, home, *addresses = options.worker
        work(verb, Path(home), addresses, options.turns)
        return 0
    verbs = options.verbs.split(",")
    try:
        if options.kills < len(verbs) or not set(verbs) <= set(VERBS):
            raise UsageError(f"--verbs: of {', '.join(VERBS)}; --kills: at least one for each")
        with tempfile.TemporaryDirectory() as temporary:
            found = measure(Path(temporary), verbs, options.kills, options.seed)
    except SimReconError as error:
        print(f"benchmarks.registry_kills: {error}", file=sys.stderr)
        return error.exit_code
    problems = [f"{verb}: {line}" for verb, result in found.items() for line in result["problems"]]
    print("\n".join(problems) or f"{options.kills} kills: nothing half there, nothing lost, nothing stuck")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
