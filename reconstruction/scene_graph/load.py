"""Which backend says what carries what: what the config asks for, loaded."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

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
        config: of the stage.
        assets: what relations are between.
        make_scene: the Gaussians to look at; only called where a backend looks.
        records: where exchanges with a model are kept, unless SIMRECON_VLM_RECORDS says otherwise.

    Raises:
        EnvironmentMissing: no endpoint or no model is named, transformers or weights are missing.
        UsageError: a backend that looks, but nothing to look at.
    """
    geometry = GeometryRelations(assets, config.relations)
    if config.backend == "geometry":
        return geometry
    if make_scene is None:
        raise UsageError(f"scene_graph.backend={config.backend} looks at views; that needs the Gaussians")
    from reconstruction.scene_graph.asking import PictureRelations
    from reconstruction.scene_graph.looking import RegionViewer

    viewer = RegionViewer(assets, make_scene, config.picture_side_px, config.least_visible)
    return PictureRelations(load_model(config, records), viewer, assets, geometry, config.reach_m)


def load_model(config: SceneGraphConfig, records: Path | None = None) -> Conversation:
    """Return the model that is asked.

    Raises:
        EnvironmentMissing: no endpoint or no model is named, transformers or weights are missing.
    """
    named = os.environ.get("SIMRECON_VLM_RECORDS", "")
    records = Path(named) if named else records
    if config.backend == "vlm":
        from reconstruction.learned.vlm import Endpoint, VlmClient

        endpoint = Endpoint.from_environment("scene_graph.backend", config.model)
        return VlmClient(replace(endpoint, records=records))
    from reconstruction.learned.qwen import QwenModel

    request = ModelRequest(
        config.model or DEFAULT_QWEN, "scene_graph.backend", "scene_graph.model", config.device
    )
    return QwenModel(request, records)


def check_backend(config: SceneGraphConfig) -> None:
    """Say before the run what the backend lacks; whether weights are there shows when they are loaded.

    Raises:
        EnvironmentMissing: no endpoint or no model is named, transformers is missing or too old.
    """
    if config.backend == "qwen2.5-vl":
        from reconstruction.learned.models import transformers_class

        transformers_class("Qwen2_5_VLForConditionalGeneration", "scene_graph.backend")
    elif config.backend == "vlm":
        load_model(config)


def backend_name(config: SceneGraphConfig) -> str:
    """Say who decides, for the bundle."""
    if config.backend == "geometry":
        return "geometry"
    default = os.environ.get("SIMRECON_VLM_MODEL", "") if config.backend == "vlm" else DEFAULT_QWEN
    return f"{config.backend} ({config.model or default})"


def wants_views(config: SceneGraphConfig) -> bool:
    """Tell whether the backend looks at views of the scene."""
    return config.backend != "geometry"


def outside_inputs(config: SceneGraphConfig) -> tuple[str, ...]:
    """Return what stands behind the names in the config: another model must not reuse a result."""
    return () if config.backend == "geometry" else (f"relations {backend_name(config)}",)
