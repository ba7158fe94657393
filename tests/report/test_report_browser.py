"""The page in a browser, opened from disk: no errors, no requests, no blank images, phone and print layouts."""

import cv2
import numpy as np
import pytest
from browser import Page, browser_page, require_browser

pytestmark = [pytest.mark.browser, pytest.mark.end_to_end]

# Every picture and plot: its size on the page, and how much its pixels differ.
_MEASURE = """[...document.querySelectorAll("img, svg")].map((item) => {
  const box = item.getBoundingClientRect();
  const what = { kind: item.tagName, name: item.alt || item.getAttribute("aria-label"), area: box.width * box.height };
  if (item.tagName !== "IMG") return { ...what, spread: item.querySelectorAll("path, text").length };
  const canvas = document.createElement("canvas");
  canvas.width = item.naturalWidth; canvas.height = item.naturalHeight;
  const pen = canvas.getContext("2d");
  pen.drawImage(item, 0, 0);
  const pixels = pen.getImageData(0, 0, canvas.width, canvas.height).data;
  const low = [255, 255, 255], high = [0, 0, 0];
  for (let i = 0; i < pixels.length; i++) {
    if (i % 4 === 3) continue;
    low[i % 4] = Math.min(low[i % 4], pixels[i]);
    high[i % 4] = Math.max(high[i % 4], pixels[i]);
  }
  return { ...what, spread: Math.max(...high.map((value, channel) => value - low[channel])) };
})"""


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser_page(require_browser(), tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture(scope="module")
def files(page, page_with_truth, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    (folder / "plain.html").write_text(page, encoding="utf-8")
    (folder / "truth.html").write_text(page_with_truth, encoding="utf-8")
    return folder


@pytest.mark.parametrize("name", ["plain", "truth"])
def test_opens_without_error_or_request_and_nothing_is_blank(tab: Page, files, tmp_path, name):
    path = files / f"{name}.html"
    tab.open(path)
    measured = tab.evaluate(_MEASURE)
    assert len([m for m in measured if m["kind"] == "IMG"]) > 30
    assert len([m for m in measured if m["kind"] == "svg"]) >= 5
    for item in measured:
        assert item["area"] > 100, item
        assert item["spread"] > 8, item
    tab.screenshot(tmp_path / "page.jpg", full=True)
    shown = cv2.imread(str(tmp_path / "page.jpg"))
    assert shown.shape[1] == 1280
    assert shown.shape[0] > 3000
    bands = [band.std() for band in np.array_split(shown, 12)]
    assert min(bands) > 5
    assert tab.errors == []
    assert tab.requests == [path.as_uri()]


def test_errors_and_requests_would_be_noticed(tab: Page, tmp_path):
    """The check detects a script error, a missing image and a blank one."""
    bad = tmp_path / "bad.html"
    bad.write_text(
        "<img src='gone.jpg' alt='gone'><script>console.error('oh'); nothing();</script>"
        "<svg width='50' height='50'></svg>"
    )
    tab.open(bad)
    assert len(tab.errors) >= 3
    assert any("gone.jpg" in url for url in tab.requests)
    assert tab.evaluate("document.images[0].naturalWidth") == 0


def test_fits_a_phone(tab: Page, files):
    tab.open(files / "truth.html", 390, 844, phone=True)
    assert tab.evaluate("document.documentElement.scrollWidth") <= 390
    too_small = tab.evaluate(
        """[...document.querySelectorAll("main p, main td, main dd, figcaption, main li")]
        .filter((e) => e.textContent.trim() && parseFloat(getComputedStyle(e).fontSize) < 10).length"""
    )
    assert too_small == 0
    assert tab.errors == []


def test_turntables_turn_and_pictures_open(tab: Page, files):
    tab.open(files / "plain.html")
    left = "document.querySelector('.turn img').getBoundingClientRect().left"
    before = tab.evaluate(left)
    tab.evaluate(
        "(s => { s.value = 3; s.dispatchEvent(new Event('input')); })(document.querySelector('.turn input'))"
    )
    width = tab.evaluate("document.querySelector('.turn .window').clientWidth")
    assert before - tab.evaluate(left) == pytest.approx(3 * width, abs=2)
    tab.evaluate("document.querySelector('#depth .frame.zoom').click()")
    shown = "document.querySelector('dialog img').alt"
    first = tab.evaluate(shown)
    assert tab.evaluate("document.getElementById('zoom').open")
    tab.evaluate(
        "document.getElementById('zoom').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}))"
    )
    assert tab.evaluate(shown) != first
    tab.evaluate("document.getElementById('zoom').click()")
    assert not tab.evaluate("document.getElementById('zoom').open")
    assert tab.errors == []


def test_prints_with_all_angles_side_by_side(tab: Page, files, tmp_path):
    tab.open(files / "plain.html", 800, 1100)
    tab.call("Emulation.setEmulatedMedia", media="print")
    try:
        strip, card = tab.evaluate(
            "['.turn img', '.turn'].map((s) => document.querySelector(s).getBoundingClientRect().width)"
        )
        assert strip == pytest.approx(card, abs=1)
        assert tab.evaluate("getComputedStyle(document.querySelector('nav')).display") == "none"
    finally:
        tab.call("Emulation.setEmulatedMedia", media="")
    tab.pdf(tmp_path / "page.pdf")
    assert (tmp_path / "page.pdf").stat().st_size > 100_000
    assert tab.errors == []
