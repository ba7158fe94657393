"""Match features: choose pairs, verify them geometrically, reject inconsistent ones, write COLMAP's database."""

from pathlib import Path

from reconstruction.core.progress import Progress
from reconstruction.core.types import FrameSet
from reconstruction.poses import mapping
from reconstruction.poses.colmap_types import ColmapCamera
from reconstruction.poses.components import label_parts, propose_bridges
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.consistency import reject_look_alikes
from reconstruction.poses.features import Features, overlap_scores
from reconstruction.poses.pairs import VerifiedPair, choose_pairs, verify_pairs

_NOTED_SHARE = 0.02  # of the pairs; fewer rejections are not worth a note


def matched_database(
    frames: FrameSet,
    features: list[Features],
    camera: ColmapCamera,
    config: PosesConfig,
    path: Path,
    progress: Progress,
) -> list[VerifiedPair]:
    """Match likely pairs and write the database at `path`; return the verified, consistent pairs."""
    pairs = consistent_pairs(frames, features, camera, config, progress)
    path.unlink(missing_ok=True)
    mapping.write_database(path, camera, features, pairs)
    return pairs


def consistent_pairs(
    frames: FrameSet, features: list[Features], camera: ColmapCamera, config: PosesConfig, progress: Progress
) -> list[VerifiedPair]:
    """Match likely pairs; return the verified ones that do not contradict each other."""
    progress.start(len(features) - 1, "overlap")
    scores = overlap_scores(features, progress)
    pairs = choose_pairs(scores, frames.ordered, config)
    progress.start(len(pairs), "matching")
    verified = verify_pairs(pairs, features, camera, config, progress)
    parts = label_parts(len(features), verified)
    bridges = propose_bridges(parts, scores, pairs)
    if bridges:
        progress.start(len(bridges), "joining parts")
        verified += verify_pairs(bridges, features, camera, config, progress)
    near = max(1, config.sequential_overlap // 2) if frames.ordered else 0
    size = (camera.width, camera.height)
    consistent = reject_look_alikes(verified, features, near, config.min_inliers, size)
    if consistent.rejected > _NOTED_SHARE * len(verified):
        progress.note(
            f"poses: {consistent.rejected} of {len(verified)} pairs of frames match copies of a thing at different "
            "places (tiles, posters, chairs); they are not used"
        )
    return consistent.pairs
