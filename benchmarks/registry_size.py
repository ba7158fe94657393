"""Time a registry of many scenes: import, look-ups, lists, splits, publishing, rebuilding, pulling one scene.

Usage:
    python -m benchmarks.registry_size --scenes 100000 [--home DIR] [--rebuild] [--json FILE]

Every scene is a small bundle of its own id that verifies; mesh files are hard links. Each act runs in a new process,
`--repeats` times, on files that are in the disk cache; wall and processor seconds are the medians. The import is timed
after `import gymnasium`, and stands beside the import with an empty registry. The place is a folder with an entry for
every scene and the packs of the first hundred. A home that holds the registry already is used again.
"""

import argparse
import hashlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from registry import SceneBundle, SceneRegistry
from registry.db import Index
from registry.errors import SimReconError, UsageError
from registry.exchange import open_place, push_scene
from synthetic.small_bundle import write_small_bundle

_PACKS = 100
_LINKS = 50_000  # of one file; ext4 has at most 65,000
_READY = "made.json"
_ENV_TIMED = "import gymnasium as gym"
_IN_PROCESS = "from registry import SceneRegistry, SceneNotFound\nfrom registry.exchange import *"
# (name, what is imported before, what is timed); {middle} is an id in the middle, {home} the folder.
ACTS = (
    ("import simrecon_envs, empty registry", _ENV_TIMED, "import simrecon_envs"),
    ("import simrecon_envs", _ENV_TIMED, "import simrecon_envs"),
    ("gym.spec of one", f"{_ENV_TIMED}, simrecon_envs", "gym.spec('SimRecon/{middle}')"),
    ("get one", _IN_PROCESS, "SceneRegistry().get('{middle}')"),
    ("load one with hashes", _IN_PROCESS, "SceneRegistry().load('{middle}', check_hashes=True)"),
    ("ids with revisions", _IN_PROCESS, "SceneRegistry().revisions()"),
    (
        "split into train and test by a hash",
        f"{_IN_PROCESS}\nfrom hashlib import sha256",
        "held = [k for k in SceneRegistry().revisions() if sha256(k.encode()).digest()[0] < 51]",
    ),
    ("list", _IN_PROCESS, "SceneRegistry().list()"),
    (
        "search by a figure",
        _IN_PROCESS,
        "[r for r in SceneRegistry().list() if r.metrics['n_dynamic'] >= 3]",
    ),
    ("search by a name", "import simrecon_envs", "simrecon_envs.list_scenes('*77?')"),
    ("next free id", _IN_PROCESS, "SceneRegistry().next_free_id()"),
    (
        "error of an unknown id",
        _IN_PROCESS,
        "try:\n    SceneRegistry().get('sceme77')\nexcept SceneNotFound:\n    pass",
    ),
    ("publish one more", _IN_PROCESS, "SceneRegistry().publish('{home}/bundle', 'one_more')"),
    ("remove it", _IN_PROCESS, "SceneRegistry().remove('one_more')"),
    ("list a place", _IN_PROCESS, "list_place(open_place('{home}/place'))"),
    ("list a place by a pattern", _IN_PROCESS, "list_place(open_place('{home}/place'), '{first}*')"),
    (
        "pull one",
        _IN_PROCESS,
        "pull_scene(open_place('{home}/place'), '{first}', SceneRegistry('{home}/mine'), scene_id='x{turn}')",
    ),
)


def make_home(home: Path, scenes: int) -> None:
    """Write a registry of so many scenes, a place of as many, and the bundle that they are copies of."""
    bundle_folder = home / "bundle"
    if not (bundle_folder / "manifest.json").exists():
        write_small_bundle(bundle_folder, "bundle")
    registry = SceneRegistry(home / "registry", create=True)
    model = registry.publish(bundle_folder, "model")
    index = Index(registry.root / "index.sqlite")
    row = index.row("model")
    assert row is not None
    files = SceneBundle.open(model.path).files
    folders = sorted({str(Path(name).parent) for name in files} - {"."})
    linked = [name for name in files if name != "scene.json"]
    text = (model.path / "scene.json").read_text()
    manifest = json.loads((model.path / "manifest.json").read_text())
    names = [scene_name(number) for number in range(scenes)]
    source = model.path
    for number, name in enumerate(names):
        folder = registry.scenes_folder / name / model.revision
        folder.mkdir(parents=True)
        for part in folders:
            (folder / part).mkdir(parents=True, exist_ok=True)
        for part in linked:
            if number % _LINKS:
                os.link(source / part, folder / part)
            else:
                shutil.copyfile(source / part, folder / part)
        source = source if number % _LINKS else folder
        data = text.replace('"id": "model"', f'"id": "{name}"').encode()
        (folder / "scene.json").write_bytes(data)
        entry = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
        files = {**manifest["files"], "scene.json": entry}
        (folder / "manifest.json").write_text(json.dumps({**manifest, "files": files}))
    index.put(*(replace(row, scene_id=name) for name in names))
    registry.remove("model")
    place = open_place(home / "place")
    pushed = [push_scene(registry.load(name), place).shared for name in names[:_PACKS]]
    sample = (home / "place" / pushed[0].entry_key).read_text()
    for name in names[_PACKS:]:
        shared = replace(pushed[0], scene_id=name)
        path = home / "place" / shared.entry_key
        path.parent.mkdir(parents=True)
        path.write_text(sample.replace(f'"{names[0]}"', f'"{name}"'))


def scene_name(number: int) -> str:
    """Return the id of a scene: names of rooms in no order, as those of many hands."""
    return f"room_{hashlib.sha256(str(number).encode()).hexdigest()[:6]}_{number}"


def time_act(home: Path, before: str, act: str, turn: int) -> tuple[float, float]:
    """Run an act in a new process; return its wall and processor seconds."""
    code = (
        f"{before}\nimport time\nwall, cpu = time.perf_counter(), time.process_time()\n{act}\n"
        "print(time.perf_counter() - wall, time.process_time() - cpu)"
    )
    environment = {**os.environ, "SIMRECON_HOME": str(home), "TURN": str(turn)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise UsageError(f"{act}: {done.stderr.strip().splitlines()[-1]}")
    wall, cpu = done.stdout.split()[-2:]
    return float(wall), float(cpu)


def measure(home: Path, scenes: int, repeats: int, rebuild: bool) -> dict[str, dict[str, float]]:
    """Time all acts; return {act: {"wall_s", "cpu_s"}}."""
    found: dict[str, dict[str, float]] = {}
    words = {"middle": scene_name(scenes // 2), "first": scene_name(0), "home": str(home)}
    for name, before, act in ACTS:
        place = home / "empty" if "empty registry" in name else home
        rows = []
        for turn in range(1 if name in ("publish one more", "remove it") else repeats):
            said = act.replace("{turn}", f"{turn}_{os.getpid()}")
            for word, value in words.items():
                said = said.replace(f"{{{word}}}", value)
            rows.append(time_act(place, before, said, turn))
        found[name] = {
            "wall_s": round(statistics.median(r[0] for r in rows), 4),
            "cpu_s": round(statistics.median(r[1] for r in rows), 4),
        }
        print(f"{name:38s} {found[name]['wall_s']:8.3f} s wall {found[name]['cpu_s']:8.3f} s CPU", flush=True)
    for name, verb in (("simrecon list", ["list"]),) + (
        (("simrecon registry rebuild", ["registry", "rebuild"]),) if rebuild else ()
    ):
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "reconstruction.cli", *verb],
            env={**os.environ, "SIMRECON_HOME": str(home)},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        found[name] = {"wall_s": round(time.perf_counter() - began, 2)}
        print(f"{name:38s} {found[name]['wall_s']:8.2f} s wall", flush=True)
    return found


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.registry_size",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--scenes", type=int, default=100_000, help="scenes (default 100000)")
    parser.add_argument("--repeats", type=int, default=5, help="processes for each act (default 5)")
    parser.add_argument("--rebuild", action="store_true", help="also rebuild the index: minutes")
    parser.add_argument("--home", type=Path, help="folder to work in, and to keep (default: a temporary one)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Make the registry, measure and print."""
    options = build_parser().parse_args(arguments)
    try:
        if options.scenes <= _PACKS:
            raise UsageError(f"--scenes: more than {_PACKS}")
        with tempfile.TemporaryDirectory() as temporary:
            home = (options.home or Path(temporary)).absolute()
            home.mkdir(parents=True, exist_ok=True)
            ready = home / _READY
            if not ready.exists():
                began = time.perf_counter()
                make_home(home, options.scenes)
                ready.write_text(json.dumps({"scenes": options.scenes}))
                print(f"made in {time.perf_counter() - began:.0f} s", flush=True)
            elif json.loads(ready.read_text())["scenes"] != options.scenes:
                raise UsageError(f"{home} holds another number of scenes; choose another --home")
            found = measure(home, options.scenes, options.repeats, options.rebuild)
    except SimReconError as error:
        print(f"benchmarks.registry_size: {error}", file=sys.stderr)
        return error.exit_code
    if options.json:
        options.json.write_text(json.dumps({"scenes": options.scenes, "acts": found}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
