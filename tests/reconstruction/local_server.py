"""A server on this machine that answers as the protocol built on it says, and keeps what it was asked."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

HANG = "hang"  # in place of an answer: none comes
Answer = tuple[int, dict, bytes | str]


def reply(document: dict, status: int = 200) -> Answer:
    """Return a JSON answer."""
    return status, {"Content-Type": "application/json"}, json.dumps(document).encode()


class LocalServer:
    """Serves from its construction until it is closed; `answer` is what a protocol defines."""

    def __init__(self) -> None:
        outer, self._released = self, threading.Event()

        class Handler(BaseHTTPRequestHandler):
            def _answer(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                answer = outer.answer(self.command, self.path, dict(self.headers), body)
                if answer == HANG:
                    outer._released.wait(5)
                    return
                status, headers, data = answer
                data = data.encode() if isinstance(data, str) else data
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            do_GET = do_POST = _answer

            def log_message(self, *args) -> None:
                return

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()

    def answer(self, method: str, path: str, headers: dict, body: bytes) -> Answer | str:
        """Return the answer to a request, or `HANG`."""
        raise NotImplementedError

    def close(self) -> None:
        self._released.set()
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self):
        return self

    def __exit__(self, *error) -> None:
        self.close()
