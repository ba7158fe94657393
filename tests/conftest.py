"""The four lanes of the tests, a filmed room with known truth, and the shipped video.

A test's lane is a marker. Without a marker, tests in `simrecon_envs/` are `env`, tests of the filmed room `stage`, and
all others `unit`; of two markers `end_to_end` counts. A unit test has twenty seconds and starts no process.
"""

import logging
import subprocess
from pathlib import Path

import pytest
from kept import kept

from synthetic.capture import SyntheticCapture, make_test_capture

LANES = (
    "end_to_end",
    "stage",
    "env",
    "unit",
)  # the longest first, so that no process ends long after the others
DEMO_VIDEO = Path(__file__).parents[1] / "examples" / "data" / "demo_room.mp4"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test with its lane, and order the files by lanes."""
    rank: dict[Path, int] = {}
    for item in items:
        lane = next((lane for lane in LANES if item.get_closest_marker(lane)), None)
        if lane is None:
            lane = "env" if "simrecon_envs" in item.path.parts else "unit"
            if "small_capture" in getattr(item, "fixturenames", ()):
                lane = "stage"
            item.add_marker(lane)
        if lane == "unit" and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(20, func_only=True))
        rank[item.path] = min(LANES.index(lane), rank.get(item.path, len(LANES)))
    items.sort(key=lambda item: rank[item.path])


@pytest.fixture(autouse=True)
def _no_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forbid unit tests to start processes."""
    if request.node.get_closest_marker("unit"):

        def refuse(*_: object, **__: object) -> None:
            raise AssertionError("a unit test starts a process: mark it `stage` or `end_to_end`")

        monkeypatch.setattr(subprocess, "Popen", refuse)


@pytest.fixture(scope="session")
def small_capture() -> SyntheticCapture:
    """Twelve 320x240 frames of the generated room, world space, true cameras, depth, ids and entities."""
    return kept(_small_capture)


def _small_capture() -> SyntheticCapture:
    return make_test_capture()


@pytest.fixture(scope="session")
def demo_video() -> Path:
    """Return the path of the video that ships with the project; its truth lies beside it."""
    assert DEMO_VIDEO.is_file(), "examples/data/demo_room.mp4 is missing: run tools/make_demo_video.py"
    return DEMO_VIDEO


@pytest.fixture(scope="session")
def s3():
    """Start an S3 server in this process; return its address. Its clients find it by the environment."""
    pytest.importorskip("s3fs", reason="S3 is tested with the extra s3")
    server_module = pytest.importorskip("moto.server", reason="S3 is tested with moto")
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    host, port = server.get_host_and_port()
    settings = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            patch.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem(use_listings_cache=False).mkdir("lab")
        yield settings["AWS_ENDPOINT_URL"]
    server.stop()
