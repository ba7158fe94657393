"""Reconstruct a scene from a video in Python, and print its objects.

    python examples/01_reconstruct_video.py examples/data/demo_room.mp4 --scene demo_room

As `simrecon reconstruct`, with access to intermediate results. A second run reads them from the cache, in seconds.
"""

import argparse
from pathlib import Path

from reconstruction import PipelineConfig, reconstruct
from reconstruction.commands.reporting import LineListener


def main() -> None:
    """Run the pipeline with one option changed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("video", type=Path)
    parser.add_argument("--scene", default=None)
    parser.add_argument("--registry", type=Path, default=None)
    parser.add_argument("--preset", default="default")
    arguments = parser.parse_args()

    config = PipelineConfig.from_preset(arguments.preset).with_option("frames.max_keyframes=80")
    result = reconstruct(
        arguments.video,
        scene_id=arguments.scene,
        registry_root=arguments.registry,
        config=config,
        listener=LineListener(),
    )
    posed = result.run.results["poses"]
    surface = result.run.results["surface"]
    print(f"{len(posed.images)} of {posed.chosen_frames} keyframes have a camera")
    print(f"the visible surface has {len(surface.faces)} triangles")
    for item in result.run.results["assets"].objects:
        print(f"{item.id:3d} {item.label:<10} {item.physics.mass_kg:.2f} kg of {item.physics.material}")
    print(f"registered as {result.env_id}")


if __name__ == "__main__":
    main()
