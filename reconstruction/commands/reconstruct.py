"""`simrecon reconstruct`: a video becomes a registered environment."""

import argparse
import json
import sys
from pathlib import Path

_DESCRIPTION = """Reconstruct VIDEO (any video file, or a folder of images) as a simulation-ready scene and register it
as the Gymnasium environment SimRecon/SCENE. Stages are cached: an interrupted run goes on where it stopped, and a
changed option redoes only what depends on it."""

_EPILOG = """how to film: walk slowly around the things you want, 10-60 s, keep them in view, do not just turn on the
spot; light that stays the same; the floor in view helps.

metric scale, best first:
  --marker-size 0.10            an ArUco or AprilTag marker of 10 cm is in view
  --scale camera-height=1.5     you held the camera 1.5 m above the floor on average
  --scale distance:40,100,200,300,210=1.2   pixels (100,200) and (300,210) of video frame 40 are 1.2 m apart
  --scale object:3.height=0.74  object 3 (see `simrecon show`) is 0.74 m high
  (nothing)                     people hold cameras about 1.4 m high, give or take 15 %

examples:
  simrecon reconstruct room.mp4
  simrecon reconstruct room.mp4 --scene kitchen --preset quality
  simrecon reconstruct my_scan.r3d            # Record3D or Polycam raw data: images, poses and metres from there
  simrecon reconstruct photos/ --scene dorm --set depth.depth_side_px=640
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Register the verb."""
    from reconstruction.commands.options import add_common

    parser = verbs.add_parser(
        "reconstruct",
        help="turn a video into a registered environment",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "video",
        metavar="VIDEO",
        type=Path,
        nargs="?",
        help="a video file, a folder of images, or an export of Record3D or Polycam with its poses",
    )
    parser.add_argument(
        "--scene", metavar="ID", help="scene id, a-z 0-9 _ (default: the next free sceneNNNN)"
    )
    parser.add_argument("--work-dir", type=Path, metavar="DIR", help="where finished stages are kept")
    parser.add_argument(
        "--keep-results",
        type=int,
        default=2,
        metavar="N",
        help="of each stage, in the work folder (default 2)",
    )
    parser.add_argument("--preset", choices=("fast", "default", "quality"), default="default")
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="where Gaussians are fitted: cuda needs gsplat; auto takes it where it is there (default)",
    )
    parser.add_argument("--scale", metavar="HOW", help="where metres come from; see below")
    parser.add_argument(
        "--marker-size", type=float, metavar="METRES", help="side of a printed marker in view"
    )
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="PATH",
        help="poses that you have: a COLMAP model folder, nerfstudio's transforms.json, a Record3D recording "
        "(.r3d or unzipped) or Polycam's raw data; see docs/poses.md",
    )
    parser.add_argument(
        "--overrides",
        type=Path,
        metavar="FILE",
        help="your corrections (YAML): relabel, merge, split, drop what you click on; see docs/overrides.md",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random (default 0)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="STAGE.FIELD=VALUE", help="set any option"
    )
    parser.add_argument("--list-options", action="store_true", help="print every option for --set and stop")
    parser.add_argument(
        "--require-stable", action="store_true", help="refuse to publish a scene that does not rest"
    )
    parser.add_argument(
        "--oracle",
        metavar="STAGES",
        help="for measuring: take poses, depth, world, instances (comma separated) from the ground truth",
    )
    parser.add_argument("--ground-truth", type=Path, metavar="DIR", help="the folder that --oracle reads")
    parser.add_argument("--quiet", action="store_true", help="no progress, only the result")
    add_common(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct and say what was found."""
    from registry.errors import UsageError

    if arguments.list_options:
        from reconstruction.config import describe_options

        print(describe_options())
        return 0
    if arguments.video is None:
        raise UsageError("which video? Give a file or a folder of images: simrecon reconstruct VIDEO")
    if not arguments.video.exists():
        raise UsageError(f"{arguments.video}: no such file or folder")
    if arguments.keep_results < 1:
        raise UsageError(
            f"--keep-results {arguments.keep_results}: at least 1 result of each stage is needed"
        )
    from reconstruction.commands.reporting import make_listener
    from reconstruction.editing.overrides import Overrides
    from reconstruction.video_to_scene import reconstruct

    listener = make_listener(quiet=arguments.quiet or arguments.json)
    with listener:
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
            listener=listener,
        )
    _print_result(result, arguments)
    return 0


def oracle_of(arguments: argparse.Namespace) -> object | None:
    """Read the truth that stands in for stages; without --oracle the truth is never touched."""
    from registry.errors import UsageError

    if not arguments.oracle:
        if arguments.ground_truth:
            raise UsageError(
                "--ground-truth is read by --oracle only; to measure a scene use: simrecon evaluate"
            )
        return None
    from reconstruction.measure.oracle import Oracle

    stages = [name.strip() for name in arguments.oracle.split(",") if name.strip()]
    return Oracle.load(stages, arguments.ground_truth)


def _gaussians_backend(device: str) -> str:
    """Choose the rasterizer: gsplat for cuda, and for auto where both are there; every other stage uses the CPU.

    Raises:
        EnvironmentMissing: `--device cuda` and something that it needs is not there.
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
            f"--device cuda: {error}. Leave --device out to compute on the CPU; docs/install.md says how to install "
            "a CUDA build of torch"
        ) from error


def config_of(arguments: argparse.Namespace) -> object:
    """Return the pipeline's config that a command line asks for."""
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


def _print_result(result: object, arguments: argparse.Namespace) -> None:
    from reconstruction.commands.scenes import describe_scene
    from reconstruction.costs import costs_json
    from registry import SceneRegistry

    registry = SceneRegistry(arguments.registry)
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
