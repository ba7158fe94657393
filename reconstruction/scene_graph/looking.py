"""One view per region: the viewpoint that shows most of all its things, drawn with their numbers."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.types import AssetSet
from reconstruction.gaussians.rasterizer import RasterSettings, rasterize
from reconstruction.scene_graph.base import Question
from reconstruction.scene_graph.set_of_marks import id_map, number_things
from reconstruction.views import AvoConfig, ViewScene, load_strategy, make_target

_SETTINGS = RasterSettings(near=0.02)
_LEAST_BASE_SHARE = 0.01  # of the picture: less of a floor or wall gets no number


@dataclass(frozen=True)
class RegionPicture:
    """What a model is shown of a region."""

    picture: np.ndarray  # uint8 (h, w, 3) RGB with outlines and numbers
    visible: tuple[int, ...]  # objects that have a number in it
    base: tuple[int, ...]  # floor and walls that have one
    origin: str  # how the view was found


class RegionViewer:
    """Chooses and draws views; the scene of Gaussians is prepared when the first one is asked for."""

    def __init__(
        self, assets: AssetSet, make_scene: Callable[[], ViewScene], side_px: int, least_visible: float
    ) -> None:
        """Nothing is computed yet.

        Args:
            assets: whose meshes say what is seen where.
            make_scene: the Gaussians with cameras and free space.
            side_px: longer side of the pictures.
            least_visible: share of a picture that a thing must cover to count as visible.
        """
        self._assets, self._make_scene = assets, make_scene
        self._side_px, self._least = side_px, least_visible
        self._scene: ViewScene | None = None
        self._base = {b.id: b.label for b in assets.base}

    def look(self, question: Question) -> RegionPicture | None:
        """Return the view of what a question is about; None where no view shows any of it.

        Each further attempt gets the next best view, which shows what the ones before did not.
        """
        if self._scene is None:
            self._scene = self._make_scene()
        scene = self._scene
        config = AvoConfig(
            views=question.attempt + 1, remaining_share=0.0, min_gain=0.0, back_weight=0.0, restarts=1
        )
        target = make_target(scene, question.about, config)
        if target is None:
            return None
        points = load_strategy(config.strategy).choose(scene, target, config)
        if not points:  # no free space to look from: the frames had to do, too
            config = replace(config, strategy="max-visibility")
            points = load_strategy(config.strategy).choose(scene, target, config)
        if not points:
            return None
        point = points[min(question.attempt, len(points) - 1)]
        factor = self._side_px / max(point.camera.width, point.camera.height)
        camera = point.camera.resized(round(point.camera.width * factor), round(point.camera.height * factor))
        color = rasterize(scene.packed, camera, point.world_from_camera, _SETTINGS).features[..., :3]
        ids = id_map(self._assets, camera, point.world_from_camera)
        picture = np.round(np.clip(color, 0, 1) * 255).astype(np.uint8)
        return self.numbered(picture, ids, question.visible, point.origin)

    def numbered(
        self, picture: np.ndarray, ids: np.ndarray, wanted: tuple[int, ...], origin: str
    ) -> RegionPicture | None:
        """Number those of the wanted objects that a picture shows; None where it shows none.

        Args:
            picture: uint8 (h, w, 3).
            ids: int (h, w) what is seen where.
            wanted: ids of objects.
            origin: how the view was found.
        """
        numbers, counts = np.unique(ids, return_counts=True)
        share = dict(zip(numbers.tolist(), (counts / ids.size).tolist()))
        things = [i for i in wanted if share.get(i, 0.0) >= self._least]
        base = [i for i in self._base if share.get(i, 0.0) >= _LEAST_BASE_SHARE]
        if not things:
            return None
        drawn = number_things(
            picture, ids, {i: str(i) for i in things}, {i: f"{self._base[i]} {i}" for i in base}
        )
        return RegionPicture(drawn, tuple(things), tuple(base), origin)
