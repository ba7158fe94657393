"""From a scene to its page: gather, draw, render the template."""

from importlib.resources import files
from pathlib import Path

from reconstruction.evaluation.ground_truth import GroundTruth
from reconstruction.evaluation.stage_results import StageResults
from reconstruction.progress import NO_PROGRESS, Progress
from reconstruction.report import pictures, sections
from reconstruction.report.collect import Gathered, gather
from registry import SceneBundle
from registry.errors import EnvironmentMissing

_SOURCES = ("template.html.j2", "style.css", "script.js")


def build_page(
    bundle: SceneBundle,
    stages: StageResults,
    ground_truth: Path | None = None,
    *,
    progress: Progress = NO_PROGRESS,
) -> str:
    """Return the report of a scene as one self-contained HTML page.

    Args:
        bundle: the scene.
        stages: what its stages made, as far as that is kept; what is missing is left out and said so.
        ground_truth: folder of CONTRACT section 3; None: nothing is compared.
        progress: told of each part.

    Raises:
        UsageError: the truth is malformed, or not of this video.
    """
    truth = evaluation = None
    if ground_truth is not None:
        from reconstruction.evaluation.evaluate import evaluate_scene
        from reconstruction.report.truth import Truth

        truth = Truth.of(bundle, GroundTruth.load(ground_truth))
        evaluation = evaluate_scene(bundle, ground_truth, stages=stages, progress=progress).to_json()
    return render(gather(bundle, stages, truth, evaluation))


def render(g: Gathered) -> str:
    """Render the page of what was gathered."""
    try:
        from jinja2 import DictLoader, Environment, StrictUndefined
    except ImportError as error:
        raise EnvironmentMissing(
            f"report needs jinja2, which cannot be imported ({error}); pip install jinja2"
        ) from error
    folder = files("reconstruction.report")
    sources = {name: (folder / name).read_text(encoding="utf-8") for name in _SOURCES}
    environment = Environment(
        loader=DictLoader(sources),
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("template.html.j2").render(
        scene=g.scene,
        revision=g.bundle.revision,
        picture=pictures.preview(g),
        tiles=sections.summary_tiles(g),
        sections=sections.all_sections(g),
        missing=g.stages.missing,
    )
