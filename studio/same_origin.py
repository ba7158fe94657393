"""Keep other sites' scripts away from a viser server.

Web sockets are not bound to the site that opens them: any page in the user's browser may connect to a port of this
machine, and viser accepts it. viser has no hook for requests, so its call of `websockets`' `serve` is given one.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

_lock = threading.Lock()


def is_loopback(host: str) -> bool:
    """Return whether an address is this machine's own."""
    if host == "localhost":
        return True
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def refusal(request: Request, *, loopback: bool) -> str | None:
    """Return why a request is refused; None: it comes from the server's own page, or from no page.

    Args:
        request: of a browser or program.
        loopback: the server listens on loopback, so only names of this machine can be meant (against DNS rebinding).
    """
    hosts = request.headers.get_all("Host")
    host = hosts[0] if len(hosts) == 1 else ""
    if loopback and not is_loopback(urlsplit(f"//{host}").hostname or ""):
        return f"This studio answers to this machine only, not to {host!r}."
    if any(urlsplit(origin).netloc != host for origin in request.headers.get_all("Origin")):
        return "Another site may not use this studio."
    return None


@contextmanager
def same_origin_only(host: str) -> Iterator[None]:
    """Make viser servers that are started inside the block refuse requests of other sites."""
    loopback = is_loopback(host)
    with _lock:
        serve = websockets.asyncio.server.serve

        def guarded(
            *arguments: Any, process_request: Callable[..., Any] | None = None, **options: Any
        ) -> Any:
            def check(connection: ServerConnection, request: Request) -> Response | None:
                reason = refusal(request, loopback=loopback)
                if reason is not None:
                    return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
                return None if process_request is None else process_request(connection, request)

            return serve(*arguments, process_request=check, **options)

        websockets.asyncio.server.serve = guarded
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve
