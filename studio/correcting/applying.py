"""Apply in the tab "Correct": a run of the pipeline with progress, and the scene before and after it."""

from typing import TYPE_CHECKING

from registry import SceneBundle
from registry.errors import UsageError
from studio.correcting.apply import ApplyRun, ApplyState
from studio.remembered import remember
from studio.text import plain_markdown

if TYPE_CHECKING:
    from studio.correcting.tab import CorrectPart


class Applying:
    """The folder "Apply"."""

    def __init__(self, part: "CorrectPart") -> None:
        self._part = part
        self._run: ApplyRun | None = part.session.running()  # begun by a page that has gone since
        self._before: SceneBundle | None = None  # holds its files while it is open
        gui = part.page.server.gui
        with gui.add_folder("Apply acts"):
            self._film = gui.add_text("Film", "", hint="path of the film, if it is not found")
            self._anyway = gui.add_checkbox(
                "Even if things move", False, hint="publish the scene although it does not come to rest"
            )
            self._apply = part.button(
                "Apply", self._start, "compute what depends on the acts, and publish the scene"
            )
            self._cancel = part.button("Stop", self._stop)
            self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
            self._said = gui.add_markdown("", visible=False)
            self._swap = part.button("Show before", self._swap_views)
        self._cancel.visible, self._swap.visible = self._run is not None, False

    def look(self) -> None:
        """Show the progress of the run; show the new scene when it is there."""
        run = self._run
        if run is None:
            return
        state = run.state()
        if state.running:
            self._show_progress(state)
            return
        self._run = None
        self._apply.disabled, self._cancel.visible, self._bar.visible = False, False, False
        if state.error:
            self._say(f"**Not applied.** {plain_markdown(state.error, 1500)}")
            self._part.fail(UsageError(state.error))
            return
        self._finish(state)

    def _start(self) -> None:
        if self._run is not None:
            raise UsageError("Apply is running already")
        session = self._part.session
        if str(self._film.value).strip():
            from pathlib import Path

            remember(
                session.registry.root,
                session.scene_id,
                video=Path(str(self._film.value).strip()).expanduser(),
            )
        self._part.clicks.cancel()
        self._run = session.apply(require_stable=not self._anyway.value)
        self._apply.disabled, self._cancel.visible, self._bar.visible = True, True, True
        self._show_progress(ApplyState(True, said="starting"))

    def _stop(self) -> None:
        if self._run is not None:
            self._run.cancel()

    def _show_progress(self, state: ApplyState) -> None:
        self._bar.visible, self._bar.value = True, 100 * state.done
        kept = f" Kept: {', '.join(state.reused)}." if state.reused else ""
        self._say(f"{state.elapsed_s:.0f} s: **{state.stage}** {plain_markdown(state.said, 300)}.{kept}")

    def _finish(self, state: ApplyState) -> None:
        page = self._part.page
        before = page.bundle
        if state.revision == before.revision:
            self._say(f"Applied in {state.elapsed_s:.0f} s; the scene is the same.")
            page.reload()
            return
        self._before = before
        page.reload()
        self._swap.visible, self._swap.label = True, "Show before"
        self._say(
            f"Applied in {state.elapsed_s:.0f} s; computed: {', '.join(state.computed) or 'nothing'}.\n\n"
            f"{plain_markdown(summary(before, page.bundle), 1000)}"
        )

    def _swap_views(self) -> None:
        """Show the scene before the last Apply, or again the one after it."""
        if self._before is None:
            return
        page = self._part.page
        other, self._before = self._before, page.bundle
        page.reload(other.revision)
        after = page.bundle.revision == page.registry.get(page.scene_id).revision
        self._swap.label = "Show before" if after else "Show after"

    def _say(self, text: str) -> None:
        self._said.content, self._said.visible = text, True


def summary(before: SceneBundle, after: SceneBundle) -> str:
    """Return the differences between two revisions of a scene, in one line."""
    said = [f"{len(before.objects)} things before, {len(after.objects)} now"]
    old = {item["id"]: item["label"] for item in before.scene["objects"]}
    new = {item["id"]: item["label"] for item in after.scene["objects"]}
    renamed = [
        f"{number} {old[number]} is {new[number]}"
        for number in old
        if new.get(number, old[number]) != old[number]
    ]
    if renamed:
        said.append("names: " + ", ".join(renamed))
    parents = [
        {(e["child"], e["parent"], e["relation"]) for e in b.scene["graph"]["edges"]} for b in (before, after)
    ]
    said.append(f"{len(parents[1] - parents[0])} new relations")
    rates = [b.scene["report"]["physics"].get("stable_rate") for b in (before, after)]
    if None not in rates:
        said.append(f"at rest {rates[0]:.0%} before, {rates[1]:.0%} now")
    return "; ".join(said)
