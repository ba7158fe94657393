"""A viewer of a studio page without a browser: reads the messages of viser's web socket and counts them."""

import threading
from typing import Any

import msgspec
import viser
import zstandard
from websockets.sync.client import connect


class Viewer:
    """Connects like the page's client, and keeps sizes and contents of the messages since the last `clear`."""

    def __init__(self, port: int) -> None:
        self.received_bytes = 0
        self.messages: list[dict[str, Any]] = []
        self._lock = threading.Lock()
        self._socket = connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            compression=None,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def clear(self) -> None:
        with self._lock:
            self.received_bytes, self.messages = 0, []

    def moved(self, prefix: str = "/objects/") -> list[str]:
        """Names of the nodes whose position was sent, in order."""
        with self._lock:
            return [
                m["name"]
                for m in self.messages
                if m["type"] == "SetPositionMessage" and m["name"].startswith(prefix)
            ]

    def close(self) -> None:
        self._socket.close()

    def _read(self) -> None:
        unpack = zstandard.ZstdDecompressor()
        for data in self._socket:
            size = int.from_bytes(data[8:16], "little")
            messages = msgspec.msgpack.decode(unpack.decompress(data[16 : 16 + size]))["messages"]
            with self._lock:
                self.received_bytes += len(data)
                self.messages += messages
