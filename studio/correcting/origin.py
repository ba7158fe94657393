"""The command that made a scene, found again from its bundle, its work folder and what the user said."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reconstruction import remote_cache
from reconstruction.made_by import read_made_by
from registry import SceneBundle
from registry.errors import UsageError

_FOUND_AGAIN = ("object_measured_height_m",)  # of `world`: the passes of `--scale object:` search for it anew


@dataclass(frozen=True)
class Origin:
    """Arguments of `simrecon reconstruct` that make a scene again."""

    scene_id: str
    registry_root: Path
    video: Path
    work_dir: Path
    options: list[str]  # values of `--set`
    folder: Path  # working directory that relative paths in the options count from
    overrides: Path | None = None  # the file that the scene was made with

    def command(self, overrides: Path | None, *, require_stable: bool, keep_results: int) -> list[str]:
        """Return the arguments of the `simrecon` command."""
        out = ["reconstruct", str(self.video), "--scene", self.scene_id]
        out += ["--registry", str(self.registry_root), "--work-dir", str(self.work_dir)]
        out += ["--keep-results", str(keep_results)]
        for option in self.options:
            out += ["--set", option]
        if overrides is not None:
            out += ["--overrides", str(overrides)]
        return [*out, "--require-stable"] if require_stable else out


def find_origin(
    bundle: SceneBundle, registry_root: Path, *, video: Path | None = None, work_dir: Path | None = None
) -> Origin:
    """Find out how a scene was made.

    Args:
        bundle: the scene.
        registry_root: its registry; the default work folder lies beside it.
        video: the film, if the user said it; else the path that the last run noted is taken.
        work_dir: value of `--work-dir`, if it was given.

    Raises:
        UsageError: the film is not found or is another one, or the scene cannot be made again by a command.
    """
    scene = bundle.scene
    digest = _input_digest(bundle)
    folder = work_folder(bundle, registry_root, work_dir)
    noted = read_made_by(folder, scene["id"])
    truth = [s for s, backend in scene["report"].get("backends", {}).items() if backend == "ground-truth"]
    if truth:
        raise UsageError(
            f"{scene['id']} was made with --oracle {','.join(truth)}; Apply makes scenes from their film only. Run "
            "simrecon reconstruct yourself, with --overrides and the file of corrections"
        )
    overrides = noted.overrides if noted is not None else None
    return Origin(
        scene_id=scene["id"],
        registry_root=registry_root.absolute(),
        video=_film(scene, digest, video, noted.video if noted else None),
        work_dir=folder,
        options=options_of(scene["report"].get("config", {})),
        folder=noted.folder if noted is not None and noted.folder.is_dir() else Path.cwd(),
        overrides=overrides if overrides is not None and overrides.is_file() else None,
    )


def work_folder(bundle: SceneBundle, registry_root: Path, work_dir: Path | None = None) -> Path:
    """Return the folder of a scene's stage results: as it was given, else the default one beside the registry."""
    return remote_cache.work_folder(work_dir, registry_root, _input_digest(bundle)).absolute()


def _input_digest(bundle: SceneBundle) -> str:
    made_with = bundle.scene["report"].get("volatile", {}).get("work", {})
    return str(made_with.get("input_digest") or bundle.scene["source"].get("sha256", ""))


def options_of(recorded: dict[str, Any]) -> list[str]:
    """Return the values of `--set` that turn the default options into those that a bundle records.

    Raises:
        UsageError: an option cannot be set from the command line.
    """
    from reconstruction.cache import canonical_json
    from reconstruction.config import PipelineConfig

    config = PipelineConfig()
    out = []
    for stage in dataclasses.fields(config):
        default = json.loads(canonical_json(getattr(config, stage.name)))
        said = recorded.get(stage.name, {})
        by_object = str(said.get("scale") or "").startswith("object:")
        for name, value in said.items():
            if name not in default or value == default[name] or (by_object and name in _FOUND_AGAIN):
                continue  # options of other versions have no meaning here
            option = f"{stage.name}.{name}={_option_text(value)}"
            changed = json.loads(canonical_json(getattr(config.with_option(option), stage.name)))
            if changed[name] != value:
                raise UsageError(
                    f"the scene was made with {stage.name}.{name} = {value!r}, which --set cannot say; run simrecon "
                    "reconstruct yourself, with --overrides and the file of corrections"
                )
            out.append(option)
    return out


def _option_text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if value is None:
        return "none"
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def _film(scene: dict, digest: str, said: Path | None, noted: Path | None) -> Path:
    """Return the film of a scene, checked by its digest."""
    from reconstruction.cache import digest_input

    name = scene["source"].get("file", "the film")
    if said is not None:
        if not said.exists():
            raise UsageError(f"--video {said}: no such file or folder")
        if digest and digest_input(said) != digest:
            raise UsageError(f"--video {said}: {scene['id']} was made from another film, {name}")
        return said.absolute()
    for place in ([noted] if noted else []) + [Path.cwd() / name]:
        if place.exists() and digest_input(place) == digest:
            return place.absolute()
    where = f" at {noted} or" if noted else ""
    raise UsageError(
        f"{scene['id']} was made from {name}, which is not{where} in {Path.cwd()}. Say where it is: "
        f"simrecon studio {scene['id']} --video FILE"
    )
