"""Generate a suite from scenes: the candidates that are proven (see `feasibility`)."""

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

from registry import UsageError, open_registry
from simrecon_envs.benchmark.candidates import SEQUENCE, Candidate, check_kinds, composites, scene_candidates
from simrecon_envs.benchmark.feasibility import Proof, ProofSettings, prove
from simrecon_envs.benchmark.parallel import Workers
from simrecon_envs.benchmark.records import Records
from simrecon_envs.benchmark.reporting import Reporter
from simrecon_envs.benchmark.splits import side_of
from simrecon_envs.benchmark.suite import LeftOut, OracleRun, Suite, SuiteTask
from simrecon_envs.files import absolute, versions
from simrecon_envs.randomization import Randomization
from simrecon_envs.robots import check_robot

_COMPOSITE_SHARE = 5  # one task in five may be a composite
DEFAULT_RANDOMIZE = {"shift_m": 0.03, "turn_rad": 0.3}


@dataclass(frozen=True, kw_only=True)
class GenerateConfig:
    """Settings of a suite. The same settings and scenes give the same suite for any number of jobs."""

    kinds: tuple[str, ...] = ()
    """Kinds of tasks; all where empty."""
    robots: tuple[str, ...] = ("panda", "fetch")
    per_scene: int = 30
    """Greatest number of tasks per scene."""
    seeds: int = 5
    """Episodes per task."""
    seed: int = 0
    """Seed from which the episodes' seeds are derived."""
    test_share: float = 0.2
    """Share of scenes and of objects in the test split."""
    randomize: dict | str | None = None
    """As of `Randomization`; None: poses by up to 3 cm and 0.3 rad. "none": only goals and starts differ."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.per_scene < 1 or self.seeds < 1:
            raise UsageError(f"--per-scene {self.per_scene}, --seeds {self.seeds}: expected at least 1")
        if not 0 <= self.test_share <= 1:
            raise UsageError(f"--test-share {self.test_share}: expected a number between 0 and 1")
        for robot in self.robots:
            check_robot(robot)

    def randomization(self) -> dict[str, float]:
        """Return the non-zero fields of the randomization."""
        wanted = DEFAULT_RANDOMIZE if self.randomize is None else self.randomize
        return {key: value for key, value in asdict(Randomization.parse(wanted)).items() if value}


def generate_suite(
    scenes: list[str],
    config: GenerateConfig,
    *,
    registry: Path | None = None,
    jobs: int = 1,
    records: Records | None = None,
    reporter: Reporter | None = None,
) -> Suite:
    """Prove candidates in scenes and return the suite.

    Args:
        scenes: Scene ids; all of the registry where empty.
        config: Settings of the suite.
        registry: The registry's folder; the default registry where None.
        jobs: Number of processes.
        records: Store of finished proofs; a run that was killed continues from it.
        reporter: Receives progress messages.

    Raises:
        UsageError: scenes are missing (lists all of them), or no candidate was proven.
    """
    reporter = reporter or Reporter(quiet=True)
    kinds = check_kinds(config.kinds)
    names = check_scenes(scenes, registry)
    settings = ProofSettings(seed=config.seed, seeds=config.seeds, randomize=config.randomization(),
                             registry=absolute(registry))  # fmt: skip
    tasks: list[SuiteTask] = []
    left_out: list[LeftOut] = []
    with Workers(jobs) as workers:
        prover = _Prover(workers, settings, records, reporter)
        for scene in names:
            reporter.start(0, f"scene {scene}")
            proven = _of_scene(scene, kinds, config, registry, prover, left_out)
            tasks += [_task(candidate, proof, config.test_share) for candidate, proof in proven]
            counts = Counter(candidate.kind for candidate, _ in proven)
            found = ", ".join(f"{count} {kind}" for kind, count in counts.items())
            reporter.note(f"scene {scene}: {len(proven)} tasks{': ' + found if found else ''}")
    if not tasks:
        reasons = "; ".join(f"{one.scene} {one.task} ({one.robot}): {one.reason}" for one in left_out[:5])
        raise UsageError(
            f"no task in {', '.join(names)} could be proven: {reasons or 'nothing in them can be done'}"
        )
    return Suite(
        tasks=tuple(tasks),
        left_out=tuple(left_out),
        options=settings.options(),
        settings={"kinds": list(kinds), "robots": list(config.robots), "per_scene": config.per_scene,
                  "seeds": config.seeds, "seed": config.seed, "test_share": config.test_share},
        made_with=versions(),
    )  # fmt: skip


def check_scenes(scenes: list[str], registry: Path | None) -> list[str]:
    """Return the unique scene ids; all of the registry where none is given.

    Raises:
        UsageError: scenes are missing; lists them and the existing ones.
    """
    catalog = open_registry(registry)
    known = list(catalog.revisions())
    wanted = list(dict.fromkeys(scene.removeprefix("SimRecon/") for scene in scenes)) or known
    missing = [scene for scene in wanted if scene not in known]
    if missing:
        there = ", ".join(known[:10]) + (f" and {len(known) - 10} more" if len(known) > 10 else "")
        raise UsageError(
            f"{len(missing)} of {len(wanted)} scenes are not in the registry {catalog.root}: {', '.join(missing)}. "
            f"There are: {there or 'none'}. Name another with --registry, or make one with `simrecon reconstruct VIDEO`"
        )
    if not wanted:
        raise UsageError(
            f"the registry {catalog.root} is empty; make a scene with `simrecon reconstruct VIDEO`"
        )
    return wanted


class _Prover:
    """Proves batches of candidates and stores the proofs."""

    def __init__(
        self, workers: Workers, settings: ProofSettings, records: Records | None, reporter: Reporter
    ) -> None:
        self._workers, self._settings, self._records, self._reporter = workers, settings, records, reporter
        self._frame = {"versions": versions(), "options": settings.options(), "seed": settings.seed,
                       "seeds": settings.seeds}  # fmt: skip

    def __call__(self, candidates: list[Candidate]) -> list[Proof]:
        """Return the proofs in the order of the candidates."""
        proofs: dict[int, Proof] = {}
        for number, candidate in enumerate(candidates):
            record = self._records.get(self._key(candidate)) if self._records else None
            if record is not None:
                proofs[number] = _proof(record)
        open_ = [number for number in range(len(candidates)) if number not in proofs]
        for place, proof in self._workers.map(prove, [candidates[n] for n in open_], self._settings):
            candidate = candidates[open_[place]]
            proofs[open_[place]] = proof
            if self._records:
                self._records.put(self._key(candidate), asdict(proof))
            how = proof.reason or f"{len(proof.oracle)} episodes, {max(r.steps for r in proof.oracle)} steps"
            if not candidate.problems:
                self._reporter.done(f"{candidate.task} ({candidate.robot}): {how}")
        return [proofs[number] for number in range(len(candidates))]

    def _key(self, candidate: Candidate) -> dict:
        return {**self._frame, **asdict(candidate)}


def _of_scene(
    scene: str,
    kinds: tuple[str, ...],
    config: GenerateConfig,
    registry: Path | None,
    prover: _Prover,
    left_out: list[LeftOut],
) -> list[tuple[Candidate, Proof]]:
    """Return the proven candidates of a scene; append the others to `left_out`."""
    reserve = config.per_scene // _COMPOSITE_SHARE if SEQUENCE in kinds else 0
    singles = scene_candidates(scene, config.robots, kinds, registry)
    found = _take(singles, config.per_scene - reserve, prover, left_out)
    pairs = list(composites([candidate for candidate, _ in found], most=reserve)) if reserve else []
    found += _take(pairs, config.per_scene - len(found), prover, left_out)
    found += _take(singles, config.per_scene - len(found), prover, left_out)  # if composites are too few
    for candidate in singles + pairs:
        reason = "; ".join(candidate.problems) or f"not tried: the scene has {len(found)} tasks without it"
        left_out.append(_left(candidate, reason))
    return found


def _take(
    candidates: list[Candidate], most: int, prover: _Prover, left_out: list[LeftOut]
) -> list[tuple[Candidate, Proof]]:
    """Remove candidates from a list until `most` of them are proven; return these.

    Batches have as many candidates as are still needed, so the result does not depend on the number of jobs.
    """
    taken: list[tuple[Candidate, Proof]] = []
    while candidates and len(taken) < most:
        batch = candidates[: most - len(taken)]
        del candidates[: len(batch)]
        for candidate, proof in zip(batch, prover(batch), strict=True):
            if proof.reason:
                left_out.append(_left(candidate, proof.reason))
            else:
                taken.append((candidate, proof))
    return taken


def _left(candidate: Candidate, reason: str) -> LeftOut:
    return LeftOut(scene=candidate.scene, robot=candidate.robot, task=candidate.task, kind=candidate.kind,
                   reason=reason)  # fmt: skip


def _task(candidate: Candidate, proof: Proof, test_share: float) -> SuiteTask:
    objects = tuple(f"{candidate.scene}/{key}" for key in candidate.objects)
    sides = {side_of(name, test_share) for name in objects}
    return SuiteTask(
        name=candidate.name,
        env_id=candidate.env_id,
        scene=candidate.scene,
        revision=candidate.revision,
        task=candidate.task,
        kind=candidate.kind,
        robot=candidate.robot,
        instruction=proof.instruction,
        max_steps=proof.max_steps,
        objects=objects,
        scene_side=side_of(candidate.scene, test_share),
        object_side="test" if "test" in sides else "train",
        oracle=proof.oracle,
    )


def _proof(record: dict) -> Proof:
    return Proof(**{**record, "oracle": tuple(OracleRun(**run) for run in record["oracle"])})
