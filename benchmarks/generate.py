"""Generate benchmark captures: procedural rooms, filmed, with ground truth.

Usage:
    python -m benchmarks.generate --out DIR --suite            # the eight named captures of the suite
    python -m benchmarks.generate --out DIR --ci               # the two small ones
    python -m benchmarks.generate --out DIR --name room40      # one of them
    python -m benchmarks.generate --out DIR --preset cluttered --rooms 4 --objects 5-40 --seed 0

Each capture becomes DIR/<name>/{video.mp4, ground_truth/, capture.json}. What is already there is kept.
"""

import argparse
import sys
import time
from pathlib import Path

from registry.errors import SimReconError, UsageError
from synthetic.benchmark_capture import CaptureSpec, write_capture
from synthetic.suites import CI_CAPTURES, PRESETS, SUITE, drawn_captures
from synthetic.walks import WALKS


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.generate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the captures")
    named = parser.add_argument_group("named captures")
    named.add_argument("--suite", action="store_true", help=f"all of {', '.join(SUITE)}")
    named.add_argument("--ci", action="store_true", help=f"all of {', '.join(CI_CAPTURES)}")
    named.add_argument("--name", action="append", default=[], help="one of the above; may be repeated")
    drawn = parser.add_argument_group("drawn captures (without any of the above)")
    drawn.add_argument("--preset", choices=sorted(PRESETS), default="default", help="what is hard about them")
    drawn.add_argument("--rooms", type=int, default=1, help="how many")
    drawn.add_argument("--objects", default="5-40", help="number of things, or a range such as 5-40")
    drawn.add_argument("--seed", type=int, default=0, help="of the draw")
    drawn.add_argument("--frames", type=int, help="length of the film (140)")
    drawn.add_argument("--size", help="of the frames, such as 640x480")
    drawn.add_argument(
        "--path", choices=WALKS, help="the camera's way; a loop and a visit come with four walls"
    )
    drawn.add_argument("--textureless", type=float, help="share of things of one plain color per part")
    drawn.add_argument("--gap", type=float, help="smallest distance between neighbors, meters")
    drawn.add_argument("--exposure-drift", type=float, help="relative amplitude")
    drawn.add_argument("--motion-blur", type=float, help="shutter time, seconds")
    drawn.add_argument("--noise", type=float, help="standard deviation, 8-bit steps")
    return parser


def chosen_captures(options: argparse.Namespace) -> dict[str, CaptureSpec]:
    """Return the specs that a command line asks for."""
    known = {**CI_CAPTURES, **SUITE}
    unknown = sorted(set(options.name) - set(known))
    if unknown:
        raise UsageError(f"no capture is named {', '.join(unknown)}; there are {', '.join(known)}")
    if options.suite or options.ci or options.name:
        wanted = {*options.name, *(SUITE if options.suite else ()), *(CI_CAPTURES if options.ci else ())}
        return {name: spec for name, spec in known.items() if name in wanted}
    film = {
        "frames": options.frames,
        "path": options.path,
        "exposure_drift": options.exposure_drift,
        "motion_blur_s": options.motion_blur,
        "noise": options.noise,
    }
    if options.size is not None:
        film["width"], film["height"] = _numbers(options.size, "x", "--size", "640x480")
    room = {
        "textureless_share": options.textureless,
        "clutter_gap_m": options.gap,
        "walls": 4 if options.path in ("loop", "visit") else None,
    }
    low, high = _numbers(options.objects, "-", "--objects", "5-40")
    return drawn_captures(
        options.preset, options.rooms, (low, high), options.seed,
        room={k: v for k, v in room.items() if v is not None}, **{k: v for k, v in film.items() if v is not None},
    )  # fmt: skip


def _numbers(text: str, separator: str, flag: str, example: str) -> tuple[int, int]:
    try:
        parts = [int(part) for part in text.split(separator)]
    except ValueError:
        parts = []
    if flag == "--objects" and len(parts) == 1:
        parts *= 2
    if len(parts) != 2:
        raise UsageError(f"{flag} {text}: expected something like {example}")
    return parts[0], parts[1]


def main(arguments: list[str] | None = None) -> int:
    """Write captures; return the exit code."""
    options = build_parser().parse_args(arguments)
    try:
        for name, spec in chosen_captures(options).items():
            start = time.perf_counter()
            report = write_capture(spec, options.out / name)
            hidden = f" (hidden: {', '.join(report.hidden)})" if report.hidden else ""
            print(
                f"{report.folder}: {spec.frames} frames of {spec.width}x{spec.height}, "
                f"{report.evaluated_objects} of {report.objects} objects in sight{hidden}, "
                f"{time.perf_counter() - start:.0f} s",
                flush=True,
            )
    except SimReconError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
