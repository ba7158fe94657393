"""Draw the pictures of docs/studio.md: screenshots of the studio in headless Chromium, of a scene of the registry.

    python tools/make_studio_pictures.py demo_room [--registry DIR] [--out docs/images]

The scene needs its stage cache, for photographs and for what was seen. A picture is written when its 3D view is not of
one color and has stopped changing.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from browser import Page, browser_page, find_browser  # noqa: E402

from registry import SceneRegistry  # noqa: E402
from registry.errors import EnvironmentMissing  # noqa: E402
from studio.command import PARTS  # noqa: E402
from studio.layers import COLLISION, COVERAGE, GAUSSIANS, TEXTURES  # noqa: E402
from studio.looking import LookingPart  # noqa: E402
from studio.parts import load_parts  # noqa: E402
from studio.server import StudioServer  # noqa: E402

SIZE = (1280, 800)
_PANEL_PX = 380  # right of the 3D view
_BLANK = 8.0  # standard deviation of pixel values below which a view counts as blank
_FIRST_S, _WAIT_S = 5.0, 90  # names come a moment after the rest
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 84]


def main() -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--registry", type=Path)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images")
    arguments = parser.parse_args()
    browser = find_browser()
    if browser is None:
        raise EnvironmentMissing("there is no Chromium on this machine; run tools/setup_browser.sh")
    server = StudioServer(SceneRegistry(arguments.registry), load_parts(PARTS), port=0)
    server.start()
    try:
        with (
            tempfile.TemporaryDirectory() as profile,
            browser_page(browser, Path(profile), webgl=True) as tab,
        ):
            draw(tab, server, arguments.scene, arguments.out)
    finally:
        server.stop()


def draw(tab: Page, server: StudioServer, scene_id: str, out: Path) -> None:
    """Draw the pictures of a scene into a folder."""
    page = server.open(scene_id)
    looking = next(part for part in page.parts if isinstance(part, LookingPart))
    tab.open(server.url(scene_id) + "?fixedDpr=1", *SIZE)
    shoot(tab, out / "studio.jpg", before=lambda: page.selection.set((_pick(page),)))
    for mode, name in ((GAUSSIANS, "gaussians"), (COVERAGE, "coverage"), (COLLISION, "collision")):
        looking.surfaces.value = mode
        shoot(tab, out / f"studio_{name}.jpg")
    looking.surfaces.value = TEXTURES
    page.selection.set(())
    for label in ("Names", "Relations", "Scale", "Cameras"):
        looking.boxes[label].value = True
    shoot(tab, out / "studio_layers.jpg")
    for label in ("Names", "Relations", "Scale", "Cameras"):
        looking.boxes[label].value = False
    frames = page.frames.photographed
    page.show_frame(frames[len(frames) // 2])
    page.frames.compare(1.0, 0.5)
    shoot(tab, out / "studio_compare.jpg")
    tab.open(server.url(), *SIZE)
    tab.screenshot(out / "studio_gallery.jpg", quality=84)


def _pick(page) -> int:
    """Return the object that most was seen of."""
    return max(page.bundle.objects, key=lambda o: o.provenance["observed_fraction"]).id


def shoot(tab: Page, path: Path, before=lambda: None) -> None:
    """Write a picture when the 3D view shows something and has stopped changing."""
    before()
    last = None
    tab.settle(_FIRST_S)
    for _ in range(_WAIT_S):
        tab.settle(1.0)
        tab.evaluate("document.querySelectorAll('.mantine-Notification-root').forEach((n) => n.remove())")
        with tempfile.TemporaryDirectory() as folder:
            tab.screenshot(Path(folder) / "now.png")
            now = cv2.imread(str(Path(folder) / "now.png"))
        view = now[:, : now.shape[1] - _PANEL_PX]
        if view.std() > _BLANK and last is not None and np.abs(view.astype(int) - last).mean() < 0.05:
            break
        last = view.astype(int)
    else:
        raise TimeoutError(f"{path.name}: the view did not come to rest within {_WAIT_S} s")
    cv2.imwrite(str(path), now, _JPEG)
    print(f"{path} ({path.stat().st_size / 1e3:.0f} kB)", flush=True)


if __name__ == "__main__":
    main()
