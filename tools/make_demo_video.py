"""Film the demo room: writes examples/data/demo_room.mp4 and demo_room_truth.json; deterministic.

Usage: python tools/make_demo_video.py [--out DIR] [--seed 0] [--ground-truth DIR]

`--ground-truth` also writes true meshes, depth and instance images as the evaluation reads them (30 MB).
"""

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # runs from a checkout that is not installed

from synthetic.camera_paths import handheld_path, phone_camera
from synthetic.capture import truth_as_json, write_ground_truth
from synthetic.film import iterate_film, prepare
from synthetic.room import build_room
from synthetic.sensor import Sensor
from synthetic.videos import write_video

WIDTH, HEIGHT, FPS, FRAMES = 640, 480, 12.0, 120
SENSOR = Sensor(noise=1.4, exposure_drift=0.05, blur_shutter=0.10, blur_samples=2)


def main() -> None:
    """Make the video and its truth."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "examples" / "data")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ground-truth", type=Path, help="also write the full ground truth into this folder")
    options = parser.parse_args()

    room = build_room(options.seed, step_m=0.02)
    film_set = prepare(room)
    camera = phone_camera(WIDTH, HEIGHT)
    path = handheld_path(FRAMES, seed=options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    video = options.out / "demo_room.mp4"
    write_video(
        video, iterate_film(film_set, camera, path, SENSOR, seed=options.seed), FPS, crf=20, preset="slow"
    )
    truth = truth_as_json(room, camera, path, FPS)
    # One frame and one entity per line: small, and readable in a diff.
    body = json.dumps({k: v for k, v in truth.items() if k not in ("frames", "entities")})[1:-1]
    lists = (
        f'"{k}": [\n' + ",\n".join(json.dumps(item) for item in truth[k]) + "\n]"
        for k in ("entities", "frames")
    )
    (options.out / "demo_room_truth.json").write_text("{" + body + ",\n" + ",\n".join(lists) + "}\n")
    print(f"{video}: {video.stat().st_size / 1e6:.2f} MB, {FRAMES} frames")
    if options.ground_truth:
        write_ground_truth(options.ground_truth, room, film_set, camera, path, FPS)
        print(f"{options.ground_truth}: ground truth")


if __name__ == "__main__":
    main()
