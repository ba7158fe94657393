"""Make the README's picture: a frame of the demo video, what was found in it, the assembled scene from there.

    python tools/make_pictures.py

Runs (or reuses) the reconstruction of the shipped video with default settings.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))


def main() -> None:
    """Reconstruct, draw, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--video", type=Path, default=ROOT / "examples" / "data" / "demo_room.mp4")
    parser.add_argument("--scene", default="demo_room")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "demo.png")
    arguments = parser.parse_args()
    from reconstruction.publish.preview import best_view, render_textured, scene_meshes
    from reconstruction.video_to_scene import reconstruct

    run = reconstruct(arguments.video, scene_id=arguments.scene).run
    posed, _ = run.in_world()
    assets, assembled, instances = (run.results[name] for name in ("assets", "assembly", "instances"))
    camera = posed.camera.resized(480, round(480 * posed.camera.height / posed.camera.width))
    row = best_view(assembled, posed, camera)
    size = (camera.width, camera.height)
    frame = cv2.resize(np.asarray(posed.images[row]), size, interpolation=cv2.INTER_AREA)
    ids = cv2.resize(np.asarray(instances.id_maps[row]), size, interpolation=cv2.INTER_NEAREST)
    scene, _ = render_textured(scene_meshes(assets, assembled), camera, posed.world_from_camera[row])
    gap = np.full((camera.height, 8, 3), 255, np.uint8)
    picture = np.hstack(
        [frame, gap, draw_instances(frame, ids, {o.id for o in instances.objects}), gap, scene]
    )
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(
        str(arguments.out), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9]
    )
    print(arguments.out)


def draw_instances(frame: np.ndarray, ids: np.ndarray, objects: set[int]) -> np.ndarray:
    """Tint and number every object in a frame; floor and walls stay gray."""
    picture = (0.35 * frame + 0.65 * np.array([205, 208, 212])).astype(np.uint8)
    for number, thing in enumerate(sorted(objects)):
        mask = ids == thing
        if mask.sum() < 30:
            continue
        hue = np.uint8([[[int(179 * (number * 0.381966 % 1.0)), 190, 235]]])
        color = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0]
        picture[mask] = (0.45 * frame[mask] + 0.55 * color).astype(np.uint8)
        rows, columns = np.nonzero(mask)
        place = (int(np.median(columns)) - 6, int(np.median(rows)) + 5)
        cv2.putText(picture, str(thing), place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(
            picture, str(thing), place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA
        )
    return picture


if __name__ == "__main__":
    main()
