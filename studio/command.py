"""`simrecon studio`: serves scenes of the registry as web pages, or writes one as a self-contained page."""

import argparse
import time

from registry import SceneRegistry
from registry.errors import EnvironmentMissing

# Parts of a page, `module:class`, in the order of their tabs.
PARTS = ("studio.looking:LookingPart",)


def run(arguments: argparse.Namespace) -> int:
    """Serve pages until interrupted."""
    check_viser()
    from studio.parts import load_parts
    from studio.scene_view import StudioPage

    page = StudioPage(
        SceneRegistry(arguments.registry),
        arguments.scene,
        parts=load_parts(PARTS),
        host=arguments.host,
        port=arguments.port,
    )
    print(f"http://{arguments.host}:{page.port}", flush=True)
    try:
        while True:
            time.sleep(1)
    finally:
        page.close()


def check_viser() -> None:
    """Raise `EnvironmentMissing` where viser is not installed."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise EnvironmentMissing(
            f"the studio needs viser, which is not installed ({error}); pip install 'simrecon[studio]'"
        ) from error
