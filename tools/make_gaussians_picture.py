"""Draw what the Gaussians of a reconstructed scene show: color, depth and normals at the cameras of kept-out frames.

    python tools/make_gaussians_picture.py demo_room --out docs/images/gaussians.jpg
    python tools/make_gaussians_picture.py kitchen --rows 1 --no-frames --out docs/images/gaussians_kitchen.jpg

Reads the scene's stage results; reconstruct the scene first, with its work folder kept. A scene without kept-out frames
is drawn at keyframes, and this says so.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
_GAP = 4


def main() -> None:
    """Load, draw, write."""
    from reconstruction.measure.report.pictures import draw_gaussians
    from reconstruction.measure.stage_results import StageResults
    from registry import SceneRegistry

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene")
    parser.add_argument("--registry", type=Path)
    parser.add_argument("--work-dir", type=Path)
    parser.add_argument("--rows", type=int, default=2, help="frames drawn")
    parser.add_argument("--width", type=int, default=320, help="of one picture, in pixels")
    parser.add_argument("--no-frames", action="store_true", help="leave the video's own frames out")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    registry = SceneRegistry(arguments.registry)
    stages = StageResults.find(registry.load(arguments.scene), registry.root, arguments.work_dir)
    posed, _ = stages.in_world()
    gaussians, _ = stages.refined_in_world()
    if posed is None or gaussians is None:
        sys.exit(f"{arguments.scene}: its stage results are gone ({stages.missing}); reconstruct it again")
    frames, poses = posed.held_out_images, posed.held_out_world_from_camera
    if not len(frames):
        print(f"{arguments.scene} has no kept-out frames: drawn at keyframes")
        frames, poses = posed.images, posed.world_from_camera
    camera = posed.camera.resized(
        arguments.width, round(arguments.width * posed.camera.height / posed.camera.width)
    )
    count = min(arguments.rows, len(frames))
    rows = []
    for k in range(count):
        row = int((k + 0.5) * len(frames) / count)
        *items, _ = draw_gaussians(gaussians, camera, poses[row])
        if not arguments.no_frames:
            size = (camera.width, camera.height)
            items.insert(0, cv2.resize(np.asarray(frames[row]), size, interpolation=cv2.INTER_AREA))
        rows.append(
            np.hstack([np.pad(x, ((0, _GAP), (0, _GAP), (0, 0)), constant_values=255) for x in items])
        )
    picture = np.vstack(rows)[:-_GAP, :-_GAP]
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(arguments.out), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    print(arguments.out)


if __name__ == "__main__":
    main()
