"""Films as phones take them: does each end right, or with one clear line?

    python -m benchmarks.phones OUT               films, results and table.md, table.json in OUT/seed_<seed>
    python -m benchmarks.phones OUT --seed 3      another room, hand and noise
    python -m benchmarks.phones OUT --only zoom   films whose name has that in it

Stages frames and poses (preset fast) run on every film of `benchmarks.phone_films.FILMS`, depth only with --depth.
Films and results in OUT are kept: the same command continues an interrupted run.

A film is `right` where 90 % of its keyframes have poses,
cameras are within 3 % of the extent of the path (RMSE after alignment; both limits are those of `benchmarks.check`),
the focal length is within 3 % and keyframes have the film's colors within 8 of 255 levels (mean absolute difference;
codecs make up to 5); `part` where that holds for a part of the film and a note says so; `refused` where it ends with
an error of one line; else `wrong` or `crashed`.
"""

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np

from benchmarks.command import guarded
from benchmarks.phone_films import FILMS, PhoneFilm, Truth, make_film
from reconstruction.core.progress import NoProgress
from reconstruction.core.types import DepthMaps, FrameSet, PosedFrames
from reconstruction.depth import DEPTH_PRESETS, estimate_depth
from reconstruction.frames import FRAMES_PRESETS, load_frames
from reconstruction.poses import POSES_PRESETS, estimate_poses
from registry.errors import SimReconError
from registry.geometry import split_similarity, transform_points, umeyama

_REGISTERED, _ERROR, _FOCAL, _LEVELS = 0.9, 0.03, 0.03, 8.0
_DEPTH_OFF = 0.1  # relative; depth of a passer-by instead of the room is off by more


@dataclass
class Outcome:
    """Verdict and measured errors of one film."""

    film: str
    verdict: str = "crashed"
    registered: float = 0.0  # share of the keyframes
    used_s: float = 0.0  # time from the first to the last registered keyframe, as a share of the film
    camera_error: float = float("nan")  # RMSE of the centers, as a share of the extent of the path
    rotation_deg: float = float("nan")  # RMSE
    focal_error: float = float("nan")  # relative
    levels_off: float = float("nan")  # mean absolute difference of keyframes to the film, of 255
    passers_depth: float = float("nan")  # share of passers' pixels whose depth is not the room's
    wrong_depth: float = float("nan")  # the same of all pixels
    seconds: float = 0.0
    message: str = ""
    notes: list[str] = field(default_factory=list)


class _Notes(NoProgress):
    def __init__(self) -> None:
        self.said: list[str] = []

    def note(self, message: str) -> None:
        self.said.append(message)


def judge(film: PhoneFilm, video: Path, truth: Truth, *, with_depth: bool) -> Outcome:
    """Run the stages on a film and compare with the truth."""
    out, notes, start = Outcome(film.name), _Notes(), time.monotonic()
    try:
        with tempfile.TemporaryDirectory() as scratch:
            frames = load_frames(video, FRAMES_PRESETS["fast"], progress=notes)
            posed = estimate_poses(frames, POSES_PRESETS["fast"], work_dir=Path(scratch), progress=notes)
        _compare(out, frames, posed, truth)
        if with_depth:
            _compare_depth(out, estimate_depth(posed, DEPTH_PRESETS["fast"], progress=notes), posed, truth)
        out.verdict = _verdict(out, notes.said)
    except SimReconError as error:
        out.message = str(error)
        out.verdict = "refused" if "\n" not in out.message else "wrong"
    except Exception as error:  # the table tells every one of them
        out.message = f"{type(error).__name__}: {error}"
    out.seconds, out.notes = round(time.monotonic() - start, 1), notes.said
    return out


def _compare(out: Outcome, frames: FrameSet, posed: PosedFrames, truth: Truth) -> None:
    """Fill in the figures of frames and poses."""
    rows = posed.indices
    true, found = truth.world_from_camera[rows], posed.world_from_camera
    similarity = umeyama(found[:, :3, 3], true[:, :3, 3])
    moved = transform_points(similarity, found[:, :3, 3])
    extent = ((true[:, :3, 3] - true[:, :3, 3].mean(0)) ** 2).sum(1).mean()
    out.registered = round(len(rows) / posed.chosen_frames, 3)
    out.used_s = round(float(np.ptp(posed.times_s) / np.ptp(truth.times_s)), 3)
    out.camera_error = round(float(np.sqrt(((moved - true[:, :3, 3]) ** 2).sum(1).mean() / extent)), 5)
    _, turn, _ = split_similarity(similarity)
    trace = np.einsum("nij,nij->n", turn @ found[:, :3, :3], true[:, :3, :3])
    angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    out.rotation_deg = round(float(np.sqrt((angle**2).mean())), 3)
    focal = (posed.distorted.params[0] if posed.distorted else posed.camera.fx) / truth.focal_px[rows]
    out.focal_error = round(float(np.abs(focal - 1).max()), 4)
    filmed = truth.frames[frames.indices]
    if filmed.shape == frames.images.shape:
        out.levels_off = round(float(np.abs(filmed.astype(np.int16) - frames.images).mean()), 2)


def _compare_depth(out: Outcome, maps: DepthMaps, posed: PosedFrames, truth: Truth) -> None:
    """Fill in the shares of pixels whose depth is not that of the room."""
    scale, _, _ = split_similarity(
        umeyama(posed.world_from_camera[:, :3, 3], truth.world_from_camera[posed.indices, :3, 3])
    )
    size = maps.depth.shape[2], maps.depth.shape[1]
    wrong, people = [], []
    for row, index in enumerate(posed.indices):
        true = cv2.resize(truth.depth[index], size, interpolation=cv2.INTER_NEAREST)
        mask = cv2.resize(truth.passers[index].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        known = maps.depth[row] > 0
        wrong.append(known & (np.abs(scale * maps.depth[row] / np.maximum(true, 1e-6) - 1) > _DEPTH_OFF))
        people.append(mask)
    wrong, people = np.stack(wrong), np.stack(people)
    out.passers_depth, out.wrong_depth = round(float(wrong[people].mean()), 4), round(float(wrong.mean()), 4)


def _verdict(out: Outcome, notes: Sequence[str]) -> str:
    good = (
        out.registered >= _REGISTERED
        and out.camera_error < _ERROR
        and out.focal_error < _FOCAL
        and not out.levels_off > _LEVELS
    )
    if not good:
        return "wrong"
    told = any("zoom" in n or "not registered" in n for n in notes)
    return "right" if out.used_s > _REGISTERED else "part" if told else "wrong"


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a Markdown table, and the count of each verdict."""
    head = "| film | ends | keyframes with pose | camera error | turned | focal length | color | seconds |"
    lines = [head, "|" + " --- |" * 8]
    for o in outcomes:
        figures = "".join(
            f" {text} |"
            for text in (
                f"{100 * o.registered:.0f} %",
                f"{100 * o.camera_error:.2f} %",
                f"{o.rotation_deg:.2f}°",
                f"{100 * o.focal_error:.1f} %",
                f"{o.levels_off:.1f}",
                f"{o.seconds:.0f}",
            )
        )
        lines.append(f"| {o.film} | {o.verdict}{': ' + o.message if o.message else ''} |{figures}")
    counts = Counter(o.verdict for o in outcomes)
    return "\n".join(lines) + "\n\n" + ", ".join(f"{n} {name}" for name, n in counts.items()) + "\n"


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.phones",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--seed", type=int, default=1, help="of room, hand and noise (default 1)")
    parser.add_argument("--only", default="", help="films whose name has this in it")
    parser.add_argument("--depth", action="store_true", help="also depth, of films with passers-by")
    parser.add_argument("--results", default="results", help="folder of the results, beside the films")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks.phones", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    folder = arguments.out / f"seed_{arguments.seed}"
    results = folder / arguments.results
    results.mkdir(parents=True, exist_ok=True)
    outcomes = []
    for film in (f for f in FILMS if arguments.only in f.name):
        kept = results / f"{film.name}.json"
        if not kept.exists():
            video = make_film(film, arguments.seed, folder / "films" / film.name)
            truth = Truth.load(video.parent)
            outcome = judge(film, video, truth, with_depth=arguments.depth and film.passers > 0)
            kept.write_text(json.dumps(asdict(outcome), indent=1) + "\n")
        outcomes.append(Outcome(**json.loads(kept.read_text())))
        last = outcomes[-1]
        print(f"{film.name}: {last.verdict}, {100 * last.camera_error:.2f} % {last.message}", flush=True)
    (results / "table.json").write_text(json.dumps([asdict(o) for o in outcomes], indent=1) + "\n")
    (results / "table.md").write_text(table(outcomes))
    print(table(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
