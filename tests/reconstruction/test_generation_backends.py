"""Clients of generation services against servers that follow each protocol, or violate it."""

import json
import re
import socket

import numpy as np
import pytest
from generation_servers import HunyuanServer, RodinServer, as_glb, thing_mesh
from local_server import reply

from reconstruction.assets import AssetsConfig
from reconstruction.assets.generation import (
    GenerationError,
    GeneratorUnavailable,
    Job,
    ObjectPictures,
    check_generator,
    load_generator,
)
from reconstruction.assets.generation import records as records_module
from reconstruction.assets.generation.base import Picture
from reconstruction.assets.generation.hunyuan import Hunyuan3D
from reconstruction.assets.generation.meshes import read_generated
from reconstruction.assets.generation.pictures import without_specks
from reconstruction.assets.generation.records import Records
from reconstruction.assets.generation.rodin import Rodin
from reconstruction.assets.generation.service import ServiceLimits
from reconstruction.doctor.learned import generator_checks
from registry.errors import EnvironmentMissing, UsageError
from synthetic.containers import make_mug

LIMITS = ServiceLimits(timeout_s=5.0, max_bytes=2 << 20, pause_s=0.01, poll_s=0.01)
HTML = (200, {"Content-Type": "text/html"}, b"<html>please sign in</html>")
MESH = as_glb(thing_mesh(make_mug))


def pictures(seed: int = 0, count: int = 1) -> ObjectPictures:
    color = np.random.default_rng(seed).integers(0, 255, (40, 60, 3), np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[10:30, 15:40] = True
    return ObjectPictures(3, "mug", (Picture(color, mask),) * count)


@pytest.fixture
def rodin(monkeypatch):
    monkeypatch.setenv("SIMRECON_RODIN_KEY", "secret-key")
    with RodinServer(MESH) as server:
        yield server


@pytest.fixture
def hunyuan():
    with HunyuanServer(MESH) as server:
        yield server


def rodin_client(server, limits: ServiceLimits = LIMITS, tier: str = "") -> Rodin:
    return Rodin(server.url, tier, 7, limits)


def hunyuan_client(server, limits: ServiceLimits = LIMITS, poll: bool = False) -> Hunyuan3D:
    return Hunyuan3D(server.url, textured=True, poll=poll, seed=7, limits=limits)


def test_rodin_is_sent_pictures_of_the_object_alone(rodin):
    import cv2

    assert rodin_client(rodin).generate(pictures(count=2), Job()) == MESH
    (sent,) = rodin.sent("/api/v2/rodin")
    fields = dict(re.findall(rb'name="(\w+)"\r\n\r\n([^\r]*)\r\n', sent))
    assert fields[b"tier"] == b"Gen-2"
    assert fields[b"geometry_file_format"] == b"glb"
    assert fields[b"use_original_alpha"] == b"true"
    assert fields[b"prompt"] == b"mug"
    files = re.findall(
        rb'name="images"; filename="\d\.png"\r\nContent-Type: image/png\r\n\r\n(.*?)\r\n--', sent, re.S
    )
    assert len(files) == 2
    image = cv2.imdecode(np.frombuffer(files[0], np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.shape[0] == image.shape[1] >= 256
    assert (image[image[..., 3] == 0][:, :3] == 255).all()  # nothing of what is around it
    assert 0.3 < (image[..., 3] > 128).mean() < 0.8
    assert [json.loads(body)["subscription_key"] for body in rodin.sent("/api/v2/status")] == ["sub-1"] * 3
    assert json.loads(rodin.sent("/api/v2/download")[0]) == {"task_uuid": "task-1"}
    assert set(rodin.keys) == {"Bearer secret-key"}


def test_specks_are_removed_from_pictures():
    mask = np.zeros((40, 60), bool)
    mask[5:25, 5:25] = mask[5:25, 40:50] = mask[35:37, 55:58] = True
    kept = without_specks(mask)
    assert kept[5:25, 5:25].all()
    assert kept[5:25, 40:50].all()  # cut in two by something in front
    assert kept.sum() == mask.sum() - 6


def test_rodins_key_goes_to_no_other_host(rodin):
    with RodinServer(MESH) as elsewhere:
        listed = reply({"list": [{"name": "base_basic_pbr.glb", "url": f"{elsewhere.url}/files/mesh"}]})
        rodin.broken["/api/v2/download"] = [listed]
        assert rodin_client(rodin).generate(pictures(), Job()) == MESH
        assert elsewhere.keys == [None]


def test_rodins_cost_is_that_of_its_tier(rodin):
    assert rodin_client(rodin).cost == 0.5
    assert rodin_client(rodin, tier="Gen-2.5-Extreme-High").cost == 1.0
    assert rodin_client(rodin).balance() == 12.5


@pytest.mark.parametrize(
    ("path", "answers"),
    [
        ("/api/v2/rodin", [(429, {"Retry-After": "0.02"}, b"slow down"), (500, {}, b"oops")]),
        ("/api/v2/status", [(429, {}, b""), (502, {}, b"<html>bad gateway</html>"), (503, {}, b"")]),
        ("/api/v2/download", [(500, {}, b"")]),
        ("/files/mesh?signature=1", [(503, {}, b"")]),
    ],
)
def test_a_busy_service_gets_a_second_request(rodin, path, answers):
    rodin.broken[path] = list(answers)
    assert rodin_client(rodin).generate(pictures(), Job()) == MESH


@pytest.mark.parametrize(
    ("path", "answer", "error", "message"),
    [
        ("/api/v2/rodin", (401, {}, b"no such key"), GeneratorUnavailable, "refuses the key.*401"),
        ("/api/v2/rodin", (402, {}, b"top up"), GeneratorUnavailable, "more credits"),
        ("/api/v2/rodin", (400, {}, b"bad image"), GenerationError, "HTTP 400: bad image"),
        ("/api/v2/rodin", (504, {}, b""), GenerationError, "not sent again"),
        ("/api/v2/rodin", "hang", GenerationError, "not sent again"),
        ("/api/v2/rodin", HTML, GeneratorUnavailable, "no Rodin service.*text/html.*sign in"),
        (
            "/api/v2/rodin",
            reply({"error": "NO_FUNDS", "message": "sorry"}),
            GenerationError,
            "NO_FUNDS sorry",
        ),
        ("/api/v2/status", HTML, GeneratorUnavailable, "text/html"),
        ("/api/v2/status", reply({"jobs": [{"status": "Failed"}]}), GenerationError, "task-1 failed"),
        (
            "/api/v2/download",
            reply({"list": [{"name": "a.fbx", "url": "x"}]}),
            GenerationError,
            "no .glb.*a.fbx",
        ),
        ("/files/mesh?signature=1", HTML, GenerationError, "no .glb but text/html"),
        ("/files/mesh?signature=1", (403, {}, b"expired"), GeneratorUnavailable, "403"),
        ("/files/mesh?signature=1", (200, {}, b"glTF" + bytes(3 << 20)), GenerationError, "more than 2 MB"),
    ],
)
def test_errors_of_rodin_are_one_line(rodin, path, answer, error, message):
    rodin.broken[path] = [answer]
    client = rodin_client(rodin, ServiceLimits(timeout_s=0.4, max_bytes=2 << 20, pause_s=0.01, poll_s=0.01))
    with pytest.raises(error, match=f"(?s){message}") as caught:
        client.generate(pictures(), Job())
    assert type(caught.value) is error or error is GenerationError
    assert "\n" not in str(caught.value)
    assert "secret-key" not in str(caught.value)
    assert len(rodin.sent("/api/v2/rodin")) == 1


def test_a_late_task_is_resumed_by_the_next_run(rodin, tmp_path):
    rodin.states = ["Generating"]
    limits = ServiceLimits(timeout_s=0.15, max_bytes=2 << 20, pause_s=0.01, poll_s=0.02)
    first = Records(tmp_path, rodin_client(rodin, limits))
    with pytest.raises(GenerationError, match=r"not done within 0\.15 s"):
        first.generate(pictures())
    assert first.is_paid(pictures())
    rodin.states = ["Done"]
    again = Records(tmp_path, rodin_client(rodin))
    assert again.generate(pictures()) == MESH
    assert len(rodin.sent("/api/v2/rodin")) == 1  # paid once
    assert not list(tmp_path.glob("*.pending.json"))


def test_a_task_unknown_to_the_service_is_dropped(rodin, tmp_path):
    records = Records(tmp_path, rodin_client(rodin))
    rodin.broken["/api/v2/status"] = [(404, {}, b"no such subscription")]
    with pytest.raises(GenerationError, match="no such subscription"):
        records.generate(pictures())
    assert not records.is_paid(pictures())


def test_hunyuan_answers_with_the_file(hunyuan):
    assert hunyuan_client(hunyuan).generate(pictures(), Job()) == MESH
    (sent,) = hunyuan.sent("/generate")
    body = json.loads(sent)
    assert body["image"][:8] == "iVBORw0K"  # a PNG in base64
    assert (body["texture"], body["seed"], body["type"]) == (True, 7, "glb")


def test_hunyuan_is_polled_until_done(hunyuan):
    job = Job()
    assert hunyuan_client(hunyuan, poll=True).generate(pictures(), job) == MESH
    assert [path for _, path, _ in hunyuan.requests] == ["/send"] + ["/status/7"] * 3


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ((404, {}, b'{"text": "NETWORK ERROR", "error_code": 1}'), "refused the request or failed.*NETWORK ERROR"),
        (HTML, "no .glb but text/html"),
        ((200, {}, b""), "no .glb"),
        ("hang", "no answer in time"),
    ],
)  # fmt: skip
def test_errors_of_hunyuan_are_one_line(hunyuan, answer, message):
    hunyuan.broken["/generate"] = [answer]
    client = hunyuan_client(
        hunyuan, ServiceLimits(timeout_s=0.3, max_bytes=2 << 20, pause_s=0.01, poll_s=0.01)
    )
    with pytest.raises(GenerationError, match=f"(?s){message}"):
        client.generate(pictures(), Job())
    assert len(hunyuan.sent("/generate")) == 1


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (reply({"status": "error", "message": "out of memory"}), "out of memory"),
        (reply({"status": "completed", "model_base64": "%%%"}), "no base64"),
        (reply({"status": "completed", "model_base64": "aGVsbG8="}), r"no \.glb"),
        (reply({"status": "completed"}), r"no \.glb"),
    ],
)
def test_errors_while_polling_hunyuan(hunyuan, answer, message):
    hunyuan.broken["/status/7"] = [answer]
    with pytest.raises(GenerationError, match=message):
        hunyuan_client(hunyuan, poll=True).generate(pictures(), Job())


def test_an_unreachable_service():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}"
    client = Hunyuan3D(url, textured=True, poll=False, seed=0, limits=LIMITS)
    with pytest.raises(GeneratorUnavailable, match="cannot be reached"):
        client.generate(pictures(), Job())


def test_recorded_meshes_are_not_requested_or_paid_again(rodin, tmp_path, monkeypatch):
    records = Records(tmp_path, rodin_client(rodin))
    assert records.generate(pictures()) == MESH
    rodin.close()
    monkeypatch.delenv("SIMRECON_RODIN_KEY")
    offline = Records(tmp_path, rodin_client(rodin))
    assert offline.generate(pictures()) == MESH
    with pytest.raises(GeneratorUnavailable, match="SIMRECON_RODIN_KEY is not set"):
        offline.generate(pictures(seed=1))
    (note,) = (f for f in tmp_path.glob("*.json") if "cost_credits" in f.read_text())
    record = json.loads(note.read_text())
    assert record["cost_credits"] == 0.5
    assert [e["address"].rsplit("/", 1)[1] for e in record["exchanges"]] == [
        "rodin",
        *["status"] * 3,
        "download",
        "mesh",
    ]
    everything = b"".join(f.read_bytes() for f in tmp_path.iterdir())
    assert b"secret-key" not in everything
    assert (tmp_path / record["pictures"][0]).is_file()


def test_records_differ_by_the_inputs_of_the_mesh(rodin, tmp_path):
    mine = Records(tmp_path, rodin_client(rodin))
    mine.generate(pictures())
    assert mine.has(pictures())
    assert not mine.has(pictures(seed=1))
    assert not Records(tmp_path, rodin_client(rodin, tier="Sketch")).has(pictures())


def test_a_damaged_task_file_is_ignored(tmp_path):
    note = tmp_path / "x.pending.json"
    note.write_text('{"uuid": 3')
    assert records_module.read_task(note) is None


def test_missing_keys_and_packages_are_reported_first(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMRECON_GENERATION_RECORDS", str(tmp_path))
    monkeypatch.delenv("SIMRECON_RODIN_KEY", raising=False)
    with pytest.raises(EnvironmentMissing, match="SIMRECON_RODIN_KEY"):
        check_generator(AssetsConfig(generator="rodin"))
    with pytest.raises(EnvironmentMissing, match=r"needs trellis.*github\.com/microsoft/TRELLIS"):
        check_generator(AssetsConfig(generator="trellis"))
    with pytest.raises(EnvironmentMissing, match="needs sam3d_objects"):
        check_generator(AssetsConfig(generator="sam3d"))
    with pytest.raises(UsageError, match="generator_url"):
        load_generator(AssetsConfig(generator="hunyuan3d", generator_url="localhost:8081"))
    (tmp_path / "rodin-0.glb").write_bytes(MESH)
    check_generator(AssetsConfig(generator="rodin"))  # kept meshes need no key
    assert load_generator(AssetsConfig()) is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "cannot be read"),
        (b"<html></html>", "cannot be read"),
        (MESH[: len(MESH) // 2], "cannot be read"),
        (b"glTF" + bytes(100), "cannot be read"),
    ],
)
def test_unreadable_meshes_are_errors(data, message):
    with pytest.raises(GenerationError, match=message):
        read_generated(data)


def test_degenerate_meshes_are_errors():
    mesh = thing_mesh(make_mug)
    holed = mesh.copy()
    holed.vertices[5] = np.nan
    with pytest.raises(GenerationError, match="not finite"):
        read_generated(as_glb(holed))
    flat = mesh.copy()
    flat.vertices[:, 2] = 0
    with pytest.raises(GenerationError, match="flat"):
        read_generated(as_glb(flat))


def test_a_mesh_keeps_its_size_axes_and_colors():
    mesh = thing_mesh(make_mug)
    read = read_generated(as_glb(mesh, scale=10.0))
    np.testing.assert_allclose(read.extents, 10 * mesh.extents, rtol=1e-5)
    assert read.vertices[:, 2].min() == pytest.approx(0, abs=1e-6)
    assert read.colors[:, 0].mean() > 3 * read.colors[:, 1].mean()


def test_a_huge_mesh_is_decimated():
    mesh = thing_mesh(make_mug)
    while len(mesh.faces) < 70_000:
        mesh = mesh.subdivide()
    read = read_generated(as_glb(mesh))
    assert len(read.faces) <= 61_000
    np.testing.assert_allclose(read.extents, mesh.extents, rtol=0.01)


def test_doctor_checks_generators(rodin, hunyuan, monkeypatch):
    monkeypatch.setattr("reconstruction.assets.generation.rodin.RODIN_URL", rodin.url)
    monkeypatch.setenv("SIMRECON_HUNYUAN3D_URL", hunyuan.url)
    checks = {check.name: check for check in generator_checks()}
    assert checks["assets.generator=rodin"].detail == "the account has 12.5 credits"
    assert checks["assets.generator=hunyuan3d"].ok
    assert not checks["assets.generator=trellis"].ok
    rodin.broken["/api/v2/check_balance"] = [(401, {}, b"who?")]
    monkeypatch.setenv("SIMRECON_HUNYUAN3D_URL", "http://127.0.0.1:9")
    checks = {check.name: check for check in generator_checks()}
    assert "refuses the key" in checks["assets.generator=rodin"].detail
    assert "nobody answers" in checks["assets.generator=hunyuan3d"].detail
