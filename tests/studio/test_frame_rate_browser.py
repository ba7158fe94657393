"""The page where drawing is slow: fewer pixels and triangles while things move, all at rest, none without a change."""

import io

import numpy as np
import pytest
import trimesh
from browser import Page, browser_page, require_browser
from made_scenes import BOX
from PIL import Image

from studio.as_filmed import as_filmed
from studio.command import PARTS
from studio.parts import load_parts
from studio.server import StudioServer

pytestmark = [pytest.mark.browser, pytest.mark.end_to_end]

SIZE = (1000, 700)
BALL_TRIANGLES = 5120
# Each frame takes 60 ms more. What the last frame drew, and how many there were.
SLOW_AND_COUNTED = """(() => {
  window.drawn = { frames: 0, triangles: 0, pixels: 0 };
  const made = WebGL2RenderingContext.prototype, clear = made.clear, draw = made.drawElements;
  made.clear = function (...a) {
    const end = performance.now() + 60;
    while (performance.now() < end);
    drawn.frames++;
    drawn.triangles = 0;
    drawn.pixels = this.drawingBufferWidth * this.drawingBufferHeight;
    return clear.apply(this, a);
  };
  made.drawElements = function (...a) {
    drawn.triangles += a[1] / 3;
    return draw.apply(this, a);
  };
})()"""
CANVAS_PIXELS = """Math.max(...[...document.querySelectorAll("canvas")].map((c) => {
  const b = c.getBoundingClientRect(); return b.width * b.height; }))"""


@pytest.fixture(scope="module")
def opened(made_registry, tmp_path_factory):
    """Return the page of a room with a textured ball of many triangles, a tab that rests on it, and its address."""
    server = StudioServer(made_registry, load_parts(PARTS), port=0)
    server.start()
    page = server.open("room")
    page.server.scene.add_glb("/ball", textured_ball(), position=(0.0, 0.0, 1.0))
    with browser_page(require_browser(), tmp_path_factory.mktemp("profile"), webgl=True) as tab:
        tab.call("Page.addScriptToEvaluateOnNewDocument", source=SLOW_AND_COUNTED)
        tab.open(server.url("room"), *SIZE)
        tab.wait_for(f"drawn.triangles > {BALL_TRIANGLES}")
        rests(tab)
        yield page, tab, server.url("room")
    server.stop()


def textured_ball() -> bytes:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    assert len(ball.faces) == BALL_TRIANGLES
    picture = Image.fromarray(np.full((8, 8, 3), (60, 160, 90), np.uint8))
    ball.visual = trimesh.visual.TextureVisuals(uv=ball.vertices[:, :2], image=picture)
    return as_filmed(ball.export(io.BytesIO(), file_type="glb"))


def rests(tab: Page) -> None:
    """Wait until the view is drawn larger, as it is in software once nothing changes any more."""
    tab.wait_for(f"drawn.pixels > 3.9 * {CANVAS_PIXELS}")


def last_frame(tab: Page) -> dict:
    return tab.evaluate("({ ...drawn })")


def test_nothing_is_drawn_while_nothing_changes(opened):
    page, tab, _ = opened
    tab.settle(5.0)  # frames for changes that come late
    before = last_frame(tab)["frames"]
    tab.settle(4.0)
    assert last_frame(tab)["frames"] == before
    pose = page.pose_of(BOX)
    page.set_pose(BOX, pose + 0.1 * np.eye(4, k=3))
    tab.wait_for(f"drawn.frames > {before}", 10)
    page.set_pose(BOX, pose)


def test_slow_frames_are_drawn_cheaper_while_the_camera_moves_and_in_full_at_rest(opened):
    _, tab, _ = opened
    rests(tab)
    at_rest, pixels = last_frame(tab), tab.evaluate(CANVAS_PIXELS)
    assert at_rest["triangles"] > BALL_TRIANGLES
    for _ in range(2):
        tab.drag((200, 300), (260, 310))
    moving = last_frame(tab)
    assert moving["triangles"] < BALL_TRIANGLES / 2
    assert moving["pixels"] < 0.6 * pixels
    tab.drag((260, 310), (200, 300))
    rests(tab)
    assert last_frame(tab)["pixels"] == at_rest["pixels"]
    assert last_frame(tab)["triangles"] == at_rest["triangles"]


def test_things_that_move_are_drawn_cheaper(opened):
    page, tab, _ = opened
    pose, pixels = page.pose_of(BOX), tab.evaluate(CANVAS_PIXELS)
    for step in range(60):
        page.set_pose(BOX, pose + 0.001 * step * np.eye(4, k=3))
        tab.settle(0.05)
    assert last_frame(tab)["pixels"] < 0.6 * pixels
    page.set_pose(BOX, pose)
    rests(tab)


def test_a_fixed_resolution_leaves_the_page_as_it_is(opened):
    _, tab, address = opened
    tab.open(address + "?fixedDpr=1", *SIZE)
    tab.wait_for(f"drawn.triangles > {BALL_TRIANGLES}")
    pixels = tab.evaluate(CANVAS_PIXELS)
    for _ in range(3):
        tab.drag((200, 300), (260, 310), steps=10)
    assert last_frame(tab)["pixels"] == pytest.approx(pixels, rel=0.01)
    assert last_frame(tab)["triangles"] > BALL_TRIANGLES
