"""Settings of the scene graph stage."""

from dataclasses import dataclass, field
from typing import Literal

from reconstruction.scene_graph.relations import RelationConfig


@dataclass(frozen=True)
class SceneGraphConfig:
    """How relations are inferred and merged."""

    backend: Literal["geometry", "vlm", "qwen2.5-vl"] = "geometry"
    """Who says what carries what: `geometry` of the assets; `vlm`: a vision-language model behind an OpenAI-compatible
    endpoint (SIMRECON_VLM_URL, SIMRECON_VLM_MODEL, SIMRECON_VLM_KEY), shown a view of each region with numbers on its
    things; `qwen2.5-vl`: that model in this process, through transformers."""
    model: str = ""
    """Of the backend: a name that the endpoint knows, or one on the Hugging Face hub, or a folder. Empty: what
    SIMRECON_VLM_MODEL says, and Qwen/Qwen2.5-VL-7B-Instruct in process."""
    device: str = "auto"
    """Where `qwen2.5-vl` runs: cpu, cuda, cuda:1, ...; auto is cuda where there is one."""
    merging: Literal["online", "naive", "global"] = "online"
    """The paper's method; without conflict resolution; or one question about everything."""
    adjudications: int = 3
    """How often the things of a conflict are looked at again, at most."""
    region_radius_m: float = 0.5
    """DBSCAN: objects whose centers are this close belong together."""
    region_min_objects: int = 2
    """DBSCAN: an object with this many in its radius (itself included) is a core."""
    view_margin_m: float = 0.25
    """How far around a region its view shows other objects."""
    picture_side_px: int = 768
    """Longer side of the pictures that a model is shown."""
    least_visible: float = 0.0004
    """Share of the picture that a thing must cover to get a number."""
    reach_m: float = 0.3
    """A model that names a parent farther away than this is asked again."""
    relations: RelationConfig = field(default_factory=RelationConfig)
    """Tolerances of the geometric backend."""

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        if self.adjudications < 1 or self.picture_side_px < 128:
            raise ValueError("scene_graph: adjudications must be at least 1 and picture_side_px at least 128")


SCENE_GRAPH_PRESETS = {
    "fast": SceneGraphConfig(),
    "default": SceneGraphConfig(),
    "quality": SceneGraphConfig(),
}
