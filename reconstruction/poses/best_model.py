"""Choose the model of a film: one where it is sure, else the best of models from starts all along the film."""

from pathlib import Path

from reconstruction.core.progress import Progress
from reconstruction.poses import diagnose, mapping
from reconstruction.poses.colmap_types import ColmapCamera, Reconstruction
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features
from reconstruction.poses.pairs import VerifiedPair
from reconstruction.poses.refine import keep_largest_part, refine_model

# Room 203 of docs/poses.md: a wrong model of a flat scene has 3 % more observations than the right one; room 401: the
# right one has 65 % more.
_DECISIVE = 1.1  # times as many frames or observations
_REFINED = 3  # of the other models, the largest


def best_model(
    models: list[Reconstruction], features: list[Features], pairs: list[VerifiedPair], camera: ColmapCamera,
    connected: int, config: PosesConfig, database: Path, progress: Progress,
) -> Reconstruction | None:  # fmt: skip
    """Refine the largest model; where it is doubtful, return the best of many.

    Doubtful: frames are missing, parts shrank to a point, or verified matches do not fit. The others are models from
    pairs all along the film, and that of the global mapper. Of each the largest part whose frames share enough points
    counts. The first one stays, unless others have as many frames and observations, and decidedly more of either.

    Args:
        models: of the incremental mapper, largest first.
        features: of the frames.
        pairs: of the frames, verified.
        camera: with a first focal length.
        connected: number of frames in the largest component of the match graph.
        config: when to try.
        database: of these features and pairs; models are written beside it.
        progress: receives a step for each start, and a note.
    """
    first, explained = None, 0.0
    if models:
        collapsed = diagnose.is_collapsed(models[0])
        enough = models[0].num_reg_images() >= config.second_try_below_share * connected
        first = refine_model(models[0], config)
        explained = diagnose.explained_share(first, features, pairs)
        if enough and not collapsed and explained >= config.second_try_below_explained:
            return first
        first = keep_largest_part(first)
    others = mapping.models_along_film(database, features, pairs, camera, config, progress)
    others += mapping.global_models(database, config)[:1]
    others = sorted([*models[1:], *others], key=_size, reverse=True)
    largest = [model for model in others if not diagnose.is_collapsed(model)][:_REFINED]
    best = _best(first, [keep_largest_part(refine_model(model, config)) for model in largest])
    progress.note(
        f"poses: of {connected} connected frames the first model has {_described(first)}, and {explained:.0%} of their "
        f"matches fit it; of {len(others)} others "
        + ("none is better" if best is first else f"one with {_described(best)} is kept")
    )
    return best


def _best(first: Reconstruction | None, others: list[Reconstruction]) -> Reconstruction | None:
    """Return the model with most frames, then observations, of those that are decidedly better than the first."""
    sound = [model for model in others if not diagnose.is_collapsed(model)]
    if first is not None and not diagnose.is_collapsed(first):
        frames, observations = _size(first)
        sizes = [_size(model) for model in sound]
        sound = [
            model for model, (n, k) in zip(sound, sizes)
            if n >= frames and k >= observations and (n > _DECISIVE * frames or k > _DECISIVE * observations)
        ]  # fmt: skip
    return max(sound, key=_size, default=first)


def _size(model: Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.compute_num_observations()


def _described(model: Reconstruction | None) -> str:
    frames, observations = (0, 0) if model is None else _size(model)
    return f"{frames} frames and {observations:,} observations"
