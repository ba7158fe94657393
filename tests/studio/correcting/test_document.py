"""The overrides file as a document: acts, undo, redo, edits by hand, killed servers."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from reconstruction.editing.overrides import Overrides
from registry.errors import UsageError
from studio.correcting import yaml_text
from studio.correcting.document import Document
from studio.correcting.journal import BY_HAND

_MEMORY = Path("/dev/shm")  # files are flushed to disk at every act: faster where there is none
_WORDS = st.one_of(
    st.text(max_size=30),
    st.sampled_from(
        [
            "<img src=x onerror=alert(1)>",
            "a\u202eb",
            "x\x07\x1b[31m",
            "- {id: 1}",
            "# no",
            "'\"",
            "yes",
            "1e3",
            "\x85",
        ]
    ),
)
_PIXEL = st.fixed_dictionaries(
    {
        "frame": st.integers(0, 999),
        "x": st.floats(0, 4000).map(lambda x: round(x, 1)),
        "y": st.integers(0, 3000),
    }
)
_ENTRIES = st.one_of(
    st.builds(lambda p, w: {"pixel": p, "relabel": w}, _PIXEL, _WORDS),
    st.builds(lambda n: {"id": n, "drop": True}, st.integers(1, 99)),
    st.builds(lambda p, q: {"merge": [{"pixel": p}, {"pixel": q}, {"id": 3}]}, _PIXEL, _PIXEL),
    st.builds(lambda p, q: {"split": [[{"pixel": p}, {"at": [0.1, 2, 3.5]}], {"pixel": q}]}, _PIXEL, _PIXEL),
    st.builds(lambda n, m: {"id": n, "mass_kg": m}, st.integers(1, 99), st.floats(0.001, 9e4)),
)  # fmt: skip
# Labels of one printable line: those that a document accepts.
_VALID_ENTRIES = _ENTRIES.filter(
    lambda entry: entry.get("relabel", "x").strip() and entry.get("relabel", "x").isprintable()
)
_BY_HAND = st.sampled_from(
    [
        "",
        "[]",
        "# only a comment\n",
        "# head\n- {id: 5, drop: true}  # why\n\n# before the next\n- id: 7\n  # inside\n  relabel: mug\n# end",
        "  - id: 1\n    merge: &all\n    drop: true\n  - {id: 2, drop: true}\n",
        "[{id: 5, drop: true}, {id: 6, relabel: mug}]  # all in one\n",
        "[\n  {id: 5, drop: true},  # first\n  {id: 6, drop: true} # last\n]\n",
        "---\n- &a {id: 5, drop: true}\n- *a\n...\n",
        "-\n  id: 3\n  relabel: |\n    two\n    # lines\n- {id: 2, drop: true}",
        "- {id: 5, drop: true}\r\n- {id: 6, relabel: café}\r\n",
    ]
)


@settings(max_examples=60, deadline=None)
@given(_BY_HAND, _ENTRIES, _WORDS)
def test_an_added_entry_is_the_last_and_the_text_before_it_stays(text: str, entry: dict, title: str) -> None:
    new = yaml_text.appended(text, entry, title)
    assert repr(yaml.safe_load(new)) == repr([*(yaml.safe_load(text) or []), entry])
    for comment in (
        "# why",
        "# before the next",
        "# inside",
        "# end",
        "# all in one",
        "# first",
        "# last",
        "&a",
    ):
        assert comment in new or comment not in text
    added = yaml_text.appended("", entry, title)
    assert added.count("\n") == 1
    assert added[:-1].isprintable()


@settings(max_examples=60, deadline=None)
@given(_BY_HAND, st.integers(0, 3), _ENTRIES)
def test_removal_and_replacement_touch_one_entry(text: str, number: int, entry: dict) -> None:
    old = yaml.safe_load(text) or []
    if number >= len(old):
        return
    cut = yaml_text.removed(text, number)
    assert repr(yaml.safe_load(cut) or []) == repr(old[:number] + old[number + 1 :])
    new = yaml_text.replaced(text, number, entry)
    assert repr(yaml.safe_load(new)) == repr([*old[:number], entry, *old[number + 1 :]])
    for comment in ("# head", "# before the next"):
        assert comment not in text or (comment in cut and comment in new)


class _Acts(RuleBasedStateMachine):
    """Acts, undos, redos, edits by hand and restarts, against a list of texts with a cursor."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(dir=_MEMORY if _MEMORY.exists() else None))
        self.path = self.folder / "fixes.yaml"

    @initialize(text=_BY_HAND)
    def begin(self, text: str) -> None:
        self.path.write_bytes(text.encode())
        self.pages = [Document(self.path), Document(self.path)]
        self.texts, self.now = [text], 0

    def _did(self, text: str) -> None:
        self.texts[self.now + 1 :] = [text]
        self.now += 1

    @rule(entry=_VALID_ENTRIES, title=_WORDS, page=st.integers(0, 1))
    def append(self, entry: dict, title: str, page: int) -> None:
        got = self.pages[page].append(entry, title)
        assert repr(got.entries) == repr([*(yaml.safe_load(self.texts[self.now]) or []), entry])
        self._did(got.text)

    @rule(page=st.integers(0, 1), data=st.data())
    def delete(self, page: int, data: st.DataObject) -> None:
        entries = yaml.safe_load(self.texts[self.now]) or []
        if not entries:
            return
        number = data.draw(st.integers(0, len(entries) - 1))
        got = self.pages[page].delete(number, "delete")
        assert repr(got.entries) == repr(entries[:number] + entries[number + 1 :])
        self._did(got.text)

    @rule(page=st.integers(0, 1))
    def undo(self, page: int) -> None:
        self.now = max(0, self.now - 1)
        assert self.pages[page].undo().text == self.texts[self.now]

    @rule(page=st.integers(0, 1))
    def redo(self, page: int) -> None:
        self.now = min(len(self.texts) - 1, self.now + 1)
        assert self.pages[page].redo().text == self.texts[self.now]

    @rule(text=_BY_HAND, page=st.integers(0, 1))
    def edit_by_hand(self, text: str, page: int) -> None:
        changed = text != self.texts[self.now]
        self.path.write_bytes(text.encode())
        got = self.pages[page].state()
        assert got.by_hand == changed
        if changed:
            self._did(text)
            assert got.undo == BY_HAND

    @rule(page=st.integers(0, 1))
    def restart(self, page: int) -> None:
        self.pages[page] = Document(self.path)

    @rule(page=st.integers(0, 1), torn=st.binary(max_size=20).filter(lambda b: b"\n" not in b))
    def killed_while_writing_the_journal(self, page: int, torn: bytes) -> None:
        with self.path.with_name("fixes.yaml.journal").open("ab") as journal:
            journal.write(torn)
        self.pages[page] = Document(self.path)

    @rule(entry=_VALID_ENTRIES, page=st.integers(0, 1))
    def killed_between_journal_and_file(self, entry: dict, page: int) -> None:
        def killed(text: str) -> None:
            raise KeyboardInterrupt

        document = self.pages[page]
        document._write = killed  # type: ignore[method-assign]
        with contextlib.suppress(KeyboardInterrupt):
            document.append(entry, "cut off")
        self.pages[page] = Document(self.path)
        self._did(yaml_text.appended(self.texts[self.now], entry, "cut off"))

    @invariant()
    def the_file_is_what_one_expects(self) -> None:
        if hasattr(self, "texts"):
            assert self.path.read_bytes().decode() == self.texts[self.now]

    def teardown(self) -> None:
        shutil.rmtree(self.folder)


_Acts.TestCase.settings = settings(max_examples=25, stateful_step_count=20, deadline=None)
TestActs = _Acts.TestCase


@pytest.mark.stage
def test_a_killed_process_loses_no_confirmed_act(tmp_path: Path) -> None:
    script = """
        import sys
        from pathlib import Path
        from studio.correcting.document import Document
        document = Document(Path(sys.argv[1]))
        for number in range(100000):
            document.append({"id": number, "drop": True}, f"act {number}")
            print(number, flush=True)
    """
    path, confirmed = tmp_path / "fixes.yaml", -1
    for _ in range(3):
        process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(script), str(path)], stdout=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": "."},
        )  # fmt: skip
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(0.15)
        process.send_signal(signal.SIGKILL)
        confirmed += 1 + len(process.stdout.read().split())
        process.wait()
        state = Document(path).state()
        assert len(state.entries) >= confirmed + 1
        assert len(Overrides.load(path).entries) == len(state.entries)
        confirmed = len(state.entries) - 1
    document = Document(path)
    for _ in range(confirmed + 1):
        document.undo()
    assert document.state().text == ""


def test_a_file_broken_by_hand_is_said_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "fixes.yaml"
    document = Document(path)
    document.append({"id": 3, "drop": True}, "drop can 3")
    path.write_text("- {id: 3, drop: true\n- nothing")
    state = document.state()
    assert "line 3: not valid YAML" in state.error
    assert state.entries == []
    with pytest.raises(UsageError, match="mend the file by hand, or undo"):
        document.append({"id": 4, "drop": True}, "drop")
    assert path.read_text() == "- {id: 3, drop: true\n- nothing"
    assert document.undo().text == "- {id: 3, drop: true}  # drop can 3\n"
    path.write_text("- {id: 3, vanish: true}\n")
    state = document.state()
    assert "vanish" in state.error
    assert document.delete(0, "delete").entries == []


def test_an_entry_that_no_stage_can_apply_is_refused(tmp_path: Path) -> None:
    document = Document(tmp_path / "fixes.yaml")
    with pytest.raises(UsageError, match="mass_kg must be a positive number"):
        document.append({"id": 3, "mass_kg": -1}, "mass of can 3")
    assert document.state().entries == []


def test_a_damaged_journal_is_put_aside(tmp_path: Path) -> None:
    path = tmp_path / "fixes.yaml"
    path.write_text("- {id: 3, drop: true}\n")
    (tmp_path / "fixes.yaml.journal").write_text("{}\nnot JSON\n")
    document = Document(path)
    assert document.state().entries == [{"id": 3, "drop": True}]
    assert (tmp_path / "fixes.yaml.journal.damaged").exists()
