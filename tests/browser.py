"""Headless Chromium over its DevTools pipe: opens pages from disk or a server, points, types, and says what went wrong.

No packages needed. `browser_page(executable, profile, webgl=True)` renders WebGL with SwiftShader, in software.
"""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
    "--remote-debugging-pipe",
)  # fmt: skip
_PLAIN = ("--disable-gpu",)
_WEBGL = (
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
_TEXTS = "button, a, label, input, [role=tab], summary, td, p, span, div"
# Smallest visible element of a selector with a text, label or placeholder, scrolled into view.
_FIND = """((wanted, selector) => {
  let best = null, least = Infinity;
  for (const e of document.querySelectorAll(selector)) {
    const said = [e.innerText, e.getAttribute("aria-label"), e.placeholder, e.title];
    if (!said.some((s) => s && s.trim() === wanted)) continue;
    const b = e.getBoundingClientRect(), area = b.width * b.height;
    if (b.width < 1 || b.height < 1 || getComputedStyle(e).visibility === "hidden") continue;
    if (area < least) [best, least] = [e, area];
  }
  if (!best) return null;
  best.scrollIntoView({ block: "nearest" });
  const b = best.getBoundingClientRect();
  return { x: b.x, y: b.y, width: b.width, height: b.height };
})"""
# Until endPress(), mouse events are stopped if the element is not under the pointer as the button goes down.
_GUARD = """(() => {
  const kinds = ["pointerdown", "mousedown", "pointerup", "mouseup", "click"];
  let hit = null;
  const guard = (event) => {
    if (hit === null) {
      const b = FIND;
      hit = !!b && event.clientX >= b.x && event.clientX <= b.x + b.width
        && event.clientY >= b.y && event.clientY <= b.y + b.height;
    }
    if (!hit) { event.stopImmediatePropagation(); event.preventDefault(); }
  };
  for (const kind of kinds) window.addEventListener(kind, guard, true);
  window.endPress = () => {
    for (const kind of kinds) window.removeEventListener(kind, guard, true);
    return hit === true;
  };
})()"""
_BUTTONS = {"left": 1, "right": 2, "middle": 4}
_MODIFIERS = {"alt": 1, "ctrl": 2, "meta": 4, "shift": 8}
# Keys that type no text: name -> (code, Windows virtual key code).
_KEYS = {
    "Enter": ("Enter", 13), "Tab": ("Tab", 9), "Escape": ("Escape", 27), "Backspace": ("Backspace", 8),
    "Delete": ("Delete", 46), "ArrowLeft": ("ArrowLeft", 37), "ArrowUp": ("ArrowUp", 38),
    "ArrowRight": ("ArrowRight", 39), "ArrowDown": ("ArrowDown", 40), "Home": ("Home", 36), "End": ("End", 35),
}  # fmt: skip


def find_browser() -> str | None:
    """Return the path of a Chromium on this machine."""
    return next((path for path in map(shutil.which, _NAMES) if path), None)


def require_browser() -> str:
    """Return the path of a Chromium; without one skip the test, or fail it where SIMRECON_REQUIRE_BROWSER is set."""
    import pytest

    executable = find_browser()
    if executable is None:
        hint = "there is no Chromium on this machine; run tools/setup_browser.sh"
        (pytest.fail if os.environ.get("SIMRECON_REQUIRE_BROWSER") else pytest.skip)(hint)
    return executable


def _find(text: str, selector: str) -> str:
    return f"{_FIND}({json.dumps(text)}, {json.dumps(selector)})"


class Page:
    """One tab of a browser that is driven through a pipe."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        """Open a tab and begin to listen."""
        self._write, self._read = to_browser, from_browser
        self._buffer, self._last, self._session = b"", 0, None
        self.events: list[dict[str, Any]] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result; events on the way are kept."""
        self._last += 1
        message = {"id": self._last, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._write, data) :]
        while True:
            answer = self._receive(60.0)
            if answer.get("id") == self._last:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self.events.append(answer)

    def open(self, path: Path | str, width: int = 1280, height: int = 900, *, phone: bool = False) -> None:
        """Open a file or an address and wait until it has loaded and all its pictures are decoded."""
        self.resize(width, height, phone=phone)
        self.events.clear()
        self.call("Page.navigate", url=path if isinstance(path, str) else path.resolve().as_uri())
        limit = time.monotonic() + 60
        while not any(e.get("method") == "Page.loadEventFired" for e in self.events):
            if time.monotonic() > limit:
                raise TimeoutError(f"{path} did not load within 60 s")
            self.events.append(self._receive(60.0))
        self.evaluate(
            "Promise.all([...document.images].map(i => i.decode().catch(() => null))).then(() => true)"
        )

    def wait_for(self, expression: str, timeout_s: float = 90.0) -> Any:
        """Evaluate JavaScript until its value is true, and return that value.

        Raises:
            TimeoutError: it stays false; names the expression.
        """
        limit = time.monotonic() + timeout_s
        while True:
            value = self.evaluate(expression)
            if value:
                return value
            if time.monotonic() > limit:
                raise TimeoutError(f"still false after {timeout_s:.0f} s: {expression}")
            time.sleep(0.1)

    def settle(self, seconds: float = 0.5) -> None:
        """Let the page run for a while; events are kept."""
        limit = time.monotonic() + seconds
        while (left := limit - time.monotonic()) > 0:
            if b"\0" in self._buffer or select.select([self._read], [], [], left)[0]:
                self.events.append(self._receive(60.0))

    def text(self) -> str:
        """Return the text that the page shows."""
        return self.evaluate("document.body.innerText")

    def box_of(
        self,
        text: str,
        selector: str = _TEXTS,
        timeout_s: float = 30.0,
    ) -> Any:
        """Return x, y, width, height of the smallest visible element with this text, label or placeholder.

        Waits for it: a page is drawn some time after the server's state has changed.

        Raises:
            LookupError: there is none within `timeout_s`.
        """
        try:
            return self.wait_for(_find(text, selector), timeout_s)
        except TimeoutError:
            raise LookupError(
                f"nothing visible says {text!r}; the page says: {self.text()[:2000]!r}"
            ) from None

    def field(self, label: str) -> Any:
        """Return x, y, width, height of the input (text, checkbox, slider, dropdown) in the row of a label.

        Raises:
            LookupError: there is none.
        """
        box = self.evaluate(
            f"""(() => {{
              for (const e of document.querySelectorAll("label, div, span, p")) {{
                if (e.children.length || !e.textContent || e.textContent.trim() !== {json.dumps(label)}) continue;
                for (let row = e, up = 0; row && up < 5; row = row.parentElement, up++) {{
                  const found = row.querySelector("input, [role=slider], textarea");
                  if (!found) continue;
                  found.scrollIntoView({{ block: "nearest" }});
                  const b = found.getBoundingClientRect();
                  return {{ x: b.x, y: b.y, width: b.width, height: b.height }};
                }}
              }}
              return null;
            }})()"""
        )
        if box is None:
            raise LookupError(f"no input with the label {label!r}; the page says: {self.text()[:2000]!r}")
        return box

    def press(self, text: str, selector: str = _TEXTS, timeout_s: float = 60.0) -> None:
        """Click an element; where the page moves it away from under the pointer, the click is stopped and made again.

        Raises:
            LookupError: it was never under the pointer within `timeout_s`.
        """
        limit = time.monotonic() + timeout_s
        while time.monotonic() < limit:
            box = self.box_of(text, selector)
            self.evaluate(_GUARD.replace("FIND", _find(text, selector)))
            self.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            if self.evaluate("!window.endPress || window.endPress()"):  # none: the click led to another page
                return
            self.settle(0.3)
        raise LookupError(f"{text!r} was not under the pointer within {timeout_s:.0f} s")

    def click(self, x: float, y: float, *, button: str = "left", modifiers: tuple[str, ...] = ()) -> None:
        """Press and release a mouse button at a place of the window, in CSS pixels."""
        self.move(x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self._mouse(kind, x, y, button, 1 if kind == "mousePressed" else 0, modifiers)

    def move(self, x: float, y: float) -> None:
        """Move the pointer."""
        self._mouse("mouseMoved", x, y, "none", 0, ())

    def drag(
        self, start: tuple[float, float], end: tuple[float, float], *, button: str = "left", steps: int = 12,
        modifiers: tuple[str, ...] = (), pause_s: float = 0.03,
    ) -> None:  # fmt: skip
        """Press at `start`, move to `end` in steps, and release."""
        self.move(*start)
        self._mouse("mousePressed", *start, button, 1, modifiers)
        for k in range(1, steps + 1):
            x, y = (a + (b - a) * k / steps for a, b in zip(start, end, strict=True))
            self._mouse("mouseMoved", x, y, button, 1, modifiers)
            time.sleep(pause_s)
        self._mouse("mouseReleased", *end, button, 0, modifiers)

    def scroll(self, x: float, y: float, down: float) -> None:
        """Turn the wheel at a place by `down` pixels."""
        self.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=down)

    def type(self, text: str) -> None:
        """Type text into the element that has the focus."""
        self.call("Input.insertText", text=text)

    def key(self, name: str, *, modifiers: tuple[str, ...] = ()) -> None:
        """Press and release a key: a letter or digit, or one of `_KEYS`, such as Enter."""
        code, virtual = _KEYS.get(name, (f"Key{name.upper()}", ord(name.upper()[0])))
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=name, code=code, windowsVirtualKeyCode=virtual,
                modifiers=sum(_MODIFIERS[m] for m in modifiers),
                **({"text": "\r"} if name == "Enter" and kind == "keyDown" else {}),
            )  # fmt: skip

    def _mouse(
        self, kind: str, x: float, y: float, button: str, held: int, modifiers: tuple[str, ...]
    ) -> None:
        self.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=int(kind != "mouseMoved"),
            buttons=_BUTTONS.get(button, 0) if held else 0, modifiers=sum(_MODIFIERS[m] for m in modifiers),
        )  # fmt: skip

    def resize(self, width: int, height: int, *, phone: bool = False) -> None:
        """Set the window's size in CSS pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )

    def evaluate(self, expression: str) -> Any:
        """Evaluate JavaScript and return its (awaited) value."""
        answer = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(answer["exceptionDetails"])
        return answer["result"].get("value")

    def screenshot(self, path: Path, *, full: bool = False, quality: int = 80) -> None:
        """Write what is shown, or the full page, as JPEG, or as PNG where the path says so."""
        png = path.suffix == ".png"
        answer = self.call(
            "Page.captureScreenshot", format="png" if png else "jpeg", captureBeyondViewport=full,
            **({} if png else {"quality": quality}), **({"clip": self._whole()} if full else {}),
        )  # fmt: skip
        path.write_bytes(base64.b64decode(answer["data"]))

    def pdf(self, path: Path) -> None:
        """Print to A4."""
        answer = self.call("Page.printToPDF", paperWidth=8.27, paperHeight=11.69, printBackground=False)
        path.write_bytes(base64.b64decode(answer["data"]))

    def _whole(self) -> dict[str, Any]:
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        return {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}

    @property
    def errors(self) -> list[str]:
        """Console errors, exceptions and failed loads since the page was opened."""
        out = []
        for event in self.events:
            method, parameters = event.get("method"), event.get("params", {})
            if method == "Runtime.exceptionThrown":
                out.append(str(parameters["exceptionDetails"]))
            elif method == "Runtime.consoleAPICalled" and parameters["type"] in (
                "error",
                "warning",
                "assert",
            ):
                out.append(str(parameters["args"]))
            elif method == "Log.entryAdded" and parameters["entry"]["level"] in ("error", "warning"):
                out.append(parameters["entry"]["text"])
            elif method == "Network.loadingFailed":
                out.append(parameters["errorText"])
        return out

    @property
    def requests(self) -> list[str]:
        """Addresses that the page asked for, other than what is inside it (web sockets are not among them)."""
        asked = [
            e["params"]["request"]["url"]
            for e in self.events
            if e.get("method") == "Network.requestWillBeSent"
        ]
        return [url for url in asked if not url.startswith(("data:", "blob:"))]

    def _receive(self, timeout_s: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], timeout_s)
            if not ready:
                raise TimeoutError(f"the browser said nothing for {timeout_s:.0f} s")
            chunk = os.read(self._read, 1 << 20)
            if not chunk:
                raise RuntimeError("the browser has gone")
            self._buffer += chunk
        message, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(message)


@contextmanager
def browser_page(executable: str, profile: Path, *, webgl: bool = False) -> Iterator[Page]:
    """Start a browser with an empty profile and give a page of it; `webgl` renders in software."""
    command_read, command_write = os.pipe()
    answer_read, answer_write = os.pipe()

    def as_three_and_four() -> None:
        # The protocol wants file descriptors 3 and 4; copies keep one from overwriting the other.
        command, answer = os.dup(command_read), os.dup(answer_write)
        command, answer = (
            (os.dup(command) if command == 4 else command),
            (os.dup(answer) if answer == 3 else answer),
        )
        os.dup2(command, 3)
        os.dup2(answer, 4)

    process = subprocess.Popen(
        [executable, *_FLAGS, *(_WEBGL if webgl else _PLAIN), f"--user-data-dir={profile}"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        close_fds=False,
        preexec_fn=as_three_and_four,
    )
    os.close(command_read)
    os.close(answer_write)
    try:
        page = Page(command_write, answer_read)
        yield page
        page._session = None
        page.call("Browser.close")
        process.wait(20)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        os.close(command_write)
        os.close(answer_read)
