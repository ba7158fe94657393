"""How an attempt ended, by its exit code and its log; causes come from the real command line's messages."""

import errno
import os
from types import SimpleNamespace

import pytest

from reconstruction.batch.outcomes import CURES, TRANSIENT, classify, plain, split_cure
from reconstruction.cache import StageStore
from registry import SceneRegistry
from registry.errors import EnvironmentMissing, SceneBusy

pytestmark = pytest.mark.unit


def log(message: object) -> str:
    return f"[1/10] frames: ...\nsimrecon reconstruct: {message}\n"


@pytest.mark.parametrize(
    ("code", "text", "kind"),
    [
        (0, "", "published"),
        (3, log("frames: a.mp4 is empty (0 bytes). Copy it again."), "video"),
        (2, log("no such stage"), "usage"),
        (4, log("the machine lacks ffmpeg"), "machine"),
        (4, log("out of memory. Close other programs, or use --preset fast."), "memory"),
        (4, log("No space left on device (/x). Check disk space."), "disk"),
        (1, "Traceback\nMemoryError", "memory"),
        (1, "Traceback\nValueError: x", "bug"),
        (-9, "", "killed"),
        (-11, "", "killed"),
        (137, "", "killed"),
        (130, "", "interrupted"),
    ],
)
def test_the_kind_follows_from_exit_code_and_message(code, text, kind):
    outcome = classify(code, text)
    assert outcome.kind == kind
    assert outcome.transient == (kind in TRANSIENT)
    if kind != "published":
        assert outcome.cause
        assert outcome.cure
        assert "\n" not in outcome.cause


def test_a_kill_by_the_kernel_for_memory_is_told_apart():
    assert classify(-9, "", out_of_memory=True).kind == "memory"


def test_the_messages_of_the_real_store_and_registry_are_understood(tmp_path, monkeypatch):
    registry = SceneRegistry(tmp_path, create=True)
    with registry.hold("room"), pytest.raises(SceneBusy) as busy, registry.hold("room"):
        pass
    assert classify(busy.value.exit_code, log(busy.value)).kind == "busy"
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=10))
    with pytest.raises(EnvironmentMissing) as full:
        StageStore(tmp_path / "work")
    assert classify(full.value.exit_code, log(full.value)).kind == "disk"
    says = os.strerror(errno.ENOSPC)
    assert classify(4, log(f"depth: cannot write its result to /w: {says}. Free some space")).kind == "disk"
    assert classify(4, log(f"x: {os.strerror(errno.EDQUOT)}")).kind == "disk"


def test_a_message_is_split_into_cause_and_cure():
    assert split_cure("frames: a.mp4 is empty (0 bytes). Copy it again.") == (
        "frames: a.mp4 is empty (0 bytes)",
        "Copy it again.",
    )
    assert split_cure("no cure here") == ("no cure here", "")
    assert classify(3, log("no cure here")).cure == CURES["video"]


def test_control_characters_and_long_texts_do_not_reach_the_terminal():
    assert plain("a\x1b[31mb\nc\u2028d\x00") == "a [31mb c d"
    assert len(plain("x" * 10_000)) == 300
    assert plain("\udcff") == "?"
