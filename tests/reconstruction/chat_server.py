"""A server that speaks the chat completions protocol, or breaks it as it is told."""

import json

from local_server import LocalServer, reply


def chat(text: str, status: int = 200) -> tuple[int, dict, bytes]:
    """Return a response of the protocol."""
    return reply({"choices": [{"index": 0, "message": {"role": "assistant", "content": text}}]}, status)


class Server(LocalServer):
    """Answers requests with a list of responses, the last one for ever, and keeps what it was asked."""

    def __init__(self) -> None:
        self.responses: list = []
        self.requests: list[dict] = []
        self.headers: list[dict] = []
        super().__init__()
        self.url += "/v1"

    def answer(self, method: str, path: str, headers: dict, body: bytes):
        if method == "GET":
            if path == "/v1/models":
                return reply({"object": "list", "data": [{"id": "tiny-vl"}]})
            return 404, {}, b"no such page"
        self.requests.append(json.loads(body) | {"path": path})
        self.headers.append(headers)
        return self.responses.pop(0) if len(self.responses) > 1 else self.responses[0]
