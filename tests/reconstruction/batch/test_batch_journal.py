"""The journal: what is appended is read, a cut-off line harms nothing, one driver at a time."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruction.batch.journal import Journal, fold
from registry.errors import EnvironmentMissing, UsageError

pytestmark = pytest.mark.unit


def filled(folder, n: int = 3) -> Journal:
    folder.mkdir(exist_ok=True)
    journal = Journal(folder)
    journal.path.touch()
    for number in range(n):
        journal.append("started", scene=f"s{number}", video=f"/v/{number}.mp4", fingerprint="f", attempt=1)
        journal.append(
            "ended", scene=f"s{number}", fingerprint="f", result="published", wall_s=2.0, revision="r"
        )
    return journal


def test_states_are_the_last_of_each_video(tmp_path):
    journal = filled(tmp_path)
    journal.append("started", scene="s1", video="/v/1.mp4", fingerprint="g", attempt=1)
    states = journal.states()
    assert states["s0"].result == "published"
    assert states["s0"].wall_s == 2.0
    assert (states["s1"].result, states["s1"].fingerprint, states["s1"].attempts) == ("", "g", 2)
    assert set(map(str, journal.known_ids())) == {"/v/0.mp4", "/v/1.mp4", "/v/2.mp4"}


@settings(max_examples=60, deadline=None)
@given(cut=st.integers(0, 10_000))
def test_cut_anywhere_it_keeps_all_whole_lines_and_goes_on(tmp_path_factory, cut):
    journal = filled(tmp_path_factory.mktemp("journal"))
    data = journal.path.read_bytes()
    kept = data[: cut % (len(data) + 1)]
    journal.path.write_bytes(kept)
    whole = [json.loads(line) for line in data.splitlines()][: kept.count(b"\n")]
    assert journal.events()[: len(whole)] == whole
    journal.append("started", scene="after", video="/v/after.mp4", fingerprint="f", attempt=1)
    assert journal.events()[-1]["scene"] == "after"
    assert journal.events()[: len(whole)] == whole


def test_lines_that_are_no_events_are_skipped(tmp_path):
    journal = filled(tmp_path, 1)
    with journal.path.open("ab") as stream:
        stream.write(b'\x00\x00\x00\n[1]\n{"event": 3}\n"x"\n\n')
    assert len(journal.events()) == 2


def test_a_journal_is_held_by_one_driver(tmp_path):
    with Journal(tmp_path).held(), pytest.raises(UsageError, match="another `simrecon batch`"):
        Journal(tmp_path).held().__enter__()
    with Journal(tmp_path).held():
        pass


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(EnvironmentMissing, match="--out"):
        Journal(tmp_path / "file" / "x").held().__enter__()


def test_an_empty_journal_has_no_states(tmp_path):
    assert Journal(tmp_path).states() == {}
    assert fold([{"event": "batch"}]) == {}
