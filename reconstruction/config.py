"""Options of a run: one config per stage, presets, and parsing of `--set stage.field=value`.

`simrecon reconstruct --list-options` prints all options with their meaning.
"""

import dataclasses
import inspect
import itertools
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from reconstruction.assembly import ASSEMBLY_PRESETS, AssemblyConfig
from reconstruction.assets import ASSETS_PRESETS, AssetsConfig
from reconstruction.core.plugins import Plugin, built_in_names, find_plugin, plugins_of
from reconstruction.depth import DEPTH_PRESETS, DepthConfig
from reconstruction.frames import FRAMES_PRESETS, FramesConfig
from reconstruction.gaussians.config import GAUSSIANS_PRESETS, GaussiansConfig
from reconstruction.instances import INSTANCES_PRESETS, InstancesConfig
from reconstruction.poses import POSES_PRESETS, PosesConfig
from reconstruction.ranges import check_ranges, numeric_options, range_of
from reconstruction.scene_graph import SCENE_GRAPH_PRESETS, SceneGraphConfig
from reconstruction.surface import SURFACE_PRESETS, SurfaceConfig
from reconstruction.views.config import AVO_PRESETS, AvoConfig
from reconstruction.world import WORLD_PRESETS, WorldConfig
from registry.errors import UsageError

Preset = Literal["fast", "default", "quality"]
PRESET_NAMES: tuple[str, ...] = typing.get_args(Preset)


@dataclass(frozen=True, kw_only=True)
class PipelineConfig:
    """Options of all stages."""

    frames: FramesConfig = field(default_factory=FramesConfig)
    poses: PosesConfig = field(default_factory=PosesConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    world: WorldConfig = field(default_factory=WorldConfig)
    gaussians: GaussiansConfig = field(default_factory=GaussiansConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    instances: InstancesConfig = field(default_factory=InstancesConfig)
    avo: AvoConfig = field(default_factory=AvoConfig)
    assets: AssetsConfig = field(default_factory=AssetsConfig)
    scene_graph: SceneGraphConfig = field(default_factory=SceneGraphConfig)
    assembly: AssemblyConfig = field(default_factory=AssemblyConfig)

    def __post_init__(self) -> None:
        """Check all numbers.

        Raises:
            UsageError: a number is not finite or out of its range.
        """
        check_ranges(self)

    @classmethod
    def from_preset(cls, name: str) -> "PipelineConfig":
        """Return the preset `fast`, `default` or `quality`.

        Raises:
            UsageError: there is no such preset.
        """
        if name not in PRESET_NAMES:
            raise UsageError(f"unknown preset {name!r}; there are {', '.join(PRESET_NAMES)}")
        return cls(
            frames=FRAMES_PRESETS[name],
            poses=POSES_PRESETS[name],
            depth=DEPTH_PRESETS[name],
            world=WORLD_PRESETS[name],
            gaussians=GAUSSIANS_PRESETS[name],
            surface=SURFACE_PRESETS[name],
            instances=INSTANCES_PRESETS[name],
            avo=AVO_PRESETS[name],
            assets=ASSETS_PRESETS[name],
            scene_graph=SCENE_GRAPH_PRESETS[name],
            assembly=ASSEMBLY_PRESETS[name],
        )

    def with_seed(self, seed: int) -> "PipelineConfig":
        """Return a copy with this seed in every stage that has one."""
        changed = {}
        for stage in dataclasses.fields(self):
            config = getattr(self, stage.name)
            if any(f.name == "seed" for f in dataclasses.fields(config)):
                changed[stage.name] = dataclasses.replace(config, seed=seed)
        return dataclasses.replace(self, **changed)

    def with_option(self, text: str) -> "PipelineConfig":
        """Return a copy with one option changed, given as `stage.field=value`.

        Raises:
            UsageError: there is no such stage, option or backend, or the value cannot be parsed or is out of range.
        """
        path, equals, value = text.partition("=")
        stage, dot, name = path.strip().partition(".")
        if not equals or not dot:
            raise UsageError(
                f"--set {text}: expected stage.field=value, for example --set depth.depth_side_px=640"
            )
        stages = [f.name for f in dataclasses.fields(self)]
        if stage not in stages:
            raise UsageError(f"--set {text}: no stage {stage!r}; the stages are {', '.join(stages)}")
        config = getattr(self, stage)
        hints = typing.get_type_hints(type(config))
        if name not in hints:
            raise UsageError(
                f"--set {text}: {stage} has no option {name!r}; it has {', '.join(sorted(hints))}"
            )
        try:
            changed = dataclasses.replace(config, **{name: _parse(hints[name], value.strip())})
        except (ValueError, TypeError) as error:
            raise UsageError(f"--set {text}: {error}") from error
        if built_in_names(type(config), name):
            find_plugin(f"{stage}.{name}", getattr(changed, name), type(config))
        try:
            return dataclasses.replace(self, **{stage: changed})
        except UsageError as error:
            raise UsageError(f"--set {text}: {error}") from error

    def plugins(self) -> list[Plugin]:
        """Return the backends of other packages that the options name.

        Raises:
            UsageError: an option names a backend that is neither built in nor installed.
        """
        stages = [(f.name, getattr(self, f.name)) for f in dataclasses.fields(self)]
        return [plugin for name, config in stages for plugin in plugins_of(name, config)]


def _parse(hint: Any, text: str) -> Any:
    """Convert the text of an option to the type of its config field."""
    origin = typing.get_origin(hint)
    if origin is Literal:
        choices = {str(c): c for c in typing.get_args(hint)}
        if text not in choices:
            raise ValueError(f"{text!r} is not one of {', '.join(choices)}")
        return choices[text]
    if origin in (typing.Union, types.UnionType):
        if str in typing.get_args(hint):
            return text  # name of a backend
        if text.lower() == "none":
            return None
        return _parse(next(a for a in typing.get_args(hint) if a is not type(None)), text)
    if origin is tuple:
        inner = typing.get_args(hint)[0]
        return tuple(_parse(inner, part.strip()) for part in text.split(",") if part.strip())
    if hint is bool:
        if text.lower() not in ("true", "false"):
            raise ValueError(f"{text!r} is neither true nor false")
        return text.lower() == "true"
    if hint in (int, float):
        try:
            return hint(text)
        except ValueError:
            kind = "a whole number" if hint is int else "a number"
            raise ValueError(f"{text[:80]!r} is not {kind}") from None
    if hint in (str, Path):
        return hint(text)
    raise ValueError(f"options of type {hint} cannot be set from the command line")


def describe_options() -> str:
    """Return a text with every option, its default, its meaning, and the range of a number."""
    lines = []
    for stage in dataclasses.fields(PipelineConfig):
        config = getattr(PipelineConfig(), stage.name)
        docs = _field_docs(type(config))
        numbers = dict(numeric_options(stage.name, config))
        lines.append(f"{stage.name}:")
        for item in dataclasses.fields(config):
            text = " ".join(docs.get(item.name, "").split())
            option = f"{stage.name}.{item.name}"
            limits = f" ({range_of(option)})" if option in numbers else ""
            lines.append(f"  {option}={getattr(config, item.name)}  {text}{limits}")
    return "\n".join(lines)


def _field_docs(cls: type) -> dict[str, str]:
    """Return the string literals below the fields of a dataclass, from its source (Python drops them)."""
    import ast
    import textwrap

    (found,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(found, ast.ClassDef)
    docs = {}
    for node, after in itertools.pairwise(found.body):
        if (
            isinstance(node, ast.AnnAssign)
            and isinstance(node.target, ast.Name)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        ):
            docs[node.target.id] = str(after.value.value)
    return docs
