"""Measure the depth stage on rooms of held-out families, with one or several settings side by side.

    python -m priors.evaluate --splits shapes rooms --rooms 4 --photographs DIR --set prior=none --set prior=both

Every `--set` is one variant (several fields with commas: `--set prior=both,edge_rounds=0`). Rooms are numbered
from `--first`, apart from those of the dataset, and filmed anew; the whole depth stage runs, nothing else.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.depth_figures import TrueView, depth_figures
from priors.dataset import film_frames
from priors.rooms import HELD_OUT, SPLITS, Film, Sources, draw_film
from reconstruction.core.types import PosedFrames
from reconstruction.depth import DepthConfig, estimate_depth
from reconstruction.depth.images import sized_camera
from registry.errors import InputError, UsageError
from synthetic.film import render_truth

FIGURES = ("known", "measured", "median_rel", "off", "on_things", "on_things_each", "ring")


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m priors.evaluate", description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--splits",
        nargs="+",
        choices=SPLITS,
        default=["train", *HELD_OUT],
        help="which families (default: %(default)s)",
    )
    parser.add_argument("--rooms", type=int, default=4, help="of each split (default: %(default)s)")
    parser.add_argument(
        "--first", type=int, default=90_000, help="number of the first room (default: %(default)s)"
    )
    parser.add_argument("--frames", type=int, default=16, help="keyframes a room (default: %(default)s)")
    Sources.add_options(parser)
    parser.add_argument(
        "--set", action="append", default=[], metavar="A=B,C=D", help="a variant of DepthConfig"
    )
    parser.add_argument("--json", type=Path, help="write all figures there")
    parser.add_argument(
        "--pictures",
        type=Path,
        help="write a picture of each room there: frame, depth by variant, true depth",
    )
    options = parser.parse_args(arguments)
    Sources.check_options(parser, options, options.splits)
    variants = {
        text: _config(text, parser) for text in options.set or ["prior=none", "prior=mending", "prior=both"]
    }
    figures: dict[str, dict[str, list[dict]]] = {
        text: {split: [] for split in options.splits} for text in variants
    }
    for split in options.splits:
        for number in range(options.first, options.first + options.rooms):
            try:
                film = draw_film(split, number, Sources.of(options))
                posed, views = filmed(film, options.frames)
            except (InputError, UsageError) as error:
                print(f"{split} {number}: left out, {error}", flush=True)
                continue
            names = {i: str(i) for view in views for i in np.unique(view.ids) if i > film.base_entities}
            middle, shown = views[len(views) // 2], []
            for text, config in variants.items():
                maps = estimate_depth(posed, config)
                shown.append(maps.depth[middle.row])
                figures[text][split].append(depth_figures(maps, 1.0, views, names))
                print(split, number, text or "default", _row(figures[text][split][-1:]), flush=True)
            if options.pictures:
                options.pictures.mkdir(parents=True, exist_ok=True)
                _draw(
                    options.pictures / f"{split}_{number}.jpg", posed.images[middle.row], shown, middle.depth
                )
    print("\n| variant | split | rooms | " + " | ".join(FIGURES) + " |\n|" + " --- |" * (3 + len(FIGURES)))
    for text in variants:
        for split in options.splits:
            found = figures[text][split]
            print(f"| {text or 'default'} | {split} | {len(found)} | {_row(found)} |")
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n")
    return 0


def _config(text: str, parser: argparse.ArgumentParser) -> DepthConfig:
    config = DepthConfig()
    for pair in filter(None, text.split(",")):
        name, _, value = pair.partition("=")
        if not hasattr(config, name):
            parser.error(f"--set {pair}: DepthConfig has no field {name!r}")
        kind = type(getattr(config, name))
        config = replace(config, **{name: value == "true" if kind is bool else kind(value)})
    return config


def filmed(film: Film, frames: int) -> tuple[PosedFrames, list[TrueView]]:
    """Return a stretch of a film with the cameras that bundle adjustment would give, and its truth."""
    posed, path = film_frames(film, frames, "noisy")
    camera = sized_camera(posed.camera, DepthConfig().depth_side_px)
    truth = [render_truth(film.film_set, camera, pose) for pose in path]
    return posed, [TrueView(row, z, ids.astype(np.int32)) for row, (z, ids) in enumerate(truth)]


def _draw(path: Path, frame: np.ndarray, maps: list[np.ndarray], truth: np.ndarray) -> None:
    """Write a frame, depth maps (h, w) of it and the true one side by side; near is red, unknown black."""
    import cv2

    far, near = np.quantile(1 / truth[truth > 0], (0.01, 0.99))

    def color(depth: np.ndarray) -> np.ndarray:
        share = (1 / np.maximum(depth, 1e-6) - far) / max(near - far, 1e-9)
        out = cv2.applyColorMap((255 * np.clip(share, 0, 1)).astype(np.uint8), cv2.COLORMAP_TURBO)
        return np.where(depth[..., None] > 0, out, 0).astype(np.uint8)

    picture = cv2.resize(frame[..., ::-1], truth.shape[::-1], interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), np.hstack([picture, *(color(depth) for depth in [*maps, truth])]))


def _row(found: list[dict]) -> str:
    cells = []
    for name in FIGURES:
        values = [f[name] for f in found if f.get(name) is not None]
        cells.append(f"{100 * np.mean(values):.2f}" if values else "-")
    return " | ".join(cells)


if __name__ == "__main__":
    sys.exit(main())
