"""The stage `views`: views of every object, for generators, vision-language models and users."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import InstanceSet
from reconstruction.views.config import AvoConfig
from reconstruction.views.find import TargetViews, find_views
from reconstruction.views.pictures import View

if TYPE_CHECKING:
    from reconstruction.views.scene import ViewScene


@dataclass(frozen=True)
class SceneViews:
    """The views of each object, in the order of `InstanceSet.objects`."""

    strategy: str  # `AvoConfig.strategy`
    targets: tuple[TargetViews, ...]

    def of(self, number: int) -> tuple[View, ...]:
        """Return the views of the object with an id, the most informative first; empty if it cannot be seen."""
        return next((target.views for target in self.targets if target.ids == (number,)), ())


def make_views(
    scene: "ViewScene", instances: InstanceSet, config: AvoConfig, *, progress: Progress = NO_PROGRESS
) -> SceneViews:
    """Choose and draw the views of every object.

    Args:
        scene: of `prepare_scene`, in world space, metres.
        instances: whose objects are viewed.
        config: settings.
        progress: receives objects, and those that cannot be seen.

    Raises:
        UsageError: an unknown strategy or inpainter.
    """
    found = find_views(scene, [item.id for item in instances.objects], config, progress=progress)
    return SceneViews(config.strategy, tuple(found))
