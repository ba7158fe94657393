"""The corrections of one scene: overrides file, acts, previews, Apply; a page or a script drives it."""

import contextlib
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from reconstruction.made_by import read_made_by
from registry import SceneBundle, SceneRegistry
from registry.errors import UsageError
from registry.locks import LockHeld, file_lock
from studio.correcting.acts import Act, Acts, perform
from studio.correcting.anchoring import Anchors
from studio.correcting.apply import ApplyRun
from studio.correcting.document import Document, DocumentState
from studio.correcting.origin import Origin, find_origin, work_folder
from studio.correcting.pending import Preview, pending_entries
from studio.correcting.yaml_text import appended
from studio.remembered import FOLDER, find_stage_results, remembered

if TYPE_CHECKING:
    from reconstruction.measure.stage_results import StageResults
    from studio.correcting.preview import Previewer


class Session:
    """Corrections of one scene, for one revision of it at a time."""

    def __init__(self, registry: SceneRegistry, bundle: SceneBundle) -> None:
        """Open the overrides file of a scene.

        Raises:
            EnvironmentMissing: it cannot be read or written.
        """
        self.registry, self.bundle = registry, bundle
        self.scene_id: str = bundle.scene["id"]
        self.folder = registry.root.parent / FOLDER
        path = self._overrides_file()
        self.document = Document(path, _first_text(bundle))
        self._alone = contextlib.ExitStack()
        self.other = ""  # the process that has the file open, too
        try:
            self._alone.enter_context(file_lock(path.with_name(path.name + ".open"), blocking=False))
        except LockHeld as held:
            self.other = held.holder

    def show(self, bundle: SceneBundle) -> None:
        """Go on with another revision."""
        self.bundle = bundle
        for name in ("results", "anchors", "acts", "previewer"):
            self.__dict__.pop(name, None)

    @cached_property
    def results(self) -> "StageResults":
        """Stage results of the revision."""
        return find_stage_results(self.bundle, self.registry.root)

    @cached_property
    def anchors(self) -> Anchors:
        """Addresses for this revision."""
        return Anchors(self.bundle, self.results)

    @cached_property
    def acts(self) -> Acts:
        """Acts for this revision."""
        return Acts(self.anchors, self.name_of, self._joined)

    @cached_property
    def previewer(self) -> "Previewer":
        """Previews for this revision."""
        from studio.correcting.preview import Previewer

        return Previewer(self.bundle, self.results)

    def name_of(self, number: int) -> str:
        """Return the name of an object or base entity."""
        for item in self.bundle.objects:
            if item.id == number:
                return item.name or item.label
        return next((base.label for base in self.bundle.base if base.id == number), "thing")

    def _joined(self, number: int) -> int:
        """Return the least id of the objects that acts not applied yet have merged with one."""
        merged = self.preview(self.document.state()).merged
        return next((min(group) for group in merged if number in group), number)

    def perform(self, act: Act) -> DocumentState:
        """Write an act to the file."""
        return perform(self.document, act, len(self.bundle.scene["report"].get("overrides", [])))

    def pending(self, state: DocumentState) -> tuple[list[dict], bool]:
        """See `preview.pending_entries`."""
        return pending_entries(state.entries, self.bundle)

    def preview(self, state: DocumentState) -> Preview:
        """Return the changes of the pending acts, as far as ids and anchors tell them."""
        pending, taken_back = self.pending(state)
        return self.previewer.quick(state.entries) if pending else Preview(0, taken_back)

    def origin(self) -> Origin:
        """Return how the scene was made.

        Raises:
            UsageError: the film is not found.
        """
        said = remembered(self.registry.root, self.scene_id)
        return find_origin(
            self.bundle, self.registry.root, video=said.get("video"), work_dir=said.get("work_dir")
        )

    def apply(self, *, require_stable: bool = True) -> ApplyRun:
        """Start `simrecon reconstruct` with the file.

        Raises:
            UsageError: the film is not found, the file is broken, or a run is going already.
        """
        state = self.document.state()
        if state.error:
            raise UsageError(state.error)
        return ApplyRun.start(self.origin(), self.document.path, self.folder, require_stable=require_stable)

    def running(self) -> ApplyRun | None:
        """Return the run of this scene that is going, if there is one."""
        return ApplyRun.find(self.scene_id, self.folder, self.registry.root)

    def close(self) -> None:
        """Let other processes know that the file is no longer open here."""
        self._alone.close()

    def _overrides_file(self) -> Path:
        """Return the file that the user said, else that of the last run, else one beside the registry."""
        said = remembered(self.registry.root, self.scene_id)
        if "overrides" in said:
            return said["overrides"]
        noted = read_made_by(
            work_folder(self.bundle, self.registry.root, said.get("work_dir")), self.scene_id
        )
        if noted is not None and noted.overrides is not None and noted.overrides.is_file():
            return noted.overrides
        return self.folder / f"{self.scene_id}.yaml"


def _first_text(bundle: SceneBundle) -> str:
    """Return the text of a new file: the corrections that the scene was made with."""
    text = (
        f"# Corrections of {bundle.scene['id']}, written by `simrecon studio`; edit them as you like.\n"
        "# Every kind of entry: docs/overrides.md\n"
    )
    for entry in bundle.scene["report"].get("overrides", []):
        text = appended(text, entry)
    return text
