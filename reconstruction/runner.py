"""Runs the stages of `pipeline` on one video: computes results, or loads them from the stage cache.

The fingerprint of a stage covers its code, its options, the user's corrections, the files, models and packages that its
options name, and the fingerprints of the stages that it reads.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reconstruction.cache import DamagedResult, StageStore, digest_input, fingerprint
from reconstruction.code_digest import code_digest, tree_digest
from reconstruction.config import PipelineConfig
from reconstruction.core.compiling import compilation_shown
from reconstruction.core.memory import return_free_memory
from reconstruction.core.plugins import plugins_of
from reconstruction.core.profiling import Usage, UsageMeter
from reconstruction.core.progress import NO_PROGRESS, Progress, StageListener
from reconstruction.core.types import DepthMaps, InstanceSet, PosedFrames, WorldFrame
from reconstruction.editing.anchors import Footage, Pointer
from reconstruction.editing.film import Film
from reconstruction.editing.overrides import Overrides
from reconstruction.pipeline import STAGE_NAMES, STAGES, Call, Stage, in_world, view_scene
from reconstruction.poses.lens import Lens

if TYPE_CHECKING:
    from reconstruction.measure.oracle import Oracle
    from reconstruction.views import ViewScene

logger = logging.getLogger(__name__)
_PIPELINE = Path(__file__).with_name("pipeline.py")
_EDITING = "reconstruction.editing.corrections"
_EDITING_WORLD = (
    "reconstruction.editing.world_frame"  # apart, so that the code of later stages is no part of its key
)
_REDONE = (
    "world",
    "assembly",
)  # corrections run these again, which repeats their notes; the others change a result


@dataclass
class Run:
    """One reconstruction in progress: results by stage name, their fingerprints and costs."""

    video: Path
    config: PipelineConfig
    store: StageStore
    overrides: Overrides = field(default_factory=Overrides)
    oracle: "Oracle | None" = None  # stages that the ground truth replaces, for evaluation
    listener: StageListener = NO_PROGRESS
    results: dict[str, Any] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)
    usage: dict[str, Usage] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    input_digest: str = ""  # of the video; computed if not given
    computed: set[str] = field(default_factory=set)  # stages that this run computed; the others were loaded
    started: float = field(default_factory=time.perf_counter)
    after_stage: "Callable[[Run, str], None] | None" = None  # called after each stage, computed or loaded

    def __post_init__(self) -> None:
        """Compute the digest of the input.

        Raises:
            UsageError: overrides and config contradict each other.
        """
        self.overrides.check_lengths(self.config)
        self.input_digest = self.input_digest or digest_input(self.video)

    def execute(self, until: str = STAGE_NAMES[-1]) -> None:
        """Compute or load all stages up to and including `until`; stages on demand only if one of these reads them."""
        wanted = self.wanted_stages()
        if until not in wanted:
            wanted = tuple(name for name in STAGE_NAMES if name in (*wanted, until))
        for stage in STAGES:
            if stage.name in wanted:
                self._execute_stage(stage, wanted)
            if stage.name == until:
                return

    def complete(self, name: str) -> None:
        """Compute or load one stage; `results` must hold its inputs."""
        self._execute_stage(next(stage for stage in STAGES if stage.name == name), (name,))

    def wanted_stages(self) -> tuple[str, ...]:
        """Return the stages that this config needs, in order."""
        asked = {name for stage in STAGES for name in self.needs_of(stage)}
        return tuple(stage.name for stage in STAGES if not stage.on_demand or stage.name in asked)

    def needs_of(self, stage: Stage) -> tuple[str, ...]:
        """Return the stages that a stage reads under this config."""
        return tuple(dict.fromkeys((*stage.needs, *stage.needs_also(self.options_of(stage)))))

    def options_of(self, stage: Stage) -> Any:
        """Return the options of a stage."""
        options = getattr(self.config, stage.option_group)
        if stage.name == "gaussians" and self.oracle is not None and "depth" in self.oracle.stages:
            return replace(options, refine_depth=False)  # true depth needs no correction
        return options

    def in_world(self) -> tuple[PosedFrames, DepthMaps]:
        """See `pipeline.in_world`."""
        return in_world(self.results)

    def view_scene(self) -> "ViewScene":
        """See `pipeline.view_scene`."""
        return view_scene(self.results)

    def lens(self) -> Lens:
        """Return the map from pixels of the video to pixels of the undistorted frames."""
        return Lens.of(self.results["poses"])

    def pointer(self, found: InstanceSet) -> Pointer:
        """Return the lookup of things and places that overrides refer to."""
        posed, depth = self.in_world()
        surface = self.results["surface"]
        return Pointer(found, surface, Footage(posed, depth, self.lens(), surface))

    def _execute_stage(self, stage: Stage, wanted: tuple[str, ...]) -> None:
        number = STAGE_NAMES.index(stage.name) + 1  # prefix of its folder
        corrections = self.overrides.fingerprint_of_stage(stage.name)
        key = self.keys[stage.name] = self.key_of(stage, corrections)
        kept, damage = self._find(number, stage, key)
        self.listener.begin_stage(stage.name, wanted.index(stage.name) + 1, len(wanted), kept is not None)
        if damage:
            self.listener.note(f"{damage}; computing this stage again")
        if kept is None:
            with compilation_shown(self.listener) as shown:
                if corrections:
                    self._keep_corrected(number, stage, key, shown)
                else:
                    self._keep(number, stage, key, lambda noted: self._compute(stage, noted), shown)
            self.computed.add(stage.name)
            return_free_memory()
        # Load also what was just computed: a resumed run continues with the same values.
        found = kept or self._read(number, stage, key)
        self.results[stage.name], self.usage[stage.name] = found.value, found.usage
        self.notes.extend(
            note if note.startswith(f"{stage.name}:") else f"{stage.name}: {note}" for note in found.notes
        )
        if stage.name == "world":
            self._note_coordinates()
        self.listener.end_stage(stage.name, None if kept else self.usage[stage.name])
        if self.after_stage is not None:
            self.after_stage(self, stage.name)

    def _find(self, number: int, stage: Stage, key: str) -> "tuple[_Kept | None, str]":
        """Return a result of the cache, None if there is none, and how it was damaged; a damaged one is removed."""
        if not self.store.has(number, stage.name, key):
            return None, ""
        try:
            self.store.check(number, stage.name, key)
            return self._read(number, stage, key), ""
        except DamagedResult as error:
            logger.info("%s", error)
            self.store.remove(number, stage.name, key)
            return None, str(error)

    def _read(self, number: int, stage: Stage, key: str) -> "_Kept":
        """Load a result and its record.

        Raises:
            DamagedResult: it cannot be read.
        """
        record = self.store.manifest(number, stage.name, key)
        try:
            usage = Usage(**{name: float(value) for name, value in record["usage"].items()})
            notes = [str(note) for note in record["notes"]]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DamagedResult(f"{stage.name}-{key}: its manifest is not as it was written") from error
        return _Kept(self.store.load(stage.produces, number, stage.name, key), usage, notes)

    def key_of(self, stage: Stage, corrections: list) -> str:
        """Return the fingerprint of a stage with these corrections."""
        upstream = tuple(self.keys[name] for name in self.needs_of(stage)) or (self.input_digest,)
        options = self.options_of(stage)
        said_by_truth = self.oracle.of_stage(stage.name) if self.oracle is not None else []
        code = [
            tree_digest(_PIPELINE),
            code_digest(stage.package),
            code_digest("reconstruction.core.artifacts"),
        ]
        if corrections:
            code.append(code_digest(_EDITING_WORLD if stage.name == "world" else _EDITING))
        plugins = [(str(plugin), plugin.digest()) for plugin in plugins_of(stage.option_group, options)]
        inputs = (options, corrections, stage.outside(options), plugins, said_by_truth)
        return fingerprint(stage.name, code, inputs, upstream)

    def _keep(
        self,
        number: int,
        stage: Stage,
        key: str,
        make: Callable[[Progress], Any],
        shown: Progress,
        before: "_Kept | None" = None,
    ) -> None:
        """Compute and save a result; `before`: the uncorrected result that it is computed from."""
        notes = list(before.notes) if before and stage.name not in _REDONE else []
        with UsageMeter() as meter:
            result = make(_NoteTaker(shown, notes))
        usage = meter.usage if before is None else before.usage.followed_by(meter.usage)
        config = self.options_of(stage)
        record = {"stage": stage.name, "key": key, "usage": asdict(usage), "notes": notes, "config": config}
        self.store.save(result, number, stage.name, key, record)

    def _keep_corrected(self, number: int, stage: Stage, key: str, shown: Progress) -> None:
        """Apply the user's corrections to a result; the uncorrected result is saved, too, for other corrections."""
        from reconstruction.editing.corrections import corrected

        plain_key = self.key_of(stage, [])
        before, damage = self._find(number, stage, plain_key)
        if damage:
            self.listener.note(f"{damage}; computing this stage again")
        if before is None:
            self._keep(number, stage, plain_key, lambda noted: self._compute(stage, noted), shown)
            before = self._read(number, stage, plain_key)
        plain = before.value

        def make(progress: Progress) -> Any:
            if stage.name == "world":
                return self._corrected_world(plain, progress)
            pointer = self.pointer(plain if stage.name == "instances" else self.results["instances"])
            done = {name: self.results[name] for name in self.needs_of(stage)}
            return corrected(
                stage.name, plain, done, self.options_of(stage), self.overrides, pointer, progress
            )

        self._keep(number, stage, key, make, shown, before)

    def _corrected_world(self, plain: WorldFrame, progress: Progress) -> WorldFrame:
        """Return the world frame with the user's scale, up direction and floor."""
        from reconstruction.editing.world_frame import corrected_world

        film = Film(self.results["poses"], self.results["depth"], self.lens())
        return corrected_world(plain, self.overrides.scene_entries(), film, self.config.world, progress)

    def _note_coordinates(self) -> None:
        """Note the entries whose coordinates count in the world frame that other entries make."""
        moved = self.overrides.entries_in_metres()
        if moved and self.overrides.of_stage("world"):
            note = (
                f"world: coordinates in entries {', '.join(map(str, moved))} of the overrides file count in the world "
                "frame that the file makes; check them if its scale, up or floor is new"
            )
            self.notes.append(note)
            self.listener.note(note)

    def _compute(self, stage: Stage, progress: Progress) -> Any:
        scratch = self.store.scratch(stage.name)
        needed = {name: self.results[name] for name in self.needs_of(stage)}
        call = Call(self.video, self.options_of(stage), needed, scratch, self.store.work_dir, progress)
        try:
            if self.oracle is not None and stage.name in self.oracle.stages:
                return self.oracle.make(stage.name, call)
            return stage.make(call)
        finally:
            self.store.discard(scratch)


@dataclass(frozen=True)
class _Kept:
    """A result of the stage cache."""

    value: Any
    usage: Usage
    notes: list[str]


class _NoteTaker:
    """Passes progress on, and collects the notes for the manifest of the stage."""

    def __init__(self, listener: Progress, notes: list[str]) -> None:
        self._listener, self._notes = listener, notes
        self.start, self.advance = listener.start, listener.advance

    def note(self, message: str) -> None:
        self._notes.append(message)
        logger.info(message)
        self._listener.note(message)
