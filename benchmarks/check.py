"""How well `simrecon check` tells good films of generated rooms from bad ones.

    python -m benchmarks.check make FOLDER       films rooms, well and badly; labels by the poses stage (25 minutes)
    python -m benchmarks.check measure FOLDER    figures of all generated films
    python -m benchmarks.check fit FOLDER        limits of `reconstruction/precheck/limits.py` from the splits
    python -m benchmarks.check report FOLDER     confusion on each split; which films are wrong

A limit of a figure is the geometric middle between the worst good film and the nearest bad film beyond it, both of the
split "fit": no good film of it fails. Figures whose limit fails a good film of
the split "choose" are left out. The split "report" takes part in neither.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.check_films import SPLITS, make_films
from benchmarks.command import guarded
from reconstruction.precheck import measure_film, sample_film
from reconstruction.precheck.limits import FAIL_LIMITS, HIGH, fails
from registry.errors import UsageError

LOW = ("matches", "spread", "parallax_deg", "connected", "bright")
"""Figures of which less is worse."""


def measured(folder: Path, split: str) -> list[tuple[dict, dict[str, float]]]:
    """Return (label, figures) of the measured films of a split; films between good and bad are left out."""
    out = []
    for file in sorted((folder / split).glob("*/figures.json")):
        label = json.loads(file.with_name("label.json").read_text())
        if label["label"] in ("good", "bad"):
            out.append((label, json.loads(file.read_text())))
    if not out:
        raise UsageError(f"{folder / split}: no measured film; run make and measure first")
    return out


def fit_limits(films: list[tuple[dict, dict[str, float]]]) -> dict[str, float]:
    """Return the limit of each figure: the geometric middle of the gap beside the worst good film."""
    limits = {}
    for name in (*LOW, *HIGH):
        sign = 1.0 if name in LOW else -1.0
        good = [sign * figures[name] for label, figures in films if label["label"] == "good"]
        bad = [sign * figures[name] for label, figures in films if label["label"] == "bad"]
        beyond = [value for value in bad if value < min(good)]
        if beyond:
            pair = np.abs([min(good), max(beyond)])
            limits[name] = float(np.sqrt(pair[0] * pair[1])) if pair.min() > 0 else float(pair.mean())
    return limits


def confusion(films: list[tuple[dict, dict[str, float]]], limits: dict[str, float]) -> dict[str, list[str]]:
    """Return names of films by outcome: "good, fails" and "bad, passes" are the wrong ones."""
    out: dict[str, list[str]] = {"good, passes": [], "good, fails": [], "bad, fails": [], "bad, passes": []}
    for label, figures in films:
        said = "fails" if fails(figures, limits) else "passes"
        out[f"{label['label']}, {said}"].append(f"{label['seed']}_{label['kind']}")
    return out


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.check",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("step", choices=("make", "measure", "fit", "report"))
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks.check", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    folder = arguments.folder
    if arguments.step == "make":
        for split, seeds in SPLITS.items():
            for seed in seeds:
                made = make_films(split, seed, folder / split)
                print(split, *(film.name for film in made), flush=True)
    elif arguments.step == "measure":
        for label in sorted(folder.glob("*/*/label.json")):
            if not label.with_name("figures.json").exists():
                figures = measure_film(sample_film(label.with_name("video.mp4"))).judged()
                label.with_name("figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    elif arguments.step == "fit":
        limits = fit_limits(measured(folder, "fit"))
        chosen = measured(folder, "choose")
        for name in list(limits):
            wrong = confusion(chosen, {name: limits[name]})["good, fails"]
            print(f"{name}: {limits[name]:.3g}" + (f", left out: fails {', '.join(wrong)}" if wrong else ""))
    else:
        for split in SPLITS:
            found = confusion(measured(folder, split), FAIL_LIMITS)
            print(f"{split}: " + "; ".join(f"{name}: {len(films)}" for name, films in found.items()))
            print(f"  wrong: {', '.join(found['good, fails'] + found['bad, passes']) or 'none'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
