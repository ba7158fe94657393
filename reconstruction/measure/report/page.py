"""Build the report page of a scene: gather the inputs, draw, render the template."""

import json
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.measure.ground_truth import GroundTruth
from reconstruction.measure.report import pictures, sections
from reconstruction.measure.report.collect import Gathered, by_reason
from reconstruction.measure.scene import placed_meshes
from reconstruction.measure.stage_results import StageResults
from registry import SceneBundle
from registry.errors import EnvironmentMissing, UsageError

_SOURCES = ("template.html.j2", "plain.html.j2", "blocks.html.j2", "style.css", "script.js")
_MARK_WITHIN_BYTES = 4096  # exported pages name their scene at their beginning


def build_page(
    bundle: SceneBundle,
    stages: StageResults,
    ground_truth: Path | None = None,
    evaluation: dict[str, Any] | None = None,
    *,
    labels: Path | None = None,
    room_page: str | None = None,
    progress: Progress = NO_PROGRESS,
) -> str:
    """Return the report of a scene as one self-contained HTML page.

    Args:
        bundle: the scene.
        stages: its stage results; the page names missing ones.
        ground_truth: folder of CONTRACT section 3; None: no error maps.
        evaluation: `Evaluation.to_json` of this scene; None: evaluated here, if there is ground truth.
        labels: outlines drawn by hand (CONTRACT section 5, COCO or labelme); None: no such section.
        room_page: file name of a page of `simrecon studio --export` in the same folder, to link to; None: no link.
        progress: advanced by the evaluation.

    Raises:
        UsageError: the truth or the labels are malformed, or not of this video.
    """
    truth = None
    if ground_truth is not None:
        from reconstruction.measure.evaluate import evaluate_scene
        from reconstruction.measure.report.truth import Truth

        truth = Truth.of(bundle, GroundTruth.load(ground_truth))
        if evaluation is None:
            evaluation = evaluate_scene(bundle, ground_truth, stages=stages, progress=progress).to_json()
    outlines = None
    if labels is not None:
        from reconstruction.measure.outlines import measure_outlines

        outlines = measure_outlines(bundle, placed_meshes(bundle), labels, stages)
    return render(Gathered(bundle, stages, truth, evaluation, outlines), room_page)


def read_evaluation(path: Path, bundle: SceneBundle) -> dict[str, Any]:
    """Read a file of `simrecon evaluate --json` for this scene.

    Raises:
        UsageError: it cannot be read, has another format, or is of another scene or revision.
    """
    from reconstruction.measure.evaluate import SCHEMA

    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"--evaluation {path}: cannot be read ({error})") from error
    if not isinstance(found, dict) or found.get("schema") != SCHEMA:
        raise UsageError(f"--evaluation {path}: not a file of `simrecon evaluate --json` ({SCHEMA})")
    if found.get("revision") != bundle.revision:
        raise UsageError(
            f"--evaluation {path}: is of revision {found.get('revision')} of {found.get('scene')}, this is "
            f"{bundle.revision} of {bundle.scene['id']}; evaluate it again"
        )
    return found


def find_room_page(folder: Path, scene_id: str) -> str | None:
    """Return the name of the newest page of `simrecon studio SCENE --export` in a folder; None: there is none."""
    mark = f'<meta name="simrecon-scene" content="{scene_id}">'.encode()
    found = []
    for path in folder.glob("*.html"):
        with path.open("rb") as file:
            if mark in file.read(_MARK_WITHIN_BYTES):
                found.append(path)
    return max(found, key=lambda path: path.stat().st_mtime).name if found else None


def render(g: Gathered, room_page: str | None = None) -> str:
    """Render the page.

    Raises:
        EnvironmentMissing: jinja2 is not installed.
    """
    return render_template(
        "template.html.j2",
        scene=g.scene,
        revision=g.bundle.revision,
        room_page=None if room_page is None else quote(room_page),
        picture=pictures.preview(g),
        tiles=sections.summary_tiles(g),
        sections=sections.all_sections(g),
        missing=by_reason(g.stages.missing),
    )


def render_template(name: str, **values: Any) -> str:
    """Render a template of this folder: "template.html.j2" of a scene, or "plain.html.j2" (title, source, sections).

    Raises:
        EnvironmentMissing: jinja2 is not installed.
    """
    try:
        from jinja2 import DictLoader, Environment, StrictUndefined
    except ImportError as error:
        raise EnvironmentMissing(
            f"report needs jinja2, which cannot be imported ({error}); pip install jinja2"
        ) from error
    folder = files("reconstruction.measure.report")
    sources = {name: (folder / name).read_text(encoding="utf-8") for name in _SOURCES}
    environment = Environment(
        loader=DictLoader(sources),
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name).render(**values)
