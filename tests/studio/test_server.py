"""The server before the pages: gallery, routes, tokens, and who is refused; and the verb."""

import asyncio
import urllib.error
import urllib.request
from types import SimpleNamespace

import pytest
import viser
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from reconstruction.cli import build_parser
from registry import SceneRegistry
from registry.errors import EnvironmentMissing, SceneNotFound, UsageError
from studio import command
from studio.gallery import gallery_html
from studio.same_origin import is_loopback
from studio.server import StudioServer


@pytest.fixture(scope="module")
def server(made_registry):
    server = StudioServer(made_registry, port=0)
    server.start()
    yield server
    server.stop()


@pytest.fixture(scope="module")
def open_server(made_registry):
    server = StudioServer(made_registry, host="0.0.0.0", port=0)
    server.start()
    yield server
    server.stop()


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_):
        return None


def ask(server, path, **headers):
    request = urllib.request.Request(f"http://127.0.0.1:{server.port}{path}", headers=headers)
    try:
        answer = urllib.request.build_opener(_NoRedirect).open(request, timeout=20)
    except urllib.error.HTTPError as error:
        answer = error
    return SimpleNamespace(
        status=answer.status, headers=answer.headers, body=answer.read().decode("utf-8", "replace")
    )


def first_message(server, path, **headers):
    """Return the first bytes that a page sends over its web socket, or the status of its refusal."""

    async def talk():
        address = f"ws://127.0.0.1:{server.port}{path}"
        protocols = [f"viser-v{viser.__version__}"]
        try:
            async with connect(
                address, subprotocols=protocols, additional_headers=headers, max_size=None
            ) as socket:
                return await asyncio.wait_for(socket.recv(), 20)
        except InvalidStatus as error:
            return error.response.status_code

    return asyncio.run(talk())


def test_gallery_lists_scenes_with_pictures_and_ids(server):
    answer = ask(server, "/")
    assert answer.status == 200
    for scene_id in ("room", "hostile"):
        assert f'href="/s/{scene_id}/"' in answer.body
        assert f'data-id="SimRecon/{scene_id}"' in answer.body
    assert "script-src 'nonce-" in answer.headers["Content-Security-Policy"]
    assert "6 objects" in answer.body


def test_gallery_of_an_empty_registry_says_how_to_fill_it(tmp_path):
    assert "simrecon reconstruct VIDEO" in gallery_html(SceneRegistry(tmp_path / "none"))[0]


def test_a_page_opens_when_it_is_asked_for_and_its_socket_is_passed_on(server):
    assert ask(server, "/s/room").headers["Location"] == "/s/room/"
    answer = ask(server, "/s/room/")
    assert answer.status == 200
    assert "<script" in answer.body
    assert len(first_message(server, "/s/room")) > 1000
    assert server.open("room") is server.open("room")


@pytest.mark.parametrize(
    "path", ["/s/none/", "/s/../room/", "/s/NO SUCH/".replace(" ", "%20"), "/x", "/preview/none"]
)
def test_unknown_pages_are_not_found(server, path):
    answer = ask(server, path)
    assert answer.status == 404
    assert "Traceback" not in answer.body


def test_messages_show_hostile_names_as_text(server):
    assert "<img" not in ask(server, "/s/%3Cimg%20src=x%3E/").body


def test_another_site_is_refused(server):
    own = f"127.0.0.1:{server.port}"
    assert first_message(server, "/s/room", Origin="http://evil.example") == 403
    assert ask(server, "/", Origin="http://evil.example").status == 403
    assert ask(server, "/", Host="evil.example").status == 403  # a name that was made to mean 127.0.0.1
    assert ask(server, "/", Origin=f"http://{own}").status == 200


def test_beyond_loopback_a_token_is_needed(open_server):
    token = open_server.token
    assert len(token) >= 24
    assert ask(open_server, "/").status == 403
    assert ask(open_server, "/?token=wrong").status == 403
    assert ask(open_server, "/s/room/", Cookie="simrecon_studio=wrong").status == 403
    assert first_message(open_server, "/s/room") == 403
    answer = ask(open_server, f"/s/room/?token={token}")
    assert (answer.status, answer.headers["Location"]) == (302, "/s/room/")
    cookie = answer.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    cookie = cookie.split(";")[0]
    assert ask(open_server, "/s/room/", Cookie=cookie).status == 200
    assert len(first_message(open_server, "/s/room", Cookie=cookie)) > 1000
    assert token in open_server.url("room")


def test_pages_listen_on_loopback_only(open_server):
    page = open_server.open("room")
    assert page.server.get_host() == "127.0.0.1"


def test_the_port_of_a_page_refuses_other_sites_too(server):
    page = server.open("room")
    assert first_message(page, "/", Origin="http://evil.example") == 403
    assert ask(page, "/", Host="evil.example").status == 403
    assert len(first_message(page, "/", Origin=f"http://127.0.0.1:{page.port}")) > 1000


@pytest.mark.parametrize(
    ("host", "own"),
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("[::1]", True), ("0.0.0.0", False), ("10.0.0.3", False),
     ("localhost.evil.example", False), ("", False)],
)  # fmt: skip
def test_loopback_addresses_are_known(host, own):
    assert is_loopback(host) is own


def test_a_taken_port_is_one_clear_error(server, made_registry):
    with pytest.raises(EnvironmentMissing, match=f"port {server.port} .* give another --port"):
        StudioServer(made_registry, port=server.port).start()


def test_wrong_use_of_the_verb(made_registry, tmp_path):
    def run(*words):
        arguments = build_parser().parse_args(["studio", *words, "--registry", str(made_registry.root)])
        return command.run(arguments)

    with pytest.raises(UsageError, match="name the scene"):
        run("--export", "room.html")
    with pytest.raises(SceneNotFound, match="rooom"):
        run("rooom")
    with pytest.raises(UsageError, match="existing folder"):
        run("room", "--export", str(tmp_path / "none" / "room.html"))


def test_without_viser_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(EnvironmentMissing, match=r"simrecon\[studio\]"):
        command.check_viser()
