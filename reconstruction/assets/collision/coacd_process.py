"""The child process of CoACD: requests on stdin, results on stdout (see `decomposition`).

It runs by its path and imports nothing of this project, so that it starts fast and from any folder.
"""

import io
import os
import struct
import sys
from typing import IO

import numpy as np

_LENGTH = struct.Struct("<q")


def send(stream: IO[bytes], arrays: dict) -> None:
    """Write named arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    stream.write(_LENGTH.pack(buffer.getbuffer().nbytes))
    stream.write(buffer.getbuffer())
    stream.flush()


def receive(stream: IO[bytes]) -> dict[str, np.ndarray]:
    """Read named arrays.

    Raises:
        EOFError: the other process has ended.
    """
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        raise EOFError
    data = stream.read(_LENGTH.unpack(head)[0])
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def main() -> None:
    """Report whether CoACD can be imported, then answer requests until the parent has ended."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # CoACD prints to stdout
    try:
        import coacd
    except (ImportError, OSError) as error:
        send(answers, {"missing": np.array(f"{type(error).__name__}: {error}")})
        return
    send(answers, {})
    coacd.set_log_level("error")
    while True:
        try:
            asked = receive(sys.stdin.buffer)
        except EOFError:
            return
        pieces = coacd.run_coacd(
            coacd.Mesh(asked["vertices"], asked["faces"]),
            threshold=float(asked["threshold"]),
            max_convex_hull=int(asked["budget"]),
            preprocess_mode="off",  # the mesh is manifold; voxel remeshing would inflate it
            resolution=100,
            mcts_nodes=6,
            mcts_iterations=6,
            mcts_max_depth=2,
            max_ch_vertex=int(asked["hull_vertices"]),
            decimate=True,
            seed=int(asked["seed"]),
        )
        parts = {str(number): np.asarray(vertices, np.float64) for number, (vertices, _) in enumerate(pieces)}
        send(answers, parts)


if __name__ == "__main__":
    main()
