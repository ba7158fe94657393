"""Load the relation backend that the config names."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from reconstruction.core.plugins import load_plugin
from reconstruction.core.types import AssetSet
from reconstruction.learned.conversation import Conversation
from reconstruction.learned.models import ModelRequest
from reconstruction.scene_graph.base import RelationBackend
from reconstruction.scene_graph.config import SceneGraphConfig
from reconstruction.scene_graph.relations import GeometryRelations
from registry.errors import UsageError

if TYPE_CHECKING:
    from reconstruction.views import ViewScene

DEFAULT_QWEN = "Qwen/Qwen2.5-VL-7B-Instruct"
RECORDS = "graph_questions"


def load_relations(
    config: SceneGraphConfig,
    assets: AssetSet,
    make_scene: "Callable[[], ViewScene] | None",
    records: Path | None = None,
) -> RelationBackend:
    """Return the backend that `config.backend` asks for.

    Args:
        config: settings of the stage.
        assets: base surfaces and objects.
        make_scene: makes the Gaussians to render; called only by backends that use views.
        records: folder of recorded exchanges with a model; SIMRECON_VLM_RECORDS overrides it.

    Raises:
        EnvironmentMissing: no endpoint or no model is named, or transformers or weights are missing.
        UsageError: the backend needs views, but `make_scene` is None.
    """
    geometry = GeometryRelations(assets, config.relations)
    if config.backend == "geometry":
        return geometry
    if make_scene is None:
        raise UsageError(f"scene_graph.backend={config.backend} looks at views; that needs the Gaussians")
    if config.backend not in ("vlm", "qwen2.5-vl"):
        return load_plugin("scene_graph.backend", config.backend, SceneGraphConfig)(
            config, assets, make_scene
        )
    from reconstruction.scene_graph.asking import PictureRelations
    from reconstruction.scene_graph.looking import RegionViewer

    viewer = RegionViewer(assets, make_scene, config.picture_side_px, config.least_visible)
    return PictureRelations(load_model(config, records), viewer, assets, geometry, config.reach_m)


def load_model(config: SceneGraphConfig, records: Path | None = None) -> Conversation:
    """Return the model that `config.backend` and `config.model` name; raises as `load_relations`."""
    named = os.environ.get("SIMRECON_VLM_RECORDS", "")
    records = Path(named) if named else records
    if config.backend == "vlm":
        from reconstruction.learned.vlm import Endpoint, VlmClient

        endpoint = Endpoint.from_environment("scene_graph.backend", config.model)
        return VlmClient(replace(endpoint, records=records))
    from reconstruction.learned.qwen import QwenModel

    model = config.model or DEFAULT_QWEN
    return QwenModel(ModelRequest(model, "scene_graph.backend", "scene_graph.model", config.device), records)


def check_backend(config: SceneGraphConfig) -> None:
    """Raise `EnvironmentMissing` before a run if the backend lacks an endpoint, a model name or transformers."""
    if config.backend == "qwen2.5-vl":
        from reconstruction.learned.models import transformers_class

        transformers_class("Qwen2_5_VLForConditionalGeneration", "scene_graph.backend")
    elif config.backend == "vlm":
        load_model(config)


def backend_name(config: SceneGraphConfig) -> str:
    """Return the backend and its model, for the bundle."""
    if config.backend not in ("vlm", "qwen2.5-vl"):
        return config.backend
    default = os.environ.get("SIMRECON_VLM_MODEL", "") if config.backend == "vlm" else DEFAULT_QWEN
    return f"{config.backend} ({config.model or default})"


def wants_views(config: SceneGraphConfig) -> bool:
    """Tell whether the backend uses views of the scene."""
    return config.backend != "geometry"


def outside_inputs(config: SceneGraphConfig) -> tuple[str, ...]:
    """Return the model behind the config, which is part of the cache key."""
    return () if config.backend not in ("vlm", "qwen2.5-vl") else (f"relations {backend_name(config)}",)
