"""`simrecon check` on films of your own that are known to be good, and on the same films spoiled by image operations.

    python -m benchmarks.check_real FILM...

Of each film three spoiled ones are made, by turns, from its sampled frames: defocused, dark, one frame again
and again, a turn on the spot (one frame warped by homographies K R K^-1), a blank crop, a few
frames. They are bad by construction. Exit code 1 where
one is told wrongly.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.check_films import gained
from benchmarks.command import guarded
from reconstruction.precheck import judge_film, sample_film
from synthetic.videos import write_video

_COUNT = 40


def spoiled(images: np.ndarray, kind: str) -> np.ndarray:
    """Return a spoiled film uint8 (n, h, w, 3) of good frames uint8 (m, h, w, 3)."""
    rng = np.random.default_rng(7)
    middle = images[len(images) // 2]
    height, width = middle.shape[:2]
    if kind == "defocused":
        return np.stack([cv2.GaussianBlur(f, (0, 0), width / 60) for f in images])
    if kind == "dark":
        return gained(images, 2e-4, 3.0, rng)
    if kind == "still":
        return gained(np.repeat(middle[None], _COUNT, axis=0), 1.0, 2.0, rng)
    if kind == "turned":
        camera = np.array([[0.85 * width, 0, width / 2], [0, 0.85 * width, height / 2], [0, 0, 1]])
        out = []
        for angle in np.radians(np.linspace(-12, 12, _COUNT)):
            turn = Rotation.from_euler("yx", [angle, 0.3 * np.sin(3 * angle)]).as_matrix()
            warped = cv2.warpPerspective(middle, camera @ turn @ np.linalg.inv(camera), (width, height))
            out.append(warped[height // 5 : -height // 5, width // 4 : -width // 4])
        return gained(np.stack([f[: f.shape[0] // 2 * 2, : f.shape[1] // 2 * 2] for f in out]), 1.0, 1.5, rng)
    if kind == "blank":
        strength = cv2.boxFilter(
            np.abs(cv2.Laplacian(cv2.cvtColor(middle, cv2.COLOR_RGB2GRAY), cv2.CV_32F)), -1, (48, 48)
        )
        y, x = np.unravel_index(strength[24:-24, 24:-24].argmin(), (height - 48, width - 48))
        crop = cv2.resize(middle[y : y + 48, x : x + 48], (384, 288), interpolation=cv2.INTER_CUBIC)
        moved = [np.roll(crop, k, axis=1)[:, 40:-40] for k in range(_COUNT)]
        return gained(np.stack(moved), 1.0, 1.5, rng)
    return images[:6]


KINDS = ("defocused", "dark", "still", "turned", "blank", "few")


def _run(films: Sequence[Path]) -> int:
    wrong = bad = 0
    for row, path in enumerate(films):
        good = judge_film(path)
        wrong += good.fails
        print(f"{path}: {'FAILS' if good.fails else 'passes'} (good)", flush=True)
        images = sample_film(path).images
        images = images[:, : images.shape[1] // 2 * 2, : images.shape[2] // 2 * 2]
        for kind in (KINDS[(3 * row + k) % len(KINDS)] for k in range(3)):
            with tempfile.TemporaryDirectory() as folder:
                write_video(Path(folder) / "film.mp4", spoiled(images, kind), crf=20, preset="veryfast")
                report = judge_film(Path(folder) / "film.mp4")
            bad, wrong = bad + 1, wrong + (not report.fails)
            by = ", ".join(line.name for line in report.lines if line.status == "fail")
            print(f"  {kind}: {'fails' if report.fails else 'PASSES'} (bad) {by}", flush=True)
    print(f"{len(films)} good and {bad} bad films, {wrong} wrong")
    return 1 if wrong else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.check_real",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("films", type=Path, nargs="+", metavar="FILM")
    return guarded("benchmarks.check_real", lambda: _run(parser.parse_args(argv).films))


if __name__ == "__main__":
    sys.exit(main())
