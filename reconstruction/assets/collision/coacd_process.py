"""The process that CoACD runs in: questions on stdin, answers on stdout (see `decomposition`).

It is started by its path and needs nothing of this project, so that it starts at once and from anywhere.
"""

import io
import os
import struct
import sys
from typing import BinaryIO

import numpy as np

_LENGTH = struct.Struct("<q")


def send(stream: BinaryIO, arrays: dict) -> None:
    """Write named arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    stream.write(_LENGTH.pack(buffer.getbuffer().nbytes))
    stream.write(buffer.getbuffer())
    stream.flush()


def receive(stream: BinaryIO) -> dict[str, np.ndarray]:
    """Read named arrays.

    Raises:
        EOFError: the other side is gone.
    """
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        raise EOFError
    data = stream.read(_LENGTH.unpack(head)[0])
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def main() -> None:
    """Say whether CoACD is there, then answer until the other side is gone."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # CoACD prints
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
            preprocess_mode="off",  # the mesh is manifold already; the voxel remesh would inflate it
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
