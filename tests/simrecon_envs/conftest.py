"""The hand-made scenes in a registry of their own, a suite of their tasks, and whether this machine can render."""

import functools
import subprocess
import sys
from pathlib import Path

import pytest
from made_scenes import publish
from made_suites import SUITE_CONFIG, DyingRecords, Killed

from registry import SceneRegistry
from simrecon_envs.benchmark.generate import generate_suite
from simrecon_envs.benchmark.records import Records
from simrecon_envs.benchmark.suite import Suite, load_suite
from simrecon_envs.processes import prepare_process


@pytest.fixture(scope="session", autouse=True)
def _loaded() -> None:
    """Load the simulator, and keep it out of the garbage collections of every scene that is built or closed."""
    prepare_process()


@pytest.fixture(scope="session")
def scenes_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a registry with `room` (furniture), `bare` (nothing can move) and `things` (for every kind of task)."""
    root = tmp_path_factory.mktemp("registry")
    registry = SceneRegistry(root, create=True)
    for scene_id in ("room", "bare", "things"):
        publish(registry, scene_id, tmp_path_factory.mktemp(scene_id))
    return root


@pytest.fixture(scope="session")
def suite_file(scenes_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a suite of `things` that was generated in two runs, the first of which was killed."""
    out = tmp_path_factory.mktemp("suite") / "suite.json"
    with pytest.raises(Killed):
        generate_suite(["things"], SUITE_CONFIG, registry=scenes_root, records=DyingRecords(out))
    records = Records(out)
    assert len(list(records.folder.iterdir())) == 2
    generate_suite(["things"], SUITE_CONFIG, registry=scenes_root, records=records).save(out)
    records.clear()
    assert [file.name for file in out.parent.iterdir()] == ["suite.json"]
    return out


@pytest.fixture(scope="session")
def suite(suite_file: Path) -> Suite:
    """Return the suite as it is in the file."""
    return load_suite(suite_file)


@functools.lru_cache(maxsize=1)
def can_render() -> bool:
    """Tell whether SAPIEN can render here; asked in another process, because a bad driver may crash."""
    code = "import sapien; sapien.render.RenderSystem(sapien.Device('cpu'))"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60).returncode == 0


@pytest.fixture(autouse=True)
def _skip_without_vulkan(request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("render") and not can_render():
        pytest.skip("SAPIEN cannot render here (see `simrecon doctor`)")
