"""The tab "Play" in a real browser: a thing is dragged up with the mouse, let go, and lands."""

import time
from pathlib import Path

import numpy as np
import pytest
from browser import browser_page, require_browser
from made_scenes import BOX, TABLE_TOP_M
from PIL import Image

pytestmark = [pytest.mark.browser, pytest.mark.end_to_end]
NOTICE_PX, PANEL_PX = 186, 365  # viser's notice of software rendering, above; the panel, on the right
OF_VISER = ("THREE.Clock", "Unable to preventDefault")  # warnings of viser's own client
PATIENCE_S = 90.0  # software rendering on a busy machine draws one frame a second


@pytest.fixture
def browser(tmp_path):
    with browser_page(require_browser(), tmp_path / "profile", webgl=True) as tab:
        yield tab


def red_box(tab, path: Path):
    """Return the centre (x, y) of the box's pixels in the window, the only red thing; None: it is not seen."""
    tab.screenshot(path)
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    pixels = pixels[NOTICE_PX:, :-PANEL_PX]
    red = pixels[..., 0] - pixels[..., 1:].max(axis=-1) > 45
    if red.sum() < 20:
        return None
    rows, columns = np.nonzero(red)
    return float(np.median(columns)), float(np.median(rows)) + NOTICE_PX


def until(tab, true, what):
    limit = time.monotonic() + PATIENCE_S
    while not (value := true()):
        assert time.monotonic() < limit, f"not within {PATIENCE_S:.0f} s: {what}"
        tab.settle(0.3)
    return value


def test_a_dragged_thing_rises_in_the_picture_and_lands_when_it_is_let_go(page, browser, tmp_path):
    shot, physics = tmp_path / "shot.png", page.parts[0].physics
    browser.open(f"http://127.0.0.1:{page.port}", 1000, 560)
    browser.wait_for("document.body.innerText.includes('Run physics')", PATIENCE_S)
    x, y = until(browser, lambda: red_box(browser, shot), "the box is drawn")
    browser.press("Run physics")
    until(browser, lambda: physics.running, "the physics runs")
    until(browser, lambda: "Pause physics" in browser.text(), "the button says so")
    before = page.pose_of(BOX)
    browser.move(x, y)
    browser.settle(1.0)
    browser._mouse("mousePressed", x, y, "left", 1, ())
    for step in range(1, 16):
        browser._mouse("mouseMoved", x, y - 5 * step, "left", 1, ())
        browser.settle(0.1)
    until(browser, lambda: page.pose_of(BOX)[2, 3] > before[2, 3] + 0.1, "the box is in the air")
    until(
        browser, lambda: (at := red_box(browser, shot)) and at[1] < y - 35, "the picture shows it in the air"
    )
    browser._mouse("mouseReleased", x, y - 75, "left", 0, ())
    until(browser, lambda: page.pose_of(BOX)[2, 3] < TABLE_TOP_M + 0.05, "the box has landed")
    until(
        browser,
        lambda: (at := red_box(browser, shot)) and abs(at[1] - y) < 20,
        "the picture shows it on the table",
    )
    browser.press("Reset")
    until(browser, lambda: np.array_equal(page.pose_of(BOX), before), "it is where it was")
    until(
        browser,
        lambda: (at := red_box(browser, shot)) and np.hypot(at[0] - x, at[1] - y) < 3,
        "the picture, too",
    )
    assert [e for e in browser.errors if not any(known in e for known in OF_VISER)] == []
