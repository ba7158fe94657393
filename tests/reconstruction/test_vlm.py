"""The client of vision-language models against a server that speaks the protocol, and breaks it in every way."""

import json

import numpy as np
import pytest
from chat_server import Server, chat
from pydantic import BaseModel, ConfigDict

from reconstruction.learned.vlm import Endpoint, VlmClient, VlmError, VlmUnavailable, json_part
from registry.errors import EnvironmentMissing

IMAGE = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)


class Color(BaseModel):
    """What the tests ask for."""

    model_config = ConfigDict(extra="forbid")
    id: int
    color: str


GOOD = chat('{"id": 7, "color": "red"}')


@pytest.fixture
def server():
    with Server() as running:
        yield running


def client_of(server: Server, **options) -> VlmClient:
    return VlmClient(Endpoint(server.url, "tiny-vl", **{"pause_s": 0.01, "timeout_s": 2.0} | options))


def test_a_question_carries_the_prompt_the_pictures_and_the_schema(server) -> None:
    server.responses = [GOOD]
    answer = client_of(server, key="secret").ask("Which color?", [IMAGE, IMAGE[:10]], Color)
    assert (answer.id, answer.color) == (7, "red")
    (sent,) = server.requests
    assert sent["path"] == "/v1/chat/completions"
    assert sent["model"] == "tiny-vl"
    assert sent["temperature"] == 0
    text, *pictures = sent["messages"][0]["content"]
    assert text == {"type": "text", "text": "Which color?"}
    assert [p["image_url"]["url"][:23] for p in pictures] == ["data:image/jpeg;base64,"] * 2
    assert sent["response_format"]["json_schema"]["schema"]["required"] == ["id", "color"]
    assert server.headers[0]["Authorization"] == "Bearer secret"


@pytest.mark.parametrize(
    "failure",
    [
        (429, {"Retry-After": "0.02"}, "slow down"),
        (429, {"Retry-After": "Fri, 31 Dec 1999 23:59:59 GMT"}, ""),
        (500, {}, "oops"),
        (503, {}, "<html>starting</html>"),
    ],
)
def test_a_busy_or_failing_endpoint_is_asked_again(server, failure) -> None:
    server.responses = [failure, failure, GOOD]
    assert client_of(server).ask("?", [], Color).color == "red"
    assert len(server.requests) == 3


def test_an_endpoint_that_keeps_failing_is_given_up(server) -> None:
    server.responses = [(500, {}, "out of memory")]
    with pytest.raises(VlmUnavailable, match=r"HTTP 500: out of memory"):
        client_of(server).ask("?", [], Color)
    assert len(server.requests) == 5


def test_a_refused_key_is_not_tried_again(server) -> None:
    server.responses = [(401, {}, "no such key")]
    with pytest.raises(VlmUnavailable, match="HTTP 401"):
        client_of(server).ask("?", [], Color)
    assert len(server.requests) == 1


def test_fields_that_an_endpoint_does_not_take_are_left_out(server) -> None:
    server.responses = [(400, {}, "response_format is not supported"), GOOD]
    client = client_of(server)
    client.ask("?", [], Color)
    client.ask("again?", [], Color)
    assert "response_format" in server.requests[0]
    assert all("response_format" not in sent for sent in server.requests[1:])


def test_a_question_that_is_refused_fails_alone(server) -> None:
    server.responses = [(400, {}, "too many pictures")]
    with pytest.raises(VlmError, match="too many pictures") as caught:
        client_of(server).ask("?", [IMAGE], Color)
    assert not isinstance(caught.value, VlmUnavailable)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ("I think that it is red.", "no JSON object"),
        ('{"id": 7, "color": ', "no JSON object"),
        ('{"id": 7, "color": "red",}', "JSON"),
        ('{"id": 7}', "color: Field required"),
        ('{"id": 7, "color": "red", "mood": "good"}', "mood"),
        ('{"id": 99, "color": "red"}', "there is no object 99"),
        ("", "no JSON object"),
    ],
)
def test_an_answer_that_does_not_fit_is_asked_for_again_with_the_reason(server, bad, reason) -> None:
    def check(answer: Color) -> None:
        if answer.id != 7:
            raise ValueError(f"there is no object {answer.id}")

    server.responses = [chat(bad), GOOD]
    assert client_of(server).ask("?", [IMAGE], Color, check).color == "red"
    first, second = (sent["messages"] for sent in server.requests)
    assert second[: len(first)] == first
    assert second[1] == {"role": "assistant", "content": bad}
    assert reason in second[2]["content"]


def test_a_model_that_never_answers_right_is_given_up(server) -> None:
    server.responses = [chat("no idea")]
    with pytest.raises(VlmError, match=r"in 3 attempts.*no JSON object") as caught:
        client_of(server).ask("?", [], Color)
    assert not isinstance(caught.value, VlmUnavailable)
    assert len(server.requests) == 3


@pytest.mark.parametrize(
    "response",
    [
        (200, {"Content-Type": "text/html"}, "<html><body>Welcome to nginx</body></html>"),
        (200, {"Content-Type": "application/json"}, '{"hello": "world"}'),
        (200, {"Content-Type": "application/json"}, '{"choices": []}'),
        (200, {"Content-Type": "application/json"}, "[1, 2]"),
    ],
)
def test_something_else_at_the_address_is_said(server, response) -> None:
    server.responses = [response]
    with pytest.raises(VlmUnavailable, match="no chat completions endpoint"):
        client_of(server).ask("?", [], Color)


def test_an_answer_that_takes_too_long_is_given_up(server) -> None:
    server.responses = ["hang"]
    with pytest.raises(VlmUnavailable, match=r"no answer within 0\.1 s"):
        client_of(server, timeout_s=0.1).ask("?", [], Color)


def test_nobody_at_the_address() -> None:
    with pytest.raises(VlmUnavailable, match="cannot be reached"):
        VlmClient(Endpoint("http://127.0.0.1:9/v1", "m", pause_s=0.001)).ask("?", [], Color)


@pytest.mark.parametrize(
    "text",
    [
        '```json\n{"id": 7, "color": "red"}\n```',
        '<think>Is it {blue}? No.</think>{"id": 7, "color": "red"}',
        'Here it is: {"id": 7, "color": "red"} - anything else?',
    ],
)
def test_the_answer_is_found_in_what_models_write_around_it(text) -> None:
    assert json.loads(json_part(text)) == {"id": 7, "color": "red"}


def test_content_in_parts_is_put_together(server) -> None:
    body = {"choices": [{"message": {"content": [{"type": "text", "text": '{"id": 7, "color": "red"}'}]}}]}
    server.responses = [(200, {}, json.dumps(body))]
    assert client_of(server).ask("?", [], Color).color == "red"


# ---- Records.


def test_recorded_exchanges_are_replayed_without_an_endpoint(server, tmp_path) -> None:
    server.responses = [chat("hm"), GOOD]
    first = client_of(server, records=tmp_path, key="secret").ask("?", [IMAGE], Color)
    assert len(list(tmp_path.glob("*.json"))) == 2  # the useless answer, too
    assert len(list(tmp_path.glob("*.jpg"))) == 1
    assert not any(b"secret" in file.read_bytes() for file in tmp_path.iterdir())
    offline = VlmClient(Endpoint("", "tiny-vl", records=tmp_path))
    assert offline.ask("?", [IMAGE], Color) == first
    assert len(server.requests) == 2
    with pytest.raises(VlmUnavailable, match="no recorded answer"):
        offline.ask("?", [255 - IMAGE], Color)
    with pytest.raises(VlmUnavailable, match="no recorded answer"):
        VlmClient(Endpoint("", "another-vl", records=tmp_path)).ask("?", [IMAGE], Color)


def test_what_is_recorded_is_not_asked_again(server, tmp_path) -> None:
    server.responses = [GOOD]
    client = client_of(server, records=tmp_path)
    client.ask("?", [IMAGE], Color)
    client.ask("?", [IMAGE], Color)
    assert len(server.requests) == 1


def test_a_damaged_record_is_named(server, tmp_path) -> None:
    server.responses = [GOOD]
    client_of(server, records=tmp_path).ask("?", [], Color)
    (file,) = tmp_path.glob("*.json")
    file.write_text("{")
    with pytest.raises(VlmError, match=rf"{file.name}.*remove it"):
        client_of(server, records=tmp_path).ask("?", [], Color)


# ---- The environment.


def test_the_environment_says_where_to_ask(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("SIMRECON_VLM_URL", "http://localhost:8000/v1")
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "m")
    monkeypatch.setenv("SIMRECON_VLM_RECORDS", str(tmp_path))
    endpoint = Endpoint.from_environment("instances.labels")
    assert (endpoint.model, endpoint.key, endpoint.records) == ("m", "", tmp_path)
    assert Endpoint.from_environment("instances.labels", "other").model == "other"


def test_a_missing_endpoint_names_the_variables(monkeypatch) -> None:
    for name in ("URL", "MODEL", "KEY", "RECORDS"):
        monkeypatch.delenv(f"SIMRECON_VLM_{name}", raising=False)
    with pytest.raises(
        EnvironmentMissing, match=r"instances\.labels needs .*SIMRECON_VLM_URL.*SIMRECON_VLM_MODEL"
    ):
        Endpoint.from_environment("instances.labels")
    monkeypatch.setenv("SIMRECON_VLM_URL", "localhost:8000")
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "m")
    with pytest.raises(EnvironmentMissing, match="http://localhost:8000/v1 is expected"):
        Endpoint.from_environment("instances.labels")
