"""Segment the frames of a scene with your own tool, and reconstruct its objects from these masks.

    python examples/06_masks_from_any_tool.py my_room --out masks
    simrecon reconstruct my_room.mp4 --scene my_room --set instances.masks=folder --set instances.masks_path=masks

Reads the undistorted frames with known cameras from the scene's stage results, and writes one id image per frame, named
by frame number. Replace `segment`, here a color segmentation (Felzenszwalb) that runs anywhere, by your model. See
docs/masks.md.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from skimage.segmentation import felzenszwalb

from reconstruction.instances.masks import flatten_masks
from reconstruction.measure.stage_results import StageResults
from registry import SceneRegistry


def segment(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return masks bool (k, h, w), which may overlap, and scores (k,) of an RGB image uint8 (h, w, 3)."""
    patches = felzenszwalb(image, scale=400, sigma=1.0, min_size=image.shape[0] * image.shape[1] // 400)
    masks = np.stack([patches == number for number in range(patches.max() + 1)])
    return masks, np.ones(len(masks))


def main() -> None:
    """Write one id image per frame."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--registry", type=Path, default=None)
    parser.add_argument(
        "--work-dir", type=Path, default=None, help="the one that the scene was made with, if any"
    )
    arguments = parser.parse_args()

    registry = SceneRegistry(arguments.registry)
    results = StageResults.find(registry.load(arguments.scene), registry.root, arguments.work_dir)
    posed = results.get("poses")
    if posed is None:
        parser.error(f"the frames of {arguments.scene} cannot be had: {results.missing['poses']}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    for index, image in zip(posed.indices, posed.images):
        ids = flatten_masks(*segment(np.asarray(image)))
        cv2.imwrite(str(arguments.out / f"{index:05d}.png"), ids)
    print(f"{len(posed.images)} id images in {arguments.out}")


if __name__ == "__main__":
    main()
