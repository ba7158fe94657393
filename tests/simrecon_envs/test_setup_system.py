"""tools/setup_system.sh derives the backports source from the machine's own sources, in both formats."""

import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "tools" / "setup_system.sh"

pytestmark = pytest.mark.skipif(
    not (shutil.which("bash") and shutil.which("awk")), reason="needs bash and awk"
)


def _derive(apt: Path) -> str:
    command = ["bash", str(SCRIPT), "--print-backports", str(apt), "bookworm"]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=20).stdout


@pytest.fixture
def apt(tmp_path: Path) -> Path:
    """Return an empty folder like /etc/apt."""
    (tmp_path / "sources.list.d").mkdir()
    return tmp_path


def test_deb822_keeps_mirror_and_key(apt: Path) -> None:
    (apt / "sources.list.d" / "debian.sources").write_text(
        "# x\nTypes: deb deb-src\nURIs: https://mirror.example/debian\n"
        "Suites: bookworm bookworm-updates\nComponents: main contrib\nSigned-By: /usr/share/key.gpg\n"
        "\nTypes: deb\nURIs: https://mirror.example/security\nSuites: bookworm-security\nComponents: main\n"
    )
    assert _derive(apt).splitlines() == [
        "Types: deb",
        "URIs: https://mirror.example/debian",
        "Suites: bookworm-backports",
        "Components: main",
        "Signed-By: /usr/share/key.gpg",
    ]


def test_classic_list_keeps_options(apt: Path) -> None:
    (apt / "sources.list").write_text(
        "deb-src http://mirror.example/debian bookworm main\n# deb http://other.example bookworm main\n"
        "deb [arch=amd64 signed-by=/k.gpg] http://mirror.example/debian bookworm main non-free # note\n"
    )
    expected = "deb [arch=amd64 signed-by=/k.gpg] http://mirror.example/debian bookworm-backports main"
    assert _derive(apt).strip() == expected


def test_suite_that_is_there_is_not_added_twice(apt: Path) -> None:
    (apt / "sources.list").write_text("deb http://mirror.example/debian bookworm main\n")
    (apt / "sources.list.d" / "more.sources").write_text(
        "Types: deb\nURIs: http://mirror.example/debian\nSuites: bookworm-backports\nComponents: main\n"
    )
    assert _derive(apt).strip() == "present"


def test_disabled_and_foreign_sources_are_left_out(apt: Path) -> None:
    (apt / "sources.list.d" / "x.sources").write_text(
        "Types: deb\nEnabled: no\nURIs: http://mirror.example/debian\nSuites: bookworm\nComponents: main\n"
        "\nTypes: deb\nURIs: http://vendor.example/apt\nSuites: stable\nComponents: main\n"
    )
    assert _derive(apt) == ""


def test_script_names_no_mirror() -> None:
    text = SCRIPT.read_text()
    assert "http://" not in text
    assert "https://" not in text
