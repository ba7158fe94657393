"""Generation of the meshes of a scene's objects, within a budget that is announced first."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.generation.base import (
    GenerationBackend,
    GenerationError,
    GeneratorUnavailable,
    ObjectPictures,
)
from reconstruction.assets.generation.load import load_generator, records_folder
from reconstruction.assets.generation.pictures import object_pictures
from reconstruction.assets.generation.records import Records
from reconstruction.assets.views import SeenPoints
from reconstruction.core.progress import Progress
from reconstruction.core.types import InstanceSet, PosedFrames
from reconstruction.views import SceneViews


@dataclass(frozen=True)
class Fetched:
    """The meshes of a scene's objects by a generator."""

    by: str  # the generator
    meshes: dict[int, bytes]  # .glb files by object id
    refused: dict[int, str]  # reasons for missing ones by object id


def fetch_meshes(
    found: InstanceSet, posed: PosedFrames, seen: dict[int, SeenPoints], config: AssetsConfig, progress: Progress,
    views: SceneViews | None = None,
) -> Fetched | None:  # fmt: skip
    """Generate every standing object with enough seen points; None where no generator is configured.

    Pictures are those of `views`, or keyframes where that is None. `progress` notes what will be sent and spent, and
    failures.
    """
    backend = load_generator(config)
    if backend is None:
        return None
    records = Records(records_folder(), backend)
    wanted = [
        item
        for item in found.objects
        if not item.attached_hint and len(seen[item.id].points) >= config.min_points
    ]
    count = min(config.generator_views, backend.most_pictures)
    pictures = object_pictures(found, posed, wanted, max(1, count), views)
    # The best seen objects first, as the budget may end: they gain most.
    order = sorted(pictures, key=lambda number: (-len(seen[number].points), number))
    allowed, refused = _within_budget([pictures[number] for number in order], records, backend, config)
    _announce(allowed, refused, records, backend, config, progress)
    meshes, failed = _make(allowed, records, backend)
    for number, reason in sorted(failed.items()):
        progress.note(f"object {number}: no mesh by {backend.name}: {reason}")
    return Fetched(backend.name, meshes, refused | failed)


def _within_budget(
    pictures: list[ObjectPictures], records: Records, backend: GenerationBackend, config: AssetsConfig
) -> tuple[list[ObjectPictures], dict[int, str]]:
    """Return the objects within the budget, and the reasons against the others."""
    spent, allowed, refused = 0.0, [], {}
    for one in pictures:
        cost = 0.0 if records.is_paid(one) else backend.cost
        if cost > 0 and spent + cost > config.generator_budget + 1e-9:
            budget = config.generator_budget
            refused[one.id] = f"it would cost {cost:g} credits, over the budget of {budget:g}"
            continue
        spent += cost
        allowed.append(one)
    return allowed, refused


def _announce(
    allowed: list[ObjectPictures], refused: dict[int, str], records: Records, backend: GenerationBackend,
    config: AssetsConfig, progress: Progress,
) -> None:  # fmt: skip
    """Note what is about to be sent and spent."""
    kept = sum(records.has(one) for one in allowed)
    due = sum(not records.is_paid(one) for one in allowed)
    parts = [f"{backend.name}: {len(allowed) - kept} objects are generated, {kept} are kept from before"]
    if backend.sends_to and len(allowed) > kept:
        parts.append(f"pictures of them go to {backend.sends_to}")
    if backend.cost > 0:
        parts.append(
            f"{due * backend.cost:g} credits will be spent ({backend.cost:g} each, budget {config.generator_budget:g})"
        )
    progress.note("; ".join(parts))
    if refused:
        more = len(refused) * backend.cost
        progress.note(
            f"{backend.name}: {len(refused)} objects are not sent, they would cost {more:g} credits more: allow "
            f"it with --set assets.generator_budget={due * backend.cost + more:g}"
        )


def _make(
    allowed: list[ObjectPictures], records: Records, backend: GenerationBackend
) -> tuple[dict[int, bytes], dict[int, str]]:
    """Return meshes and failures; after a `GeneratorUnavailable`, no more requests are sent."""
    gone: list[str] = []

    def one(pictures: ObjectPictures) -> bytes | str:
        if gone and not records.has(pictures):
            return gone[0]
        try:
            return records.generate(pictures)
        except GeneratorUnavailable as error:
            gone.append(str(error))
            return str(error)
        except GenerationError as error:
            return str(error)

    with ThreadPoolExecutor(max_workers=max(1, backend.at_once)) as pool:
        results = list(pool.map(one, allowed))
    meshes = {p.id: made for p, made in zip(allowed, results) if isinstance(made, bytes)}
    return meshes, {p.id: made for p, made in zip(allowed, results) if isinstance(made, str)}
