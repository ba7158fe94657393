"""Views of many targets of one scene."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.views.config import AvoConfig
from reconstruction.views.inpainting import load_inpainter
from reconstruction.views.pictures import View, draw_view
from reconstruction.views.scene import ViewScene, make_target
from reconstruction.views.strategies import load_strategy


@dataclass(frozen=True)
class TargetViews:
    """The views of one target, the most informative first; none where nothing of it can be seen."""

    ids: tuple[int, ...]
    views: tuple[View, ...]
    distance_m: float  # d_target, 0 where nothing belongs to the target


def find_views(
    scene: ViewScene,
    targets: Iterable[int | Sequence[int]],
    config: AvoConfig | None = None,
    *,
    progress: Progress = NO_PROGRESS,
) -> list[TargetViews]:
    """Choose and draw views of each target.

    Args:
        scene: of `prepare_scene`, shared by all targets.
        targets: an instance id each, or the ids of a region, such as (7, 12, 15): the information of all of them
            counts together, one target distance shows them all, and `View.mask` is where any of them is seen. One view
            of a region: `config` with `views=1`.
        config: how; the strategy is part of it.
        progress: told of targets, and of those that cannot be seen.

    Returns:
        One entry a target, in their order; a target gets the same views alone and among others.

    Raises:
        UsageError: an unknown strategy or inpainter.
    """
    config = config or AvoConfig()
    strategy, inpainter = load_strategy(config.strategy), load_inpainter(config.inpainting)
    wanted, out = list(targets), []
    progress.start(len(wanted), "choosing views")
    for ids in wanted:
        target = make_target(scene, ids, config)
        if target is None:
            named = (int(ids),) if np.isscalar(ids) else tuple(sorted({int(i) for i in ids}))
            progress.note(f"No Gaussian belongs to {_named(named)}: no views of it.")
            out.append(TargetViews(named, (), 0.0))
            progress.advance()
            continue
        views = []
        for point in strategy.choose(scene, target, config):
            scale = config.picture_side_px / max(point.camera.width, point.camera.height)
            camera = point.camera.resized(
                round(point.camera.width * scale), round(point.camera.height * scale)
            )
            views.append(
                draw_view(
                    scene,
                    target,
                    camera,
                    point.world_from_camera,
                    point.origin,
                    point.gain,
                    point.fronts,
                    inpainter,
                )
            )
        if not views:
            progress.note(f"{_named(target.ids)} can be seen from nowhere in free space: no views of it.")
        out.append(TargetViews(target.ids, tuple(views), target.distance_m))
        progress.advance()
    return out


def _named(ids: tuple[int, ...]) -> str:
    return f"object {ids[0]}" if len(ids) == 1 else f"the region of {', '.join(map(str, ids))}"
