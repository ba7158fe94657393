"""A server that speaks the chat completions protocol, or breaks it as it is told."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


def chat(text: str, status: int = 200) -> tuple[int, dict, str]:
    """Return a response of the protocol."""
    body = {"choices": [{"index": 0, "message": {"role": "assistant", "content": text}}]}
    return status, {"Content-Type": "application/json"}, json.dumps(body)


class Server:
    """Answers requests with a list of responses, the last one for ever, and keeps what it was asked."""

    def __init__(self) -> None:
        self.responses: list = []
        self.requests: list[dict] = []
        self.headers: list[dict] = []
        outer, self._released = self, threading.Event()

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.requests.append(json.loads(body) | {"path": self.path})
                outer.headers.append(dict(self.headers))
                response = outer.responses.pop(0) if len(outer.responses) > 1 else outer.responses[0]
                if response == "hang":
                    outer._released.wait(5)
                    return
                status, headers, text = response
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(text.encode())))
                self.end_headers()
                self.wfile.write(text.encode())

            def do_GET(self) -> None:
                known = self.path == "/v1/models"
                text = (
                    json.dumps({"object": "list", "data": [{"id": "tiny-vl"}]}) if known else "no such page"
                )
                self.send_response(200 if known else 404)
                self.send_header("Content-Length", str(len(text)))
                self.end_headers()
                self.wfile.write(text.encode())

            def log_message(self, *args) -> None:
                return

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}/v1"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True)
        self._thread.start()

    def __enter__(self) -> "Server":
        return self

    def __exit__(self, *error) -> None:
        self._released.set()
        self._server.shutdown()
        self._server.server_close()
