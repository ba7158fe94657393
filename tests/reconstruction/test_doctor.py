"""`simrecon doctor` finds what is there, and says what is missing when it is taken away."""

import importlib.metadata
import json
from dataclasses import asdict
from pathlib import Path

import pytest
from chat_server import Server

from reconstruction.doctor import Check, format_checks, learned, machine, packages, process, run_checks

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def checks() -> dict[str, Check]:
    """Return the checks of this machine by name."""
    return {check.name: check for check in run_checks()}


def test_required_checks_pass_where_the_tests_run(checks: dict[str, Check]) -> None:
    broken = [check for check in checks.values() if check.required and not check.ok]
    assert broken == []


def test_physics_and_decoding_were_really_tried(checks: dict[str, Check]) -> None:
    assert "lies still" in checks["physics"].detail
    assert "h264" in checks["video decoding"].detail
    assert "10 frames" in checks["video decoding"].detail


def test_every_check_that_fails_says_what_to_do(checks: dict[str, Check]) -> None:
    assert all(check.fix for check in checks.values() if not check.ok)
    assert all(check.detail for check in checks.values())


def test_checks_are_json(checks: dict[str, Check]) -> None:
    text = json.dumps([asdict(check) for check in checks.values()])
    assert {"name", "ok", "detail", "fix", "required"} == set(json.loads(text)[0])


def test_rendering_is_absent_without_a_vulkan_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(name, str(tmp_path / "none.json"))
    code, _, err = process.wait(process.start_call("reconstruction.doctor.trials", "rendering"))
    assert code != 0
    assert "render" in err


def test_unwritable_registry_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("a file where a folder should be")
    monkeypatch.setenv("SIMRECON_HOME", str(blocked))
    check = machine.registry_check()
    assert not check.ok
    assert check.required
    assert str(blocked) in check.fix


def test_damaged_index_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "registry").mkdir()
    (tmp_path / "registry" / "index.sqlite").write_bytes(b"not a database at all" * 100)
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path))
    check = machine.registry_check()
    assert not check.ok
    assert "damaged" in check.detail


def test_a_process_that_hangs_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "TIME_LIMIT_S", 0.5)
    check = process.finish("slow", process.start("import time; time.sleep(30)"), "wait", True)
    assert not check.ok
    assert "no answer" in check.detail


def test_a_process_that_crashes_is_reported() -> None:
    check = process.finish("crash", process.start("import os; os.kill(os.getpid(), 11)"), "repair", False)
    assert not check.ok
    assert "signal 11" in check.detail


def test_versions_compare_as_numbers() -> None:
    assert packages.numbers("2.13.0+cpu") > packages.numbers("2.3")
    assert packages.numbers("0.61") < packages.numbers("0.100.1")


def test_table_names_what_is_missing_and_what_to_do() -> None:
    text = format_checks([Check("a", True, "fine", "", True), Check("bb", False, "gone", "get it", True)])
    assert "MISSING  bb  gone" in text
    assert "-> get it" in text
    assert "cannot work here yet: bb" in text


# ---- Learned models.


def test_weights_are_looked_for_in_the_cache_of_the_hub(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("HF_HUB_CACHE", raising=False)
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    checks = {check.name: check for check in learned.learned_checks()}
    sam = checks["instances.masks=sam2"]
    assert not sam.ok
    assert not sam.required
    assert sam.fix == "hf download facebook/sam2.1-hiera-small"
    snapshot = tmp_path / "hub" / "models--facebook--sam2.1-hiera-small" / "snapshots" / "abc"
    snapshot.mkdir(parents=True)
    (snapshot / "config.json").write_text("{}")
    assert not learned.has_weights("facebook/sam2.1-hiera-small")
    (snapshot / "model.safetensors").write_bytes(b"1")
    assert learned.has_weights("facebook/sam2.1-hiera-small")
    assert {"instances.masks=sam3", "instances.masks=mask2former", "instances.labels=clip"} <= set(checks)


def test_without_transformers_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    (check,) = (c for c in learned.learned_checks() if "vlm" not in c.name and "generator" not in c.name)
    assert "simrecon[models]" in check.fix


def test_the_endpoint_is_asked_for_its_models(monkeypatch: pytest.MonkeyPatch) -> None:
    with Server() as server:
        monkeypatch.setenv("SIMRECON_VLM_URL", server.url)
        monkeypatch.setenv("SIMRECON_VLM_MODEL", "tiny-vl")
        assert learned.endpoint_check().ok
        monkeypatch.setenv("SIMRECON_VLM_MODEL", "large-vl")
        other = learned.endpoint_check()
        assert not other.ok
        assert "serves tiny-vl, not large-vl" in other.detail
        monkeypatch.setenv("SIMRECON_VLM_URL", server.url + "/nothing")
        assert "does not list its models" in learned.endpoint_check().detail
    monkeypatch.delenv("SIMRECON_VLM_URL")
    assert "SIMRECON_VLM_URL" in learned.endpoint_check().fix


def test_packages_too_broken_to_look_are_no_crash() -> None:
    (check,) = process.finish_checks("learned", process.start("import no_such_package"))
    assert not check.ok
    assert not check.required
    assert "no_such_package" in check.detail
