"""Output streams that are closed, full or read no further; names that are not UTF-8; users without a home."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from reconstruction.cli import describe_os_error, main
from reconstruction.commands.options import write_output
from reconstruction.commands.streams import TolerantStream
from registry.errors import EnvironmentMissing

ROOT = Path(__file__).resolve().parents[2]
FULL = Path("/dev/full")
# Writes enough to fill every buffer, like a long list or the progress of a run, and ends with a code of its own.
LONG = """
import sys, time
import reconstruction.cli as cli
from reconstruction.commands.reporting import make_listener
def run(arguments):
    with make_listener(False) as listener:
        for number in range(300):
            listener.begin_stage("stage", number, 300, False)
            listener.note("n" * 1000)
            print("line", number, "x" * 1000, flush=number % 7 == 0)
            sys.stdout.flush()
    open(sys.argv[1], "w").write("finished")
    return 0
parser = cli.build_parser
def with_run():
    found = parser()
    found.set_defaults(run=run)
    found._subparsers._group_actions[0].choices["doctor"].set_defaults(run=run)
    return found
cli.build_parser = with_run
sys.exit(cli.main(["doctor"]))
"""

pytestmark = pytest.mark.stage


def shell(redirect: str, tmp_path: Path) -> tuple[int, str, bool]:
    """Run the long command in a shell; return its exit code, what else was said, and whether it went to its end."""
    done = tmp_path / "done"
    (tmp_path / "long.py").write_text(LONG)
    line = f'{{ "{sys.executable}" "{tmp_path / "long.py"}" "{done}"; echo "code $?" >&9; }} {redirect}'
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    found = subprocess.run(
        ["bash", "-c", f"exec 9>&1; ({line})"], capture_output=True, text=True, env=environment, timeout=120
    )
    code = next(part.split()[1] for part in found.stdout.splitlines() if part.startswith("code"))
    return int(code), found.stdout + found.stderr, done.exists()


@pytest.mark.parametrize(
    ("redirect", "code"),
    [
        ("2>/dev/null | head -1", 0),
        ("2>&1 | head -1", 0),
        (">&-", 0),
        ("2>&-", 0),
        (">&- 2>&-", 0),
        ("<&- >&- 2>&-", 0),
        (">/dev/full", 4),
        ("2>/dev/full", 0),
        (">/dev/full 2>/dev/full", 4),
    ],
)
def test_trouble_with_output_does_not_end_a_run(redirect: str, code: int, tmp_path: Path) -> None:
    found, said, finished = shell(redirect, tmp_path)
    assert finished
    assert found == code, said
    assert "Traceback" not in said
    assert "Exception ignored" not in said
    assert "Check disk space" not in said
    if redirect == ">/dev/full":
        assert (
            "the output could not be written (No space left on device); the work itself is not affected"
            in said
        )


def test_help_goes_into_a_pipe_that_closes(tmp_path: Path) -> None:
    line = f'"{sys.executable}" -m reconstruction.cli reconstruct --list-options | head -1; echo "${{PIPESTATUS[0]}}"'
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert done.stdout.splitlines()[-1] == "0"
    assert done.stderr == ""


class TestStream:
    def test_characters_that_an_encoding_lacks_are_escaped(self, tmp_path: Path) -> None:
        with (tmp_path / "out").open("w", encoding="ascii") as file:
            stream = TolerantStream(file)
            print("étagère \udce9 ok", file=stream)  # type: ignore[arg-type]
        assert (tmp_path / "out").read_text() == "\\xe9tag\\xe8re \\udce9 ok\n"
        assert stream.trouble is None

    def test_a_closed_stream_is_no_error(self, tmp_path: Path) -> None:
        file = (tmp_path / "out").open("w")
        stream = TolerantStream(file)
        file.close()
        print("x", file=stream, flush=True)  # type: ignore[arg-type]
        assert stream.trouble is not None
        assert stream.loss == ""


@pytest.mark.parametrize(
    "line",
    [
        ["reconstruct", "caf\udce9.mp4"],
        ["reconstruct", "a.mp4", "--work-dir", "w\udcff"],
        ["check", "\udce9"],
        ["show", "s", "--registry", "\udce9"],
        ["report", "s", "--out", "\udce9.html"],
    ],
)
def test_a_name_that_is_not_utf8_is_said_at_once(line: list[str], capsys: pytest.CaptureFixture) -> None:
    assert main(line) == 2
    said = capsys.readouterr().err
    assert "is not UTF-8. Rename the file" in said
    assert "\\udc" in said


def test_a_user_without_a_home_is_told_what_to_set(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    import pwd

    def nobody(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("SIMRECON_HOME", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", nobody)
    assert main(["list"]) == 4
    assert "Set HOME or SIMRECON_HOME" in capsys.readouterr().err


@pytest.mark.skipif(not FULL.exists(), reason="no /dev/full")
def test_a_full_disk_names_the_output_and_its_flag(tmp_path: Path) -> None:
    with pytest.raises(
        EnvironmentMissing, match=r"--out /dev/full: cannot be written: No space left on device"
    ):
        write_output(FULL, "x" * 100_000, "--out")
    assert FULL.is_char_device(), "a device is written to, never replaced"


def test_a_report_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    import resource
    import signal

    page = tmp_path / "page.html"
    write_output(page, "old", "--out")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
        with pytest.raises(EnvironmentMissing, match=r"--out .*page.html: cannot be written: File too large"):
            write_output(page, "x" * 100_000, "--out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert page.read_text() == "old"
    assert [item.name for item in tmp_path.iterdir()] == ["page.html"]


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (
            OSError(28, "No space left on device", "/a/b"),
            r"No space left on device \(/a/b\). Free some space",
        ),
        (PermissionError(13, "Permission denied", "/a"), r"Permission denied \(/a\). Fix the permissions"),
        (OSError(24, "Too many open files"), "ulimit"),
        (OSError(5, "Input/output error", "/a"), r"\(/a\). Check the file and its disk"),
        (OSError(18, "Invalid cross-device link", "/a", None, "/b"), r"\(/a and /b\)"),
    ],
)
def test_an_error_of_the_file_system_says_what_helps(error: OSError, says: str) -> None:
    import re

    assert re.search(says, describe_os_error(error))


def test_an_import_without_a_home_only_warns(monkeypatch: pytest.MonkeyPatch) -> None:
    import pwd

    from simrecon_envs.registration import register_default_scenes

    def nobody(uid: int) -> None:
        raise KeyError(uid)

    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("SIMRECON_HOME", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", nobody)
    with pytest.warns(RuntimeWarning, match="no scene was registered"):
        register_default_scenes()
