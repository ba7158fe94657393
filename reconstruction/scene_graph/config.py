"""Settings of the scene graph stage."""

from dataclasses import dataclass, field
from typing import Literal

from reconstruction.scene_graph.relations import RelationConfig


@dataclass(frozen=True)
class SceneGraphConfig:
    """Inference and merging of relations."""

    backend: Literal["geometry", "vlm", "qwen2.5-vl"] | str = "geometry"
    """Source of relations: `geometry` of the assets; `vlm`: a vision-language model at an OpenAI-compatible endpoint
    (SIMRECON_VLM_URL, SIMRECON_VLM_MODEL, SIMRECON_VLM_KEY), shown a view of each region with numbered objects;
    `qwen2.5-vl`: that model in this process, by transformers."""
    model: str = ""
    """Model of the backend: a name that the endpoint knows, or a name on the Hugging Face hub or a folder. Empty:
    SIMRECON_VLM_MODEL, or Qwen/Qwen2.5-VL-7B-Instruct in this process."""
    device: str = "auto"
    """Device of `qwen2.5-vl`: cpu, cuda, cuda:1, ...; auto is cuda if available."""
    merging: Literal["online", "naive", "global"] = "online"
    """`online`: the paper's method; `naive`: no conflict resolution; `global`: one question about all objects."""
    adjudications: int = 3
    """Largest number of further views of the objects of a conflict."""
    region_radius_m: float = 0.5
    """DBSCAN: radius of the neighborhood of an object's center."""
    region_min_objects: int = 2
    """DBSCAN: least number of objects in the neighborhood of a core object, itself included."""
    view_margin_m: float = 0.25
    """Margin around a region within which its view includes other objects."""
    picture_side_px: int = 768
    """Longer side of the views that a model is shown."""
    least_visible: float = 0.0004
    """Least share of the view that a numbered object covers."""
    reach_m: float = 0.3
    """Largest distance to a parent; the model is asked again if it names a farther one."""
    relations: RelationConfig = field(default_factory=RelationConfig)
    """Tolerances of the geometric backend."""

    def __post_init__(self) -> None:
        """Check values."""
        if self.adjudications < 1 or self.picture_side_px < 128:
            raise ValueError("scene_graph: adjudications must be at least 1 and picture_side_px at least 128")


SCENE_GRAPH_PRESETS = {name: SceneGraphConfig() for name in ("fast", "default", "quality")}
