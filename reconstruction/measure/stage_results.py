"""Load the stage results of a scene from its work folder, as far as they still exist."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reconstruction.cache import DamagedResult, read_result
from reconstruction.core.types import DepthMaps, PosedFrames, WorldFrame
from reconstruction.gaussians import Gaussians
from reconstruction.pipeline import STAGES
from reconstruction.remote_cache import open_store, work_folder
from registry import SceneBundle
from registry.roots import is_address

_MANIFEST = "manifest.json"


@dataclass
class StageResults:
    """Artifacts of a scene's stages by name, loaded lazily (large arrays memory-mapped)."""

    folders: dict[str, Path]
    missing: dict[str, str]  # stage -> why its result is unavailable
    work_dir: Path | None = None
    _loaded: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def find(
        cls, bundle: SceneBundle, registry_root: Path, work_dir: Path | str | None = None
    ) -> "StageResults":
        """Locate the results that a bundle was made from.

        Args:
            bundle: the scene.
            registry_root: its registry; the default work folders lie beside it.
            work_dir: value of `simrecon reconstruct --work-dir`, if it was given. Results at an address are
                downloaded.

        Raises:
            EnvironmentMissing: the address cannot be reached.
        """
        work = bundle.scene["report"].get("volatile", {}).get("work")
        if not work:
            reason = "the bundle does not name the stage results that it was made from"
            return cls({}, {stage.name: reason for stage in STAGES})
        folder = work_folder(work_dir, registry_root, work["input_digest"])
        store = open_store(work_dir, registry_root, work["input_digest"]) if is_address(work_dir) else None
        keys = {**work["stage_keys"], **_latest_keys(folder, bundle)}
        folders, missing = {}, {}
        for number, stage in enumerate(STAGES, start=1):
            key = keys.get(stage.name)
            place = folder / f"{number:02d}_{stage.name}-{key}"
            if key is None and stage.on_demand:
                continue
            if key is None:
                missing[stage.name] = "this scene was made without the stage"
            elif not (place / _MANIFEST).is_file() and not (store and store.has(number, stage.name, key)):
                missing[stage.name] = f"{place} does not exist; reconstruct the scene again to create it"
            else:
                folders[stage.name] = place
        return cls(folders, missing, folder)

    def get(self, stage: str) -> Any | None:
        """Return a stage's artifact; None if it is missing or damaged, see `missing`."""
        if stage not in self.folders:
            return None
        if stage not in self._loaded:
            kind = next(s.produces for s in STAGES if s.name == stage)
            try:
                self._loaded[stage] = read_result(kind, self.folders[stage])
            except DamagedResult as error:
                self.missing[stage] = f"{error}; reconstruct the scene again to create it"
                del self.folders[stage]
                return None
        return self._loaded[stage]

    def in_world(self) -> tuple[PosedFrames | None, DepthMaps | None]:
        """Return the posed frames and the depth stage's maps in world space, in metres; None for missing ones."""
        world: WorldFrame | None = self.get("world")
        posed, depth = self.get("poses"), self.get("depth")
        if world is None:
            return None, None
        placed = posed and world.apply_to(posed)
        return placed, depth and placed and world.depth_in_world(depth, placed)

    def refined_in_world(self) -> tuple[Gaussians | None, DepthMaps | None]:
        """Return the Gaussians and the depth maps refined by them, in world space, in metres; None if missing."""
        world, scene, posed = self.get("world"), self.get("gaussians"), self.get("poses")
        if world is None or scene is None or posed is None:
            return None, None
        return scene.in_world(world), world.depth_in_world(scene.depth, world.apply_to(scene.posed(posed)))


def _latest_keys(folder: Path, bundle: SceneBundle) -> dict[str, str]:
    """Return the stage keys of the latest run that produced this revision, if the work folder has a record of it."""
    try:
        noted = json.loads((folder / f"published-{bundle.scene['id']}.json").read_text())
        keys = noted["stage_keys"] if noted["revision"] == bundle.revision else {}
        return {str(stage): str(key) for stage, key in keys.items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):  # none, or damaged
        return {}
