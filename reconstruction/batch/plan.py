"""Decide what a batch does with each row: rows, journal and registry in, a `Step` for each row out."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from reconstruction.batch.journal import VideoState
from reconstruction.batch.listing import Listing
from reconstruction.batch.outcomes import TRANSIENT
from reconstruction.batch.rows import VideoRow
from registry import SceneRegistry
from registry.errors import UsageError


@dataclass(frozen=True)
class Step:
    """What happens to a row."""

    row: VideoRow
    fingerprint: str
    runs: bool
    reason: str  # one or two words, such as "new" or "published"


@dataclass(frozen=True)
class Choice:
    """Which rows run beside those that must."""

    retry_failed: bool = False  # also those that failed by the video's fault
    rerun: bool = False  # all
    replace: bool = False  # scenes of the registry that this batch did not make


def make_plan(
    listing: Listing,
    states: Mapping[str, VideoState],
    registry: SceneRegistry,
    common: tuple[str, ...] = (),
    choice: Choice | None = None,
) -> list[Step]:
    """Return a step for each row, in order.

    Args:
        listing: the rows.
        states: what the journal says, by scene id.
        registry: where scenes are published.
        common: arguments that all rows share and that change results.
        choice: which rows run beside those that must.

    Raises:
        UsageError: a row would replace a scene that this batch did not make.
    """
    choice = choice or Choice()
    revisions = registry.revisions()
    steps = []
    for row in listing.rows:
        fingerprint = row.fingerprint(common)
        runs, reason = _judge(states.get(row.scene_id), row.scene_id in revisions, fingerprint, choice)
        steps.append(Step(row, fingerprint, runs, reason))
    if not choice.replace:
        _refuse_replacing(steps, states, registry)
    return steps


def _judge(
    state: VideoState | None, is_published: bool, fingerprint: str, choice: Choice
) -> tuple[bool, str]:
    """Return whether a row runs, and why."""
    if state is None:
        return True, "new"
    if choice.rerun:
        return True, "asked for"
    if state.fingerprint != fingerprint:
        return True, "changed"
    if state.result == "published":
        return (False, "published") if is_published else (True, "not in the registry")
    if state.result == "failed":
        if state.kind in TRANSIENT:
            return True, f"failed: {state.kind}"
        return choice.retry_failed, "failed"
    return True, "unfinished"


def _refuse_replacing(steps: list[Step], states: Mapping[str, VideoState], registry: SceneRegistry) -> None:
    records = {record.scene_id: record for record in registry.list()}
    problems = []
    for step in steps:
        record, row = records.get(step.row.scene_id), step.row
        made_here = row.scene_id in states
        if record is None or made_here or Path(record.source_file).name == row.video.name:
            continue
        problems.append(f"  {row.where}: {row.scene_id!r} is there already, made from {record.source_file!r}")
    if problems:
        raise UsageError(
            "\n".join(
                [
                    f"{registry.root}: {len(problems)} scenes would be replaced; give the rows other ids, or --replace",
                    *problems[:20],
                ]
            )
        )
