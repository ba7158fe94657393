"""Score a scene against a file of outlines: reads the labels and the lens distortion, compares."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from reconstruction.measure.outline_files import load_outlines
from reconstruction.measure.outline_scores import OutlineScores, score_outlines
from reconstruction.measure.scene import PlacedMesh
from reconstruction.measure.stage_results import StageResults
from registry import SceneBundle

if TYPE_CHECKING:
    from reconstruction.poses.lens import Lens


def measure_outlines(
    bundle: SceneBundle,
    meshes: Sequence[PlacedMesh],
    labels: Path,
    stages: StageResults,
    video: Path | None = None,
) -> OutlineScores:
    """Score a scene against outlines drawn by hand.

    Args:
        bundle: the scene.
        meshes: all of its meshes, base included, in its world.
        labels: a file or folder for `load_outlines`.
        stages: gives the lens distortion; without the poses none is assumed.
        video: the scene's video or folder of images, if the stage results are missing.

    Raises:
        UsageError: the labels cannot be read, or are not of this scene.
    """
    found = load_outlines(labels, _picture_names(bundle, stages, video))
    return score_outlines(bundle, meshes, found, _lens(stages))


def _lens(stages: StageResults) -> "Lens | None":
    from reconstruction.poses.lens import Lens

    posed = stages.get("poses")
    return None if posed is None else Lens.of(posed)


def _picture_names(bundle: SceneBundle, stages: StageResults, video: Path | None) -> list[str] | None:
    """Return the image files in name order; [] for a video; None if the folder is missing."""
    from reconstruction.frames.decoding import ImageFolder

    posed = stages.get("poses")
    place = video or (None if posed is None else Path(posed.source.file))
    if place is not None and place.is_dir():
        return [file.name for file in ImageFolder(place).files]
    source = bundle.scene["source"]
    from_images = source["fps"] == 1.0 and source["duration_s"] == source["frame_count"]
    return None if from_images and (place is None or not place.is_file()) else []
