"""A scene and a file of labels in, outline scores out: what ties frames, lens and labels together."""

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
    """Measure a scene by outlines drawn by hand.

    Args:
        bundle: the scene.
        meshes: all of its meshes, base included, in its world.
        labels: a file that `load_outlines` reads.
        stages: where the frames are kept, the lens is measured on them; else the film counts as free of distortion.
        video: the video or folder of images that the scene was made from, where the stages are gone.

    Raises:
        UsageError: the labels cannot be read, or are not of this scene.
    """
    found = load_outlines(labels, _picture_names(bundle, stages, video))
    return score_outlines(bundle, meshes, found, _lens(stages))


def _lens(stages: StageResults) -> "Lens | None":
    from reconstruction.poses.lens import Lens

    frames, posed = stages.get("frames"), stages.get("poses")
    return None if frames is None or posed is None else Lens.measure(frames, posed)


def _picture_names(bundle: SceneBundle, stages: StageResults, video: Path | None) -> list[str] | None:
    """Return the images of a folder in name order, nothing for a video, None where the folder is not at hand."""
    from reconstruction.frames.decoding import ImageFolder

    posed = stages.get("poses")
    place = video or (None if posed is None else Path(posed.source.file))
    if place is not None and place.is_dir():
        return [file.name for file in ImageFolder(place).files]
    source = bundle.scene["source"]
    from_images = source["fps"] == 1.0 and source["duration_s"] == source["frame_count"]
    return None if from_images and (place is None or not place.is_file()) else []
