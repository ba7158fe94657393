"""`LivePage`: the page of a reconstruction in progress, for `simrecon reconstruct --studio`.

It fills as stages finish. A thread of low priority draws; the stages only hand over what they made. At the end the
studio page of the published scene takes over the same address, and stays until the last viewer has closed it.
"""

import contextlib
import io
import logging
import os
import queue
import sys
import threading
import time
import webbrowser
from pathlib import Path
from typing import Any

from reconstruction.core.profiling import Usage
from reconstruction.core.progress import StageListener
from reconstruction.runner import Run
from registry import open_registry
from studio.command import PARTS, check_viser
from studio.refilm import FilmCheck, advice_on_poses, advice_on_things
from studio.same_origin import same_origin_only
from studio.text import bare, plain_markdown

logger = logging.getLogger(__name__)
_HOST = "127.0.0.1"
_NICE = 10  # of the thread that draws
_SHOW_EVERY_S = 0.25  # progress within a stage
_COME_BACK_S = 20.0  # in which a viewer connects again after the studio page has taken over
_DRAWN_S = 60.0  # longest wait for the thread that draws
_GONE_S = 10.0  # without a viewer after which the page counts as closed; a reload of the page takes less


class LivePage:
    """A page that shows a reconstruction while it runs. Use as a context manager around it."""

    def __init__(self, video: Path, port: int = 0) -> None:
        """Serve an empty page on this machine, and open it in the browser if there is a desktop.

        Raises:
            EnvironmentMissing: viser is not installed.
        """
        check_viser()
        import viser

        from studio.live_layers import LiveLayers

        self._video = video
        # viser prints a table of its own.
        with contextlib.redirect_stdout(io.StringIO()), same_origin_only(_HOST):
            self._server: Any = viser.ViserServer(
                host=_HOST, port=port, label=bare(video.name), verbose=False
            )
        self.port: int = self._server.get_port()
        self._layers = LiveLayers(self._server)
        self._build()
        self._jobs: queue.Queue = queue.Queue()
        self._check: FilmCheck | None = None
        self._lines: dict[str, str] = {}
        self._advice: list[str] = []
        self._notes: list[str] = []
        self._thread = threading.Thread(target=self._work, name="studio-live", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{_HOST}:{self.port}"

    def __enter__(self) -> "LivePage":
        """Say where the page is, and open it."""
        _tell_terminal(self.url)
        if (
            os.environ.get("DISPLAY")
            or os.environ.get("WAYLAND_DISPLAY")
            or sys.platform in ("darwin", "win32")
        ):
            with contextlib.suppress(webbrowser.Error):
                webbrowser.open(self.url)
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop the server."""
        self._stop()

    # ---- During the reconstruction.

    def watch(self, listener: StageListener) -> StageListener:
        """Return a listener that passes everything on, and shows it in the page."""
        return _Watched(listener, self._jobs)

    def show(self, run: Run, stage: str) -> None:
        """Show the result of a stage; for `after_stage` of a run. Returns at once."""
        self._jobs.put(("stage", stage, run.results[stage], dict(run.results) if stage == "assets" else {}))

    def keep(self, registry_root: Path | None, scene_id: str) -> None:
        """Turn into the studio page of a scene, and serve it until the last viewer has gone, or Ctrl-C.

        Returns at once if nobody looks at the page.
        """
        self._drain()
        watched = bool(self._server.get_clients())
        self._stop()
        if not watched:
            return
        from studio.parts import load_parts
        from studio.scene_view import StudioPage

        page = StudioPage(
            open_registry(registry_root), scene_id, parts=load_parts(PARTS), host=_HOST, port=self.port
        )
        _tell_terminal(f"{self.url} stays until it is closed; Ctrl-C ends it, too")
        try:
            _wait_for_viewers(page.server, time.monotonic() + _COME_BACK_S)
        except KeyboardInterrupt:
            _tell_terminal("ended")
        finally:
            page.close()

    # ---- The thread that draws.

    def _work(self) -> None:
        if sys.platform == "linux":  # there, priorities are those of threads
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        while (job := self._jobs.get()) is not None:
            try:
                self._do(*job)
            except Exception:  # the reconstruction goes on without the page
                logger.exception("studio: the page could not show %s", job[:2])

    def _do(self, kind: str, *values: Any) -> None:
        if kind == "begin":
            name, number, total, cached = values
            self._step.content = f"**{number} of {total}: {plain_markdown(name)}**" + (
                " (from the cache)" if cached else ""
            )
            self._bar.value = 100.0 * (number - 1) / total
        elif kind == "progress":
            label, done, of = values
            self._within.content = plain_markdown(f"{label} {done} of {of}" if of else label)
        elif kind == "note":
            self._notes.append(values[0])
            self._tell()
        elif kind == "stage":
            self._draw(*values)
        elif kind == "advice":
            self._advice += [line for line in values[0] if line not in self._advice]
            self._tell()
        elif kind == "done":
            values[0].set()

    def _draw(self, stage: str, result: Any, results: dict[str, Any]) -> None:
        with self._server.atomic():
            line = self._layers.draw(stage, result)
        if line:
            self._lines[stage] = line
        if stage == "frames" and self._check is None:
            self._check = FilmCheck(self._video, lambda lines: self._jobs.put(("advice", lines)))
        if stage == "poses":
            self._do("advice", advice_on_poses(result))
        if stage == "assets":
            self._do("advice", advice_on_things(result, results["poses"], results["world"].world_from_sfm))
        self._tell()

    def _tell(self) -> None:
        done = "\n".join(
            f"- {plain_markdown(stage)}: {plain_markdown(line)}" for stage, line in self._lines.items()
        )
        self._done.content = done
        advice = "\n".join(f"- {plain_markdown(line)}" for line in self._advice)
        self._again.content = advice or "nothing so far"
        self._said.content = "\n".join(f"- {plain_markdown(note)}" for note in self._notes)

    def _build(self) -> None:
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        gui.main_panel.dock_right()
        self._server.scene.set_up_direction("+z")
        self._step = gui.add_markdown("starting")
        self._bar = gui.add_progress_bar(0.0)
        self._within = gui.add_markdown("")
        with gui.add_folder("Found"):
            self._done = gui.add_markdown("")
        with gui.add_folder("Film again"):
            self._again = gui.add_markdown("nothing so far")
        with gui.add_folder("Notes", expand_by_default=False):
            self._said = gui.add_markdown("")

    def _drain(self) -> None:
        """Wait until everything that was handed over is drawn."""
        finished = threading.Event()
        self._jobs.put(("done", finished))
        finished.wait(timeout=_DRAWN_S)

    def _stop(self) -> None:
        if self._check is not None:
            self._check.stop()
        if self._server is not None:
            self._jobs.put(None)
            self._thread.join(timeout=_DRAWN_S)
            server, self._server = self._server, None
            with contextlib.redirect_stdout(io.StringIO()):
                server.stop()


class _Watched:
    """Passes everything on, and hands it to the thread that draws; progress at most 4 times a second."""

    def __init__(self, listener: StageListener, jobs: queue.Queue) -> None:
        self._listener, self._jobs = listener, jobs
        self._label, self._done, self._of, self._last = "", 0, 0, 0.0

    def begin_stage(self, name: str, number: int, total: int, cached: bool) -> None:
        self._listener.begin_stage(name, number, total, cached)
        self._jobs.put(("begin", name, number, total, cached))

    def end_stage(self, name: str, usage: Usage | None) -> None:
        self._listener.end_stage(name, usage)

    def start(self, total: int, label: str) -> None:
        self._listener.start(total, label)
        self._label, self._done, self._of = label, 0, total
        self._jobs.put(("progress", label, 0, total))

    def advance(self, n: int = 1) -> None:
        self._listener.advance(n)
        self._done += n
        now = time.monotonic()
        if now - self._last > _SHOW_EVERY_S:
            self._last = now
            self._jobs.put(("progress", self._label, self._done, self._of))

    def note(self, message: str) -> None:
        self._listener.note(message)
        self._jobs.put(("note", message))


def _tell_terminal(text: str) -> None:
    sys.stderr.write(f"studio: {text}\n")
    sys.stderr.flush()


def _wait_for_viewers(server: Any, until: float) -> None:
    """Wait until a time for a viewer; then until none was there for 10 s."""
    while time.monotonic() < until:
        if server.get_clients():
            until = time.monotonic() + _GONE_S
        time.sleep(0.2)
