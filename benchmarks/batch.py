"""Does a batch lose or repeat videos when workers and the driver are killed? Made films through `simrecon batch`.

Usage:
    python -m benchmarks.batch --videos 200 --real 20 --kill-every 20 --driver-kills 2 [--engine ray] [--json FILE]

Of the films, `--real` are short films of a generated room with the cheapest options of the real pipeline; the others
cannot be reconstructed (no video, empty, cut off, blank, at rest, …). Every `--kill-every` seconds a process of a
running video is killed by SIGKILL; `--driver-kills` times the driver is, and the same command is run again. With
`--full-disk S` work folders lie on a disk of their own, which is full for S seconds in the last run of the driver
(needs root on Linux, to mount it); a batch that stops for it is run again. Then every video must have ended as
expected, once, and a further run must do nothing.
"""

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psutil

from reconstruction.batch.journal import Journal, fold
from reconstruction.batch.outcomes import TRANSIENT
from registry import SceneRegistry
from registry.errors import SimReconError, UsageError

CHEAP = (
    *("frames.min_keyframes=12", "frames.max_keyframes=14", "frames.max_held_out=2"),
    *("poses.max_features=768", "depth.depth_side_px=160", "depth.sweep_side_px=120"),
    *("depth.planes=32", "gaussians.iterations=20", "gaussians.side_px=160"),
    *("gaussians.coarse_side_px=120", "gaussians.max_gaussians=5000", "surface.voxel_size_m=0.03"),
    *("surface.space_voxel_m=0.05", "assets.cells_along_longest=16", "assets.max_voxels=50000"),
    *("assets.texture_max_px=128", "assets.texture_frames=2", "assets.base_texel_m=0.05"),
    *("assembly.settle_s=0.5", "assembly.joint_settle_s=0.5", "world.max_frames=8"),
)
"""The cheapest options of the real pipeline that still give a scene."""
_MOST_STOPS = 5  # of a batch, before it counts as failed
_BROKEN = ("not_a_video", "empty", "cut_before_index", "black")
_WORKERS = ("reconstruction.batch.child", "ray::simrecon")


def make_films(folder: Path, videos: int, real: int) -> dict[str, str]:
    """Write films named `film0000.mp4` …; return the expected result by scene id.

    Real ones are made from every third frame of the generated film; no two files are equal.
    """
    from synthetic.videos import BAD_VIDEOS, standard_film, write_video

    folder.mkdir(parents=True, exist_ok=True)
    expected: dict[str, str] = {}
    broken = [name for name in _BROKEN if name in BAD_VIDEOS]
    for number in range(videos):
        path = folder / f"film{number:04d}.mp4"
        is_real = number * real // videos != (number + 1) * real // videos  # spread evenly
        expected[path.stem] = "published" if is_real else "failed"
        if is_real:
            made = sum(value == "published" for value in expected.values()) - 1
            write_video(path, standard_film()[made % 3 :: 3], crf=18 + made // 3 % 8, fps=10 + made // 24)
        else:
            BAD_VIDEOS[broken[number % len(broken)]](path)
    return expected


class Killer:
    """Kills a random process of a running video every so many seconds, while the block runs."""

    def __init__(self, every_s: float, seed: int) -> None:
        self.kills = 0
        self._every_s, self._random = every_s, random.Random(seed)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> "Killer":
        """Begin."""
        if self._every_s:
            self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """End."""
        self._stop.set()

    def _work(self) -> None:
        while not self._stop.wait(self._every_s):
            victims = [p for p in psutil.Process().children(recursive=True) if _is_worker(p)]
            if victims:
                try:
                    self._random.choice(victims).kill()
                    self.kills += 1
                except psutil.Error:
                    pass


class FullDisk:
    """A disk of its own for work folders, which is full for some seconds once `fill` is called."""

    _SIZE_MB, _LEFT_MB = 2048, 1  # a run wants 1.5 GB

    def __init__(self, folder: Path, full_s: float) -> None:
        self._folder, self._full_s, self._after_s = folder, full_s, 0.0
        self.thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> "FullDisk":
        """Mount it."""
        if self._full_s:
            self._folder.mkdir(parents=True, exist_ok=True)
            done = subprocess.run(
                ["mount", "-t", "tmpfs", "-o", f"size={self._SIZE_MB}m", "tmpfs", self._folder],
                capture_output=True,
                text=True,
            )
            if done.returncode:
                raise UsageError(f"--full-disk: cannot mount a disk at {self._folder}: {done.stderr.strip()}")
        return self

    def fill(self, after_s: float) -> None:
        """Fill it after some seconds; `thread` ends when it has been freed."""
        self._after_s = after_s
        if self._full_s:
            self.thread.start()

    def __exit__(self, *exc: object) -> None:
        """Unmount it."""
        if self._full_s:
            subprocess.run(["umount", "-l", self._folder], check=False)

    def _work(self) -> None:
        time.sleep(self._after_s)
        filler, end = self._folder / "filler", time.monotonic() + self._full_s
        block = bytes(1 << 20)
        while time.monotonic() < end:  # again and again: runs that end free some
            with contextlib.suppress(OSError), filler.open("ab", buffering=0) as stream:
                while psutil.disk_usage(str(self._folder)).free > self._LEFT_MB << 20:
                    stream.write(block)
            time.sleep(0.2)
        filler.unlink()


def _is_worker(process: psutil.Process) -> bool:
    try:
        return any(name in " ".join(process.cmdline()) for name in _WORKERS)
    except psutil.Error:
        return False


def run_batch(
    films: Path, home: Path, arguments: list[str], kill_after_s: float | None = None
) -> tuple[int, str]:
    """Run `simrecon batch`; kill the driver after some seconds; return (exit code, what it printed)."""
    command = [sys.executable, "-m", "reconstruction.cli", "batch", str(films), "--out", str(home / "out")]
    command += ["--registry", str(home / "registry"), "--work-dir", str(home / "work"), *arguments]
    with (home / "driver.log").open("ab") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            process.wait(kill_after_s)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
    return process.returncode


def judge(home: Path, expected: dict[str, str]) -> dict[str, Any]:
    """Compare journal and registry with the expectation; return counts and problems."""
    events = Journal(home / "out").events()
    states = fold(events)
    ends = Counter(
        e["scene"]
        for e in events
        if e["event"] == "ended"
        and (e["result"] == "published" or (e["result"] == "failed" and not _again(e)))
    )
    registry = SceneRegistry(home / "registry")
    revisions = registry.revisions()
    problems = [f"{scene}: lost" for scene in expected if ends[scene] == 0]
    problems += [f"{scene}: ended {ends[scene]} times" for scene in expected if ends[scene] > 1]
    for scene, result in expected.items():
        state = states.get(scene)
        if state is not None and state.result != result:
            problems.append(f"{scene}: {state.result} ({state.cause}), expected {result}")
        if state is not None and state.result == "failed" and not (state.cause and state.cure):
            problems.append(f"{scene}: failed without cause and cure")
    published = {scene for scene, state in states.items() if state.result == "published"}
    if published != set(revisions):
        problems.append(f"journal and registry differ: {sorted(published ^ set(revisions))}")
    problems += [f"{scene}: does not verify" for scene in revisions if not registry.verify(scene).ok]
    left = [p.name for p in (home / "registry" / "scenes").rglob(".publishing-*")]
    results = Counter(e["result"] for e in events if e["event"] == "ended")
    kinds = Counter(e["kind"] for e in events if e["event"] == "ended" and e["result"] == "retry")
    unended = sum(e["event"] == "started" for e in events) - sum(e["event"] == "ended" for e in events)
    times = [s.last_wall_s for s in states.values() if s.result == "published"]
    return {
        "videos": len(expected),
        "published": len(published),
        "failed": sum(state.result == "failed" for state in states.values()),
        "attempts": sum(e["event"] == "started" for e in events),
        "attempts_lost_with_the_driver": unended,
        "ends": dict(results),
        "retried_for": dict(kinds),
        "mean_published_s": round(sum(times) / len(times), 1) if times else None,
        "half_scenes": left,
        "problems": problems,
    }


def _again(event: dict[str, Any]) -> bool:
    """Return whether a failed video runs again in the next run of its batch."""
    return event["kind"] in TRANSIENT


def measure(options: argparse.Namespace, home: Path) -> dict[str, Any]:
    """Make the films, run the batch with kills, and judge it."""
    films = home / "films"
    expected = make_films(films, options.videos, options.real)
    arguments = [
        "--preset",
        "fast",
        "--engine",
        options.engine,
        "--retries",
        "8",
        "--memory",
        "1",
        "--no-reports",
    ]
    arguments += ["--at-once", str(options.at_once), "--cores", "1", "--drop-work"]
    for option in CHEAP:
        arguments += ["--set", option]
    began, drivers = time.monotonic(), 0
    chance = random.Random(options.seed)
    with (
        FullDisk(home / "work", options.full_disk) as disk,
        Killer(options.kill_every, options.seed) as killer,
    ):
        for _ in range(options.driver_kills):
            code = run_batch(
                films, home, arguments, kill_after_s=chance.uniform(0.5, 1.5) * options.driver_life
            )
            drivers += code == -signal.SIGKILL
        disk.fill(after_s=options.driver_life / 2)
        code = run_batch(films, home, arguments)
        stops = 0
        while (
            code == 4 and stops < _MOST_STOPS
        ):  # killed more often than it is retried, or stopped by the full disk
            stops += 1
            if options.full_disk:
                disk.thread.join()
            code = run_batch(films, home, arguments)
        seconds = time.monotonic() - began
        found = judge(home, expected)
        before = SceneRegistry(home / "registry").revisions()
        lines = len(Journal(home / "out").events())
        again = time.monotonic()
        run_batch(films, home, arguments)
    if len(Journal(home / "out").events()) != lines or SceneRegistry(home / "registry").revisions() != before:
        found["problems"].append("a further run did something")
    return {
        "engine": options.engine,
        "wall_s": round(seconds, 1),
        "worker_kills": killer.kills,
        "driver_kills": drivers,
        "full_disk_s": options.full_disk,
        "stops": stops,
        "exit_code": code,
        "again_s": round(time.monotonic() - again, 1),
        **found,
    }


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.batch",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--videos", type=int, default=200, help="films in all (default 200)")
    add("--real", type=int, default=20, help="films that reconstruct, among them (default 20)")
    add(
        "--kill-every",
        type=float,
        default=20.0,
        metavar="S",
        help="seconds between kills; 0: none (default 20)",
    )
    add("--driver-kills", type=int, default=2, help="kills of the driver (default 2)")
    add("--driver-life", type=float, default=90.0, metavar="S", help="mean seconds until a driver is killed")
    add(
        "--full-disk",
        type=float,
        default=0.0,
        metavar="S",
        help="seconds that the disk of work folders is full",
    )
    add("--at-once", type=int, default=2, help="videos at the same time (default 2)")
    add("--engine", default="local", help="local (default) or ray")
    add("--seed", type=int, default=0, help="of the kills")
    add("--home", type=Path, help="folder to work in, and to keep (default: a temporary one)")
    add("--json", type=Path, metavar="FILE", help="write the figures")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; return 1 if a video was lost, repeated or ended otherwise than expected."""
    options = build_parser().parse_args(arguments)
    try:
        if not 0 <= options.real <= options.videos or options.videos < 1:
            raise UsageError("--real must be between 0 and --videos")
        with tempfile.TemporaryDirectory() as temporary:
            home = options.home or Path(temporary)
            home.mkdir(parents=True, exist_ok=True)
            os.environ["SIMRECON_HOME"] = str(home)
            found = measure(options, home.absolute())
    except SimReconError as error:
        print(f"benchmarks.batch: {error}", file=sys.stderr)
        return error.exit_code
    print(json.dumps(found, indent=2))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return 1 if found["problems"] else 0


if __name__ == "__main__":
    sys.exit(main())
