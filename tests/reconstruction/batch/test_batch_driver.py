"""The driver on an engine of its own kind: what runs, what is repeated, what ends the batch, what a new run does."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from reconstruction.batch.attempt import Job
from reconstruction.batch.display import LineDisplay, QuietDisplay, duration
from reconstruction.batch.driver import Counts, Driver, Policy, Task
from reconstruction.batch.engines import Resources, load_engine
from reconstruction.batch.journal import Journal
from reconstruction.batch.listing import Listing
from reconstruction.batch.outcomes import CURES, Outcome
from reconstruction.batch.plan import Choice, make_plan
from reconstruction.batch.rows import VideoRow
from registry import SceneRegistry
from registry.errors import EnvironmentMissing, UsageError

pytestmark = pytest.mark.unit


class ScriptedEngine:
    """Ends every job at the next call, as the script says: outcomes of a scene's attempts in order."""

    name = "scripted"

    def __init__(self, script: dict[str, list[str]], places: int = 2) -> None:
        self.script, self.places = script, places
        self.running: list[Job] = []
        self.started: list[Job] = []
        self.most = 0
        self.apart_broken = False
        self.stopped = self.closed = False

    def room(self, job: Job) -> bool:
        return len(self.running) < self.places

    def start(self, job: Job) -> None:
        self.started.append(job)
        self.running.append(job)
        self.most = max(self.most, len(self.running))

    def finished(self, timeout_s: float) -> list[tuple[Job, Outcome]]:
        ended, self.running = self.running, []
        return [(job, self.outcome(job)) for job in ended]

    def outcome(self, job: Job) -> Outcome:
        if self.stopped:
            return Outcome("interrupted", "interrupted", CURES["interrupted"])
        kinds = self.script.get(job.scene_id, ["video"])
        kind = kinds[min(job.attempt, len(kinds)) - 1]
        return Outcome(kind, f"cause {kind}", CURES.get(kind, ""), wall_s=1.0, node="n1")

    def stop(self) -> None:
        self.stopped = True

    def close(self) -> None:
        self.closed = True


def task(scene: str, folder: Path, apart: object = None) -> Task:
    job = Job(scene, "f", (), folder / "registry", folder / "logs" / f"{scene}.log")
    return Task(job, f"/films/{scene}.mp4", apart)


def drive(tmp_path, script, names, places=2, display=None, retries=2, apart=None, engine=None):
    journal = Journal(tmp_path)
    engine = engine or ScriptedEngine(script, places)
    with journal.held():
        driver = Driver(
            journal,
            engine,
            SceneRegistry(tmp_path / "registry"),
            display or QuietDisplay(),
            Policy(retries, 0.0),
        )
        summary = driver.run([task(name, tmp_path, (apart or {}).get(name)) for name in names])
    return summary, engine, journal


def test_each_video_ends_once_and_transient_failures_are_repeated(tmp_path):
    script = {"a": ["killed", "memory", "video"], "b": ["usage"], "c": ["disk", "disk", "disk"], "d": ["bug"]}
    summary, engine, journal = drive(tmp_path, script, "abcd")
    assert (summary.failed, summary.waiting, summary.interrupted) == (4, 0, False)
    assert Counter(job.scene_id for job in engine.started) == {"a": 3, "b": 1, "c": 3, "d": 1}
    ends = Counter(e["scene"] for e in journal.events() if e["event"] == "ended" and e["result"] == "failed")
    assert ends == dict.fromkeys("abcd", 1)
    assert engine.most == 2
    assert engine.closed
    states = journal.states()
    assert (states["a"].kind, states["c"].kind, states["c"].attempts) == ("video", "disk", 3)
    assert all(state.cause and state.cure for state in states.values())


def test_an_attempt_that_reaches_a_further_stage_is_no_retry(tmp_path):
    class Advancing(ScriptedEngine):
        """Writes the stage that each attempt reached into its log."""

        def start(self, job: Job) -> None:
            super().start(job)
            stage = (1, 2, 2, 5, 5, 5, 5, 6)[job.attempt - 1]
            job.log.parent.mkdir(exist_ok=True)
            job.log.write_text(f"[{stage}/11] name: ...\n")

    engine = Advancing({"a": ["killed"] * 8}, 2)
    summary, _, journal = drive(tmp_path, None, "a", engine=engine)  # two retries at each stage
    assert summary.failed == 1
    assert journal.states()["a"].attempts == 6  # 1, 2, 2, 5, 5, 5


def test_a_failure_of_the_machine_keeps_the_next_attempt_off_it(tmp_path):
    _, engine, _ = drive(tmp_path, {"a": ["disk", "killed", "video"]}, "a")
    assert [job.avoid for job in engine.started] == [(), ("n1",), ("n1",)]


def test_videos_that_may_share_a_folder_do_not_run_at_the_same_time(tmp_path):
    _, engine, _ = drive(tmp_path, {}, "abc", places=3, apart={"a": 7, "b": 7, "c": 8})
    assert engine.most == 2
    assert [job.scene_id for job in engine.started] == ["a", "c", "b"]


def test_a_machine_that_fails_every_video_ends_the_batch_early(tmp_path):
    names = [f"v{n}" for n in range(20)]
    summary, engine, _ = drive(tmp_path, {name: ["machine"] for name in names}, names, places=1, retries=1)
    assert summary.failed == 3
    assert summary.waiting == 17
    assert "cause machine" in summary.trouble
    assert not summary.interrupted
    assert len(engine.started) == 6 or len(engine.started) == 7


def test_faults_of_videos_never_end_the_batch_early(tmp_path):
    names = [f"v{n}" for n in range(20)]
    summary, _, _ = drive(tmp_path, {}, names)
    assert (summary.failed, summary.waiting, summary.trouble) == (20, 0, "")


def test_published_counts_only_what_is_in_the_registry(tmp_path):
    summary, _, journal = drive(tmp_path, {"a": ["published"]}, "a")
    assert (summary.published, summary.failed) == (0, 1)
    state = journal.states()["a"]
    assert state.result == "failed"
    assert "registry" in state.cause + state.cure


def test_an_interrupt_ends_running_videos_and_keeps_all_for_the_next_run(tmp_path, monkeypatch):
    import os
    import signal

    class Interrupting(ScriptedEngine):
        def start(self, job: Job) -> None:
            super().start(job)
            if len(self.started) == 2:
                os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    summary, engine, journal = drive(tmp_path, {}, "abcdef", engine=Interrupting({}))
    assert summary.interrupted
    assert summary.waiting == 6
    assert len(engine.started) == 2
    assert engine.closed
    assert {state.result for state in journal.states().values()} == {"interrupted"}
    assert signal.getsignal(signal.SIGINT) is before


def row(name: str, folder: Path, **changes) -> VideoRow:
    video = folder / f"{name}.mp4"
    if not video.exists():
        video.write_bytes(name.encode())
    return replace(VideoRow(name, video, where=name), **changes)


def plan(tmp_path, journal, rows, **choice):
    found = make_plan(
        Listing("x", tuple(rows)),
        journal.states(),
        SceneRegistry(tmp_path / "registry"),
        choice=Choice(**choice),
    )
    return {step.row.scene_id: (step.runs, step.reason) for step in found}


def test_the_next_run_does_only_what_is_missing_or_changed(tmp_path):
    rows = [row(name, tmp_path) for name in "abcd"]
    journal = Journal(tmp_path)
    journal.path.touch()
    ends = {"a": ("failed", "video"), "b": ("failed", "killed"), "c": ("published", "published")}
    for name, (result, kind) in ends.items():
        fingerprint = rows["abcd".index(name)].fingerprint()
        journal.append("started", scene=name, fingerprint=fingerprint)
        journal.append("ended", scene=name, fingerprint=fingerprint, result=result, kind=kind)
    journal.append("started", scene="d", fingerprint=rows[3].fingerprint())  # the driver was killed
    assert plan(tmp_path, journal, rows) == {
        "a": (False, "failed"),
        "b": (True, "failed: killed"),
        "c": (True, "not in the registry"),
        "d": (True, "unfinished"),
    }
    assert plan(tmp_path, journal, rows, retry_failed=True)["a"] == (True, "failed")
    assert all(runs for runs, _ in plan(tmp_path, journal, rows, rerun=True).values())
    changed = [replace(rows[0], options=("depth.planes=8",)), row("e", tmp_path)]
    assert plan(tmp_path, journal, changed) == {"a": (True, "changed"), "e": (True, "new")}


def test_lines_say_how_far_the_batch_is(tmp_path, capsys):
    drive(tmp_path, {"a": ["killed", "video"]}, "ab", display=LineDisplay(), places=1)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "[0/2] a: started"
    assert "trying again (attempt 2)" in lines[1]
    assert lines[-1].startswith("[2/2] ")
    assert "2 failed, 0 running, 0 waiting" in lines[-1]


def test_a_table_shows_running_videos_and_their_stages(tmp_path):
    rich_console = pytest.importorskip("rich.console")
    from reconstruction.batch.display import TableDisplay

    log = tmp_path / "a.log"
    log.write_text("[2/10] poses: 5.1 s, peak 0.4 GB\n[3/10] depth: ...\n")
    job = Job("a", "f", (), tmp_path, log, attempt=2)
    console = rich_console.Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    display = TableDisplay()
    console.print(display._picture(Counts(5, 1, 1, 1, 2, 3700.0), [job], 0.0))
    text = console.export_text()
    assert "3/10 depth" in text
    assert "1 published, 1 failed, 1 running, 2 waiting, about 1 h 2 min left" in text


def test_lengths_of_time_have_two_units():
    assert [duration(x) for x in (3.4, 61, 3600, 5400, 200_000)] == [
        "3 s",
        "1 min",
        "1 h",
        "1 h 30 min",
        "2 days 7 h",
    ]


def test_an_engine_of_another_package_is_a_class(tmp_path):
    made = load_engine(f"{__name__}:ScriptedEngine", Resources())
    assert isinstance(made, ScriptedEngine)
    for name in ("nope", "os:nope", "no_such_module:X"):
        with pytest.raises(UsageError, match="there are local, ray"):
            load_engine(name, Resources())


def test_a_full_disk_under_the_journal_is_said(tmp_path):
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full")
    journal = Journal(tmp_path)
    journal.path.symlink_to(full)
    with pytest.raises(EnvironmentMissing, match="Free some space"):
        journal.append("started", scene="a")
