"""Render a view of each region from the viewpoint that shows most of its objects, with numbered objects."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.types import AssetSet
from reconstruction.gaussians.rasterizer import RasterSettings, rasterize
from reconstruction.scene_graph.base import Question
from reconstruction.scene_graph.set_of_marks import id_map, number_things
from reconstruction.views import AvoConfig, ViewScene, load_strategy, make_target

_SETTINGS = RasterSettings(near=0.02)
_LEAST_BASE_SHARE = 0.01  # of the picture, that a numbered base surface covers


@dataclass(frozen=True)
class RegionPicture:
    """The view of a region that a model is shown."""

    picture: np.ndarray  # uint8 (h, w, 3) RGB with outlines and numbers
    visible: tuple[int, ...]  # numbered objects
    base: tuple[int, ...]  # numbered base surfaces
    origin: str  # how the viewpoint was found


class RegionViewer:
    """Selects viewpoints and renders views; the Gaussians are loaded at the first one."""

    def __init__(
        self, assets: AssetSet, make_scene: Callable[[], ViewScene], side_px: int, least_visible: float
    ) -> None:
        """Nothing is computed yet.

        Args:
            assets: their meshes give the id maps.
            make_scene: makes the Gaussians, with cameras and free space.
            side_px: longer side of the pictures.
            least_visible: least share of a picture that a visible object covers.
        """
        self._assets, self._make_scene = assets, make_scene
        self._side_px, self._least = side_px, least_visible
        self._scene: ViewScene | None = None
        self._base = assets.static_labels

    def look(self, question: Question) -> RegionPicture | None:
        """Render the view of the objects of a question; None if no view shows any.

        Each attempt gets the next best viewpoint, which shows what earlier ones did not.
        """
        if self._scene is None:
            self._scene = self._make_scene()
        scene = self._scene
        views = question.attempt + 1
        config = AvoConfig(views=views, remaining_share=0.0, min_gain=0.0, back_weight=0.0, restarts=1)
        target = make_target(scene, question.about, config)
        if target is None:
            return None
        points = load_strategy(config.strategy).choose(scene, target, config)
        if not points:  # no viewpoint in free space
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
        """Number the `wanted` objects in a picture uint8 (h, w, 3) by its id map int (h, w); None if it shows none."""
        numbers, counts = np.unique(ids, return_counts=True)
        share = dict(zip(numbers.tolist(), (counts / ids.size).tolist()))
        objects = [i for i in wanted if share.get(i, 0.0) >= self._least]
        base = [i for i in self._base if share.get(i, 0.0) >= _LEAST_BASE_SHARE]
        if not objects:
            return None
        surfaces = {i: f"{self._base[i]} {i}" for i in base}
        drawn = number_things(picture, ids, {i: str(i) for i in objects}, surfaces)
        return RegionPicture(drawn, tuple(objects), tuple(base), origin)
