"""`simrecon reconstruct`: turns a video into a registered environment."""

import argparse
import json
import sys
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reconstruction.commands.options import SEEDS, add_common, add_verb, number, path_or_address, whole_number

if TYPE_CHECKING:
    from reconstruction.config import PipelineConfig
    from reconstruction.measure.oracle import Oracle
    from reconstruction.video_to_scene import Reconstruction

_DESCRIPTION = """Reconstruct VIDEO (any video file, or a folder of images) as a simulation-ready scene and register it
as the Gymnasium environment SimRecon/SCENE. Stages are cached: an interrupted run resumes after the last finished
stage, and a changed option runs only the stages that depend on it."""

_EPILOG = """how to film: walk slowly around the objects for 10-60 s and keep them in view; do not only rotate on the
spot. Keep the light constant. Some floor in view helps.

metric scale, best first:
  --marker-size 0.10            an ArUco or AprilTag marker of 10 cm is in view
  --scale camera-height=1.5     the mean height of the camera above the floor is 1.5 m
  --scale distance:40,100,200,300,210=1.2   pixels (100,200) and (300,210) of video frame 40 are 1.2 m apart
  --scale object:3.height=0.74  object 3 (see `simrecon show`) is 0.74 m high
  (nothing)                     assumes a camera height of 1.4 m, 1 sigma 15 %

examples:
  simrecon reconstruct room.mp4
  simrecon reconstruct room.mp4 --scene kitchen --preset quality
  simrecon reconstruct room.mp4 --studio      # watch it in the browser; needs pip install 'simrecon[studio]'
  simrecon reconstruct my_scan.r3d            # Record3D or Polycam raw data, with its poses and metric scale
  simrecon reconstruct photos/ --scene dorm --set depth.depth_side_px=640
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs, "reconstruct", "turn a video into a registered environment", _DESCRIPTION, _EPILOG
    )
    add = parser.add_argument
    add(
        "video",
        metavar="VIDEO",
        type=path_or_address,
        nargs="?",
        help="a video file, a folder of images, or an export of Record3D or Polycam with its poses; also at an address "
        "(s3://bucket/room.mp4), from which it is downloaded once",
    )
    add("--scene", metavar="ID", help="scene id, a-z 0-9 _ (default: the next free sceneNNNN)")
    add(
        "--work-dir",
        type=path_or_address,
        metavar="DIR",
        help="folder of the stage cache; at an address (s3://bucket/work), a copy of it lies there, and any machine "
        "goes on from its finished stages",
    )
    add(
        "--keep-results",
        type=whole_number(1),
        default=2,
        metavar="N",
        help="cached results of each stage (default 2)",
    )
    add("--preset", choices=("fast", "default", "quality"), default="default")
    add(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="device for fitting Gaussians: cuda needs gsplat; auto uses cuda if it is available (default)",
    )
    add("--scale", metavar="HOW", help="source of the metric scale; see below")
    add("--marker-size", type=number(0.001, 5), metavar="METRES", help="side of a printed marker in view")
    add(
        "--poses",
        type=Path,
        metavar="PATH",
        help="known camera poses: a COLMAP model folder, nerfstudio's transforms.json, a Record3D recording "
        "(.r3d or unzipped) or Polycam's raw data; see docs/poses.md",
    )
    add(
        "--overrides",
        type=Path,
        metavar="FILE",
        help="your corrections (YAML): relabel, merge, split or drop objects; see docs/overrides.md",
    )
    add("--seed", type=whole_number(*SEEDS), default=0, help="seed of all random numbers (default 0)")
    add("--set", action="append", default=[], metavar="STAGE.FIELD=VALUE", help="set any option")
    add("--list-options", action="store_true", help="print all options for --set and exit")
    add("--require-stable", action="store_true", help="do not publish a scene with a moving object")
    add(
        "--oracle",
        metavar="STAGES",
        help="for evaluation: take poses, depth, world, instances (comma separated) from the ground truth",
    )
    add("--ground-truth", type=Path, metavar="DIR", help="folder with the ground truth for --oracle")
    add(
        "--studio",
        action="store_true",
        help="open a web page that fills as the stages finish and says what to film again; see docs/studio_playing.md",
    )
    add("--quiet", action="store_true", help="print only the result, no progress")
    add_common(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct a video, and print the result."""
    from registry.errors import UsageError

    if arguments.list_options:
        from reconstruction.config import describe_options

        print(describe_options())
        return 0
    if arguments.video is None:
        raise UsageError("no video is given. Give a file or a folder of images: simrecon reconstruct VIDEO")
    if isinstance(arguments.video, str):
        from reconstruction.downloads import local_copy

        quiet = arguments.quiet or arguments.json
        arguments.video = local_copy(
            arguments.video, lambda line: None if quiet else print(line, file=sys.stderr)
        )
    if not arguments.video.exists():
        raise UsageError(f"{arguments.video}: no such file or folder")
    from reconstruction.commands.reporting import make_listener
    from reconstruction.core.precompiling import compiling_behind
    from reconstruction.editing.overrides import Overrides
    from reconstruction.video_to_scene import reconstruct

    with _live_page(arguments) as page:
        with make_listener(quiet=arguments.quiet or arguments.json) as listener, compiling_behind():
            result = reconstruct(
                arguments.video,
                scene_id=arguments.scene,
                registry_root=arguments.registry,
                work_dir=arguments.work_dir,
                config=config_of(arguments),
                overrides=Overrides.load(arguments.overrides) if arguments.overrides else None,
                oracle=oracle_of(arguments),
                require_stable=arguments.require_stable,
                keep_results=arguments.keep_results,
                listener=listener if page is None else page.watch(listener),
                after_stage=None if page is None else page.show,
            )
        _print_result(result, arguments)
        if page is not None:
            page.keep(arguments.registry, result.record.scene_id)
    return 0


def _live_page(arguments: argparse.Namespace) -> AbstractContextManager[Any]:
    """Return the page of `--studio`, or a context of None; `studio` is imported by name, only if asked for."""
    if not arguments.studio:
        return nullcontext()
    return import_module("studio.live").LivePage(arguments.video)


def oracle_of(arguments: argparse.Namespace) -> "Oracle | None":
    """Load the ground truth that replaces stages; None without --oracle.

    Raises:
        UsageError: --ground-truth is given without --oracle, or a stage has no ground truth.
    """
    from registry.errors import UsageError

    if not arguments.oracle:
        if arguments.ground_truth:
            raise UsageError(
                "--ground-truth needs --oracle here; to compare a scene with it, use: simrecon evaluate"
            )
        return None
    from reconstruction.measure.oracle import Oracle

    stages = [name.strip() for name in arguments.oracle.split(",") if name.strip()]
    return Oracle.load(stages, arguments.ground_truth)


def _gaussians_backend(device: str) -> str:
    """Return the rasterizer for a device: `gsplat` for cuda, and for auto if gsplat and CUDA are available.

    Raises:
        EnvironmentMissing: `--device cuda`, but gsplat or CUDA is missing.
    """
    from importlib.util import find_spec

    if device == "cpu" or (device == "auto" and find_spec("gsplat") is None):
        return "cpu"
    from reconstruction.gaussians.backends import load_backend
    from registry.errors import EnvironmentMissing

    try:
        return load_backend("gsplat").name
    except EnvironmentMissing as error:
        if device == "auto":
            return "cpu"
        raise EnvironmentMissing(
            f"--device cuda: {error}. Leave out --device to use the CPU; docs/install.md explains how to install a "
            "CUDA build of torch"
        ) from error


def config_of(arguments: argparse.Namespace) -> "PipelineConfig":
    """Return the pipeline's config for a command line."""
    from reconstruction.config import PipelineConfig

    config = PipelineConfig.from_preset(arguments.preset).with_seed(arguments.seed)
    options = [f"gaussians.backend={_gaussians_backend(arguments.device)}", *arguments.set]
    if arguments.scale:
        options.append(f"world.scale={arguments.scale}")
    if arguments.marker_size is not None:
        options.append(f"world.marker_size_m={arguments.marker_size}")
    if arguments.poses:
        options.append(f"poses.import_path={arguments.poses}")
    for option in options:
        config = config.with_option(option)
    return config


def _print_result(result: "Reconstruction", arguments: argparse.Namespace) -> None:
    from reconstruction.commands.scenes import describe_scene
    from reconstruction.costs import costs_json
    from registry import open_registry

    registry = open_registry(arguments.registry)
    bundle = registry.load(result.record.scene_id)
    if arguments.json:
        summary = {
            "env_id": result.env_id,
            "scene": result.record.scene_id,
            "revision": result.record.revision,
            "path": str(result.record.path),
            "objects": len(bundle.scene["objects"]),
            "scale": bundle.scene["scale"],
            "physics": bundle.scene["report"]["physics"],
            "timings_s": bundle.scene["report"]["timings_s"],
            "peak_memory_mb": bundle.scene["report"]["peak_memory_mb"],
            "costs": costs_json(bundle.scene["report"]),
            "notes": bundle.scene["report"].get("notes", []),
        }
        print(json.dumps(summary, indent=2))
        return
    print(f"\n{describe_scene(result.record, bundle)}")
    print(f"picture: {Path(result.record.path) / 'preview.png'}")
    at = f" --registry {arguments.registry}" if arguments.registry else ""
    print(f"\n{result.env_id} is registered. Next:")
    print(f"  simrecon show {result.record.scene_id}{at}")
    found = f'simrecon_envs.register_scenes("{arguments.registry}"); ' if arguments.registry else ""
    code = f'import gymnasium as gym, simrecon_envs; {found}env = gym.make("{result.env_id}"); print(env.reset())'
    print(f"  python -c '{code}'")
    sys.stdout.flush()
