"""The process that CoACD runs in: questions on stdin, answers on stdout (see `decomposition`)."""

import os
import sys

from reconstruction.assets.collision.decomposition import receive, send


def main() -> None:
    """Answer until the other side is gone."""
    import coacd
    import numpy as np

    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # CoACD prints
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
