"""One address for the gallery and all pages: routes, tokens, and the way to each page's own server.

Pages are viser servers on loopback ports. This server stands before them: `/` is the gallery, `/s/<scene>/` a page that
is opened when it is first asked for; its web socket is passed on. It checks the token and where requests come from.
"""

import asyncio
import contextlib
import hmac
import logging
import secrets
import threading
from collections.abc import Sequence
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlsplit

from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from registry import SceneRegistry
from registry.errors import EnvironmentMissing, SimReconError
from studio.gallery import gallery_html, message_html
from studio.parts import Part
from studio.player import player_html
from studio.same_origin import is_loopback, refusal
from studio.scene_view import StudioPage

logger = logging.getLogger(__name__)

DEFAULT_PORT = 8090
_PORTS = 20  # tried in a row where none is asked for
_COOKIE = "simrecon_studio"
_MAX_MESSAGE_BYTES = 1 << 28


class StudioServer:
    """Serves the gallery and pages of a registry."""

    def __init__(
        self,
        registry: SceneRegistry,
        parts: Sequence[type[Part]] = (),
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
    ) -> None:
        """Prepare a server; `start` binds it.

        Args:
            registry: its scenes are served.
            parts: of every page.
            host: address to bind; beyond loopback, a token is asked of every visitor.
            port: None tries 8090 and those after it, 0 takes a free one.
        """
        self.registry, self.host = registry, host
        self.token = None if is_loopback(host) else secrets.token_urlsafe(24)
        self._parts, self._wanted_port = tuple(parts), port
        self.port = 0
        self._pages: dict[str, StudioPage] = {}
        self._opening = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self._thread: threading.Thread | None = None
        self._failed: OSError | None = None

    # ---- Pages.

    def open(self, scene_id: str) -> StudioPage:
        """Return the page of a scene; open it if it is not open yet."""
        with self._opening:
            if scene_id not in self._pages:
                self._pages[scene_id] = StudioPage(self.registry, scene_id, parts=self._parts)
            return self._pages[scene_id]

    def url(self, scene_id: str | None = None) -> str:
        """Return the address of a page (None: of the gallery), with the token if there is one."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        if host in ("0.0.0.0", "[::]"):
            import socket

            host = socket.gethostname()
        path = "/" if scene_id is None else f"/s/{quote(scene_id)}/"
        return f"http://{host}:{self.port}{path}" + (f"?token={self.token}" if self.token else "")

    # ---- The server.

    def start(self) -> None:
        """Bind and serve in a thread.

        Raises:
            EnvironmentMissing: the address or port cannot be bound.
        """
        ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(ready)), daemon=True)
        self._thread.start()
        ready.wait()
        if self._failed is not None:
            port = DEFAULT_PORT if self._wanted_port is None else self._wanted_port
            raise EnvironmentMissing(
                f"the studio cannot listen on {self.host}, port {port} ({self._failed.strerror}); "
                "give another --port, or --port 0 for any free one"
            )

    def stop(self) -> None:
        """Close all pages and stop serving."""
        if self._loop is not None and self._stop is not None:
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._stop.set)
        if self._thread is not None:
            self._thread.join(5)
        for page in self._pages.values():
            page.close()
        self._pages.clear()

    async def _serve(self, ready: threading.Event) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        wanted = self._wanted_port
        for port in range(DEFAULT_PORT, DEFAULT_PORT + _PORTS) if wanted is None else (wanted,):
            try:
                server = await serve(
                    self._pass_on, self.host, port, process_request=self._answer, compression=None,
                    max_size=_MAX_MESSAGE_BYTES, select_subprotocol=_subprotocol, ping_timeout=120,
                )  # fmt: skip
            except OSError as error:
                self._failed = error
                continue
            self._failed, self.port = None, next(iter(server.sockets)).getsockname()[1]
            ready.set()
            async with server:
                await self._stop.wait()
            return
        ready.set()

    async def _pass_on(self, browser: ServerConnection) -> None:
        """Carry the messages of one browser to its page and back."""
        name = _scene_of(browser.request.path if browser.request else "")
        port = await asyncio.to_thread(self._port_of, name or "")
        protocols = [browser.subprotocol] if browser.subprotocol else None
        async with connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=protocols,
            compression=None,
            max_size=None,
            ping_interval=None,
        ) as page:

            async def carry(source: Any, target: Any) -> None:
                with contextlib.suppress(ConnectionClosed):
                    async for message in source:
                        await target.send(message)
                await target.close()

            await asyncio.gather(carry(browser, page), carry(page, browser))

    def _port_of(self, name: str) -> int:
        return self.open(name).port

    # ---- Requests.

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request of a browser; None lets a web socket through."""
        refused = self._refusal(request)
        if refused is not None:
            return refused
        parts = urlsplit(request.path)
        given = parse_qs(parts.query).get("token", [""])[0]
        if self.token and given:
            cookie = f"{_COOKIE}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            return _response(HTTPStatus.FOUND, "", {"Location": parts.path, "Set-Cookie": cookie})
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return None if _scene_of(parts.path) else _page(HTTPStatus.NOT_FOUND, "There is no such page.")
        return await asyncio.to_thread(self._document, parts.path)

    def _refusal(self, request: Request) -> Response | None:
        """Refuse strangers: a wrong token, a name of this machine that others gave it, another site's scripts."""
        reason = refusal(request, loopback=self.token is None)
        if reason is not None:
            return _page(HTTPStatus.FORBIDDEN, reason)
        if self.token is not None and not hmac.compare_digest(
            _token_of(request).encode(), self.token.encode()
        ):
            return _page(
                HTTPStatus.FORBIDDEN,
                "This studio asks for a token: open the address that `simrecon studio` printed.",
            )
        return None

    def _document(self, path: str) -> Response:
        try:
            if path == "/":
                body, policy = gallery_html(self.registry)
                return _response(HTTPStatus.OK, body, {"Content-Security-Policy": policy})
            if path.startswith("/preview/"):
                return self._preview(unquote(path.removeprefix("/preview/")))
            name = _scene_of(path)
            if name is not None:
                if not path.endswith("/"):
                    return _response(HTTPStatus.FOUND, "", {"Location": f"/s/{quote(name)}/"})
                self._port_of(name)
                return _response(HTTPStatus.OK, player_html(), {})
        except SimReconError as error:
            return _page(HTTPStatus.NOT_FOUND, str(error))
        return _page(HTTPStatus.NOT_FOUND, "There is no such page.")

    def _preview(self, scene_id: str) -> Response:
        picture = self.registry.load(scene_id).root / "preview.png"
        if not picture.is_file():
            return _page(HTTPStatus.NOT_FOUND, f"{scene_id} has no preview.")
        return _response(HTTPStatus.OK, picture.read_bytes(), {}, "image/png")


def _scene_of(path: str) -> str | None:
    """Return the scene of `/s/<scene>` or `/s/<scene>/`."""
    parts = unquote(urlsplit(path).path).split("/")
    return parts[2] if len(parts) in (3, 4) and parts[1] == "s" and parts[2] and not any(parts[3:]) else None


def _token_of(request: Request) -> str:
    given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
    if given:
        return given
    with contextlib.suppress(CookieError):
        jar = SimpleCookie(request.headers.get("Cookie", ""))
        if _COOKIE in jar:
            return jar[_COOKIE].value
    return ""


def _subprotocol(_: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    return next((name for name in offered if name.startswith("viser-v")), None)


def _page(status: HTTPStatus, text: str) -> Response:
    return _response(status, message_html(status.phrase, text), {})


def _response(
    status: HTTPStatus, body: str | bytes, headers: dict[str, str], kind: str = "text/html; charset=utf-8"
) -> Response:
    data = body.encode() if isinstance(body, str) else body
    fixed = {
        "Content-Type": kind, "Content-Length": str(len(data)), "Connection": "close", "Cache-Control": "no-store",
        "X-Content-Type-Options": "nosniff", "X-Frame-Options": "SAMEORIGIN", "Referrer-Policy": "no-referrer",
    }  # fmt: skip
    return Response(status.value, status.phrase, Headers({**fixed, **headers}), data)
