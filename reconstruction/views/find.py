"""Choose and draw views of the targets of a scene."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.views.config import AvoConfig
from reconstruction.views.inpainting import load_inpainter
from reconstruction.views.pictures import View, draw_view
from reconstruction.views.scene import ViewScene, ids_of, make_target
from reconstruction.views.strategies import load_strategy


@dataclass(frozen=True)
class TargetViews:
    """The views of one target, the most informative first; empty if it cannot be seen."""

    ids: tuple[int, ...]
    views: tuple[View, ...]
    distance_m: float  # target distance d, 0 if no Gaussian belongs to the target


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
        targets: each an instance id, or the ids of a region, such as (7, 12, 15), whose objects are viewed as one. For
            a single view of a region use `config` with `views=1`.
        config: settings, including the strategy.
        progress: receives targets, and those that cannot be seen.

    Returns:
        One entry per target, in their order; it does not depend on the other targets.

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
            named = ids_of(ids)
            progress.note(f"views: no Gaussian belongs to {_named(named)}; it gets no views")
            out.append(TargetViews(named, (), 0.0))
            progress.advance()
            continue
        views = []
        for point in strategy.choose(scene, target, config):
            scale = config.picture_side_px / max(point.camera.width, point.camera.height)
            width, height = round(point.camera.width * scale), round(point.camera.height * scale)
            point = replace(point, camera=point.camera.resized(width, height))
            views.append(draw_view(scene, target, point, inpainter))
        if not views:
            progress.note(f"views: {_named(target.ids)} cannot be seen from free space; it gets no views")
        out.append(TargetViews(target.ids, tuple(views), target.distance_m))
        progress.advance()
    return out


def _named(ids: tuple[int, ...]) -> str:
    return f"object {ids[0]}" if len(ids) == 1 else f"the region of {', '.join(map(str, ids))}"
