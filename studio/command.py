"""`simrecon studio`: serves scenes of the registry as web pages, or writes one as a self-contained page."""

import argparse
import time
from pathlib import Path

from registry import SceneRegistry, open_registry
from registry.errors import EnvironmentMissing, UsageError
from registry.roots import is_address

# Parts of a page, `module:class`, in the order of their tabs.
PARTS = (
    "studio.looking:LookingPart",
    "studio.correcting.tab:CorrectPart",
    "studio.playing.part:PlayingPart",
)


def run(arguments: argparse.Namespace) -> int:
    """Serve pages until interrupted, or write one page."""
    scene_id: str | None = arguments.scene
    if arguments.export is not None and scene_id is None:
        raise UsageError("--export: name the scene, as in `simrecon studio SCENE --export room.html`")
    check_viser()
    registry = open_registry(arguments.registry)
    if scene_id is not None:
        registry.get(scene_id)
        if arguments.export is not None:
            return _export(registry, scene_id, arguments.export)
        _remember(registry, arguments)
    return _serve(registry, arguments)


def _remember(registry: SceneRegistry, arguments: argparse.Namespace) -> None:
    """Keep what the command line says about the scene's film, work folder and corrections.

    A film and stage results at addresses are downloaded, the results into the scene's default work folder.
    """
    from studio.remembered import remember

    video, work_dir = arguments.video, arguments.work_dir
    if is_address(video):
        from reconstruction.downloads import local_copy

        video = local_copy(video)
    if is_address(work_dir):
        from reconstruction.measure.stage_results import StageResults

        StageResults.find(registry.load(arguments.scene), registry.root, work_dir)
        work_dir = None
    remember(registry.root, arguments.scene, video=video, work_dir=work_dir, overrides=arguments.overrides)


def check_viser() -> None:
    """Raise `EnvironmentMissing` where viser is not installed."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise EnvironmentMissing(
            f"the studio needs viser, which cannot be imported ({error}); pip install 'simrecon[studio]'"
        ) from error


def _export(registry: SceneRegistry, scene_id: str, path: Path) -> int:
    from studio.export import MAX_BYTES, write_export

    if path.is_dir() or not path.absolute().parent.is_dir():
        raise UsageError(f"--export {path}: give a file name in an existing folder")
    size = write_export(registry, scene_id, path)
    print(f"{path} ({size / 1e6:.1f} MB)")
    if size > MAX_BYTES:
        print(f"larger than {MAX_BYTES / 1e6:.0f} MB: textures of this scene are large")
    return 0


def _serve(registry: SceneRegistry, arguments: argparse.Namespace) -> int:
    from studio.parts import load_parts
    from studio.same_origin import is_loopback
    from studio.server import StudioServer

    server = StudioServer(registry, load_parts(PARTS), host=arguments.host, port=arguments.port)
    server.start()
    try:
        if arguments.scene is not None:
            server.open(arguments.scene)
        print(server.url(arguments.scene), flush=True)
        if is_loopback(arguments.host):
            print(
                f"on this machine only; from another one: ssh -L {server.port}:127.0.0.1:{server.port} THIS_MACHINE"
            )
        else:
            print(
                "open to the network: whoever has this address with its token can look at and change your scenes"
            )
        print("Ctrl-C ends it", flush=True)
        while True:
            time.sleep(1)
    except KeyboardInterrupt:
        print()
        return 0
    finally:
        server.stop()
