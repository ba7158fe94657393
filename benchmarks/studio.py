"""Measure the studio on a scene: time until the room is seen, frame rate, bytes of state per second, export size.

    python -m benchmarks.studio SCENE [--registry DIR] [--width 960] [--height 640]

Headless Chromium renders in software (SwiftShader): figures depend on the processor, whose load is printed beside them.
Frames are those that were drawn. What the renderer itself allows is measured beside it: the same page with nothing in
view, and a page of viser alone with one box, as viser sets it up and without its lights.
"""

import argparse
import contextlib
import io
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "tests"))
_BLANK = 8.0  # standard deviation of pixel values below which a view counts as blank
_LIMIT_S = 120.0
_MOVES_S = 6.0
_RATE_HZ = 30.0  # of poses that a running simulation sends
_RESTS_S = 6.0  # until a page has loaded or come to rest, and draws nothing
_PANEL_WIDTH_PX = 360  # as in the studio
_RENDERER = """(() => {
  const canvas = [...document.querySelectorAll("canvas")].sort((a, b) => b.width - a.width)[0];
  const gl = canvas.getContext("webgl2");
  const name = gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL);
  return `${name}, ${gl.getParameter(gl.SAMPLES)} samples a pixel`;
})()"""
_COUNT_DRAWN = """(() => {
  if (window.drawn) return;
  window.drawn = { frames: 0, calls: 0, triangles: 0, now: false };
  const made = WebGL2RenderingContext.prototype;
  const counted = (name, corners) => {
    const draw = made[name];
    made[name] = function (...a) {
      drawn.now = true;
      if (corners) { drawn.calls++; drawn.triangles += corners(a) / 3; }
      return draw.apply(this, a);
    };
  };
  counted("clear", null);
  counted("drawElements", (a) => a[1]);
  counted("drawElementsInstanced", (a) => a[1] * a[4]);
  counted("drawArrays", (a) => a[2]);
  counted("drawArraysInstanced", (a) => a[2] * a[3]);
  (function frame() {
    if (drawn.now) { drawn.frames++; drawn.now = false; }
    requestAnimationFrame(frame);
  })();
})()"""


def main() -> None:
    """Print the figures of a scene."""
    from browser import browser_page, find_browser

    from registry import SceneRegistry
    from studio.command import PARTS
    from studio.export import export_html
    from studio.parts import load_parts
    from studio.server import StudioServer

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--registry", type=Path)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--height", type=int, default=640)
    arguments = parser.parse_args()
    registry = SceneRegistry(arguments.registry)
    start = time.monotonic()
    server = StudioServer(registry, load_parts(PARTS), port=0)
    server.start()
    page = server.open(arguments.scene)
    print(
        f"{len(page.bundle.objects)} objects; server ready after {time.monotonic() - start:.1f} s (imports included)"
    )
    with (
        tempfile.TemporaryDirectory() as profile,
        browser_page(find_browser(), Path(profile), webgl=True) as tab,
    ):
        address = server.url(arguments.scene)
        for visit in ("first visit", "second visit"):
            seconds, busy = until_seen(tab, address, arguments.width, arguments.height)
            print(f"{visit}: room seen after {seconds:.1f} s, {busy:.1f} s of processor time in the browser")
        tab.settle(_RESTS_S)
        print(f"renderer: {tab.evaluate(_RENDERER)}")
        tell(tab, "while looking around, the first seconds")
        tell(tab, "... and then")
        tab.settle(_RESTS_S)
        print(f"at rest: {drawn_at_rest(tab)} frames in {_MOVES_S:.0f} s ({canvas_size(tab)})")
        tab.open(address + "?fixedDpr=1", arguments.width, arguments.height)
        tab.settle(_RESTS_S)
        tell(tab, "... always in full, with 4 samples a pixel (?fixedDpr=1)")
        handles = [*page.object_handles().values(), *page.room_handles()]
        for handle in handles:
            handle.visible = False
        tell(tab, "... with nothing in view")
        for handle in handles:
            handle.visible = True
        print(f"state of all objects moving at {_RATE_HZ:.0f} Hz: {state_rate(page) / 1e6:.3f} MB/s")
        tell_of_viser_alone(tab, arguments.width, arguments.height)
    server.stop()
    print(f"export: {len(export_html(registry, arguments.scene).encode()) / 1e6:.1f} MB")
    print(f"load of this machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def until_seen(tab, address: str, width: int, height: int) -> tuple[float, float]:
    """Open a page; return seconds until its 3D view is not of one color, and the browser's processor seconds."""
    import cv2

    before, start = _browser_seconds(), time.monotonic()
    tab.open(address, width, height)
    while time.monotonic() - start < _LIMIT_S:
        with tempfile.TemporaryDirectory() as folder:
            tab.screenshot(Path(folder) / "now.png")
            shown = cv2.imread(str(Path(folder) / "now.png"))
        if shown[height // 3 :, : width // 2].std() > _BLANK:
            return time.monotonic() - start, _browser_seconds() - before
        time.sleep(0.05)
    raise TimeoutError(f"the 3D view is blank after {_LIMIT_S:.0f} s")


def tell(tab, what: str) -> None:
    """Print the rate of drawn frames while the camera turns with the mouse."""
    tab.settle(1.0)
    rate, busy, draws, triangles = frame_rate(tab)
    print(
        f"frames per second {what}: {rate:.1f}, {1000 * busy:.0f} ms of processor time a frame; "
        f"{draws:.0f} draw calls, {triangles / 1000:.0f},000 triangles ({canvas_size(tab)})"
    )


def tell_of_viser_alone(tab, width: int, height: int) -> None:
    """Print the rate of a page of viser with one box, without anything of the studio."""
    import viser

    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(port=0, verbose=False)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(_PANEL_WIDTH_PX)
    server.scene.add_box("/box", dimensions=(0.3, 0.3, 0.3))
    tab.open(f"http://127.0.0.1:{server.get_port()}/?fixedDpr=1", width, height)
    tab.settle(4.0)
    tell(tab, "of viser alone, one box")
    server.scene.configure_default_lights(enabled=False)
    server.scene.configure_environment_map(None)
    tell(tab, "of viser alone, one box, no lights")
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def frame_rate(tab) -> tuple[float, float, float, float]:
    """Return drawn frames per second while the camera turns with the mouse, and what a frame takes.

    Returns:
        Frames per second, the browser's processor seconds a frame, draw calls a frame, triangles a frame.
    """
    tab.evaluate(_COUNT_DRAWN)
    x, y = 220, 300
    start, before = time.monotonic(), _browser_seconds()
    tab.evaluate("drawn.frames = drawn.calls = drawn.triangles = 0")
    while time.monotonic() - start < _MOVES_S:
        tab.drag((x, y), (x + 90, y + 20), steps=15, pause_s=0.03)
        tab.drag((x + 90, y + 20), (x, y), steps=15, pause_s=0.03)
    frames, calls, triangles = tab.evaluate("[drawn.frames, drawn.calls, drawn.triangles]")
    seconds = time.monotonic() - start
    return (
        frames / seconds, (_browser_seconds() - before) / frames, calls / frames, triangles / frames
    )  # fmt: skip


def drawn_at_rest(tab) -> int:
    """Return how many frames are drawn in a while in which nothing changes."""
    tab.evaluate("drawn.frames = 0")
    tab.settle(_MOVES_S)
    return tab.evaluate("drawn.frames")


def canvas_size(tab) -> str:
    """Return the size of the 3D view in pixels."""
    sizes = tab.evaluate("[...document.querySelectorAll('canvas')].map((c) => [c.width, c.height])")
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    return f"{width} x {height} pixels"


def state_rate(page) -> float:
    """Return bytes per second of the messages that move all objects at `_RATE_HZ`, as they are serialized."""
    recording = page.server.get_scene_serializer()
    first = len(recording._messages)
    for item in page.bundle.objects:
        pose = page.pose_of(item.id)
        pose[2, 3] += 0.001
        page.set_pose(item.id, pose)
    import msgspec

    moved = [message for _, message in recording._messages[first:]]
    recording.serialize()
    for item in page.bundle.objects:
        page.set_pose(item.id, page.bundle_pose(item.id))
    return _RATE_HZ * len(msgspec.msgpack.encode(moved))


def _browser_seconds() -> float:
    total = 0.0
    for process in psutil.Process().children(recursive=True):
        try:
            spent = process.cpu_times()
        except psutil.Error:
            continue
        total += spent.user + spent.system
    return float(np.round(total, 2))


if __name__ == "__main__":
    main()
