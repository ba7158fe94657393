"""Film generated rooms of a split as captures with ground truth, for `benchmarks.run` and `benchmarks.depth`.

    python -m priors.captures OUT --splits shapes rooms --rooms 3 --photographs DIR

Writes OUT/<split>_<number>/{video.mp4, ground_truth/}: the whole walk, the whole pipeline can run on it. Rooms are
numbered from `--first`, apart from those of the dataset. A capture that is there is kept.
"""

import argparse
import sys
from pathlib import Path

from priors.rooms import HELD_OUT, SPLITS, Film, Sources, draw_film
from registry.errors import InputError, UsageError
from synthetic.capture import write_ground_truth
from synthetic.film import iterate_film
from synthetic.videos import write_video

_FPS = 12.0


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m priors.captures", description=__doc__.split("\n\n")[0])
    add = parser.add_argument
    add("out", type=Path, help="folder of the captures")
    add(
        "--splits",
        nargs="+",
        choices=SPLITS,
        default=list(HELD_OUT),
        help="which families (default: held out)",
    )
    add("--rooms", type=int, default=3, help="of each split (default: %(default)s)")
    add("--first", type=int, default=90_000, help="number of the first room (default: %(default)s)")
    add("--frames", type=int, default=140, help="length of the film (default: %(default)s)")
    Sources.add_options(parser)
    options = parser.parse_args(arguments)
    Sources.check_options(parser, options, options.splits)
    for split in options.splits:
        number, made = options.first, 0
        while made < options.rooms:
            folder = options.out / f"{split}_{number}"
            try:
                if not (folder / "ground_truth" / "scene.json").is_file():
                    write_film(draw_film(split, number, Sources.of(options)), folder, options.frames)
                made += 1
                print(f"{folder}: there", flush=True)
            except (InputError, UsageError) as error:
                print(f"{folder}: left out, {error}", flush=True)
            number += 1
    return 0


def write_film(film: Film, folder: Path, frames: int) -> None:
    """Write a film of a stretch of the walk that sees things, and its ground truth (contract, section 3)."""
    film.keyframes(14)  # refuses a walk that sees too little
    camera, path = film.camera(640, 480), film.walk[:: max(len(film.walk) // frames, 1)][:frames]
    images = iterate_film(film.film_set, camera, path, film.sensor, seed=film.number, quick=True)
    folder.mkdir(parents=True, exist_ok=True)
    write_video(folder / "video.mp4", images, _FPS)
    write_ground_truth(folder / "ground_truth", film.room, film.film_set, camera, path, _FPS)


if __name__ == "__main__":
    sys.exit(main())
