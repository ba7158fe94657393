"""The panel "Rollout": an episode of a task in the page, by the script, a trained policy or a demonstration."""

from typing import TYPE_CHECKING, Any

import viser

from registry.errors import SimReconError
from studio.playing.rollout import RolloutFrame, RolloutHead, RolloutRequest
from studio.playing.rollout_process import RolloutProcess, TasksRequest
from studio.playing.rollout_view import RolloutView
from studio.playing.tasks import KINDS, ROBOTS, SCRIPT, policy_names, policy_of, task_of_run
from studio.playing.ticker import Ticker
from studio.text import plain_markdown

if TYPE_CHECKING:
    from studio.playing.poses_in_use import PosesInUse
    from studio.scene_view import StudioPage

_SPEEDS: tuple[str, ...] = ("0.25x", "0.5x", "1x", "2x", "4x")
_IDLE = "A robot does a task of this scene. The simulator starts in a process of its own, which takes some seconds."


class RolloutPanel:
    """Makes rollouts, and plays them."""

    def __init__(self, page: "StudioPage", poses: "PosesInUse") -> None:
        """Build the panel; nothing is loaded before the first rollout."""
        self._page, self._poses = page, poses
        self._view: RolloutView | None = None
        self._process: RolloutProcess | None = None
        self._time_s = 0.0
        self._scrubbing = False
        self._ticker = Ticker(self._tick, "studio-rollout")
        gui = page.server.gui
        with gui.add_folder("Rollout", expand_by_default=False):
            self._task = gui.add_dropdown(
                "Task", KINDS, initial_value=KINDS[0], hint="a kind, or a task of the list"
            )
            self._policy = gui.add_dropdown("By", policy_names(page.scene_id), initial_value=SCRIPT)
            self._robot = gui.add_dropdown("Robot", ROBOTS, initial_value=ROBOTS[0])
            self._seed = gui.add_number("Seed", 0, min=0, max=2**31 - 1, step=1)
            self._record = gui.add_button("Record", icon=viser.Icon.PLAYER_RECORD)
            self._list = gui.add_button("List tasks", hint="the tasks that the robot can likely do here")
            with gui.add_folder("Demonstration", expand_by_default=False):
                self._file = gui.add_text(
                    "File", "", hint="trajectory.h5, from `simrecon benchmark demos --maniskill`"
                )
                self._episode = gui.add_number("Episode", 0, min=0, max=100_000, step=1)
                self._open = gui.add_button("Open")
            self._play = gui.add_button("Play rollout", icon=viser.Icon.PLAYER_PLAY, disabled=True)
            self._scrub = gui.add_slider("Step", 0, 1, 1, 0, disabled=True)
            self._pace = gui.add_dropdown("Pace", _SPEEDS, initial_value="1x")
            self._clear = gui.add_button("Clear", disabled=True, hint="take the robot away")
            self._text = gui.add_markdown(_IDLE)
            self._plots = gui.add_folder("Over time", visible=False)
        self._record.on_click(lambda _: self.stop() if self.recording else self.record())
        self._list.on_click(lambda _: self.list_tasks())
        self._policy.on_update(lambda _: self._take_task_of_run())
        self._open.on_click(lambda _: self.open(self._file.value, int(self._episode.value)))
        self._play.on_click(lambda _: self._pause() if self._ticker.running else self.play())
        self._scrub.on_update(lambda event: self._scrubbed(event))
        self._clear.on_click(lambda _: self._poses.free())

    # ---- Acts.

    @property
    def recording(self) -> bool:
        """Tell whether a rollout is being made."""
        return self._process is not None and self._process.running

    def record(self) -> None:
        """Have the policy act in the task; the page follows."""
        try:
            policy, arguments = policy_of(self._policy.value, self._page.scene_id)
        except SimReconError as error:
            self._page.say(str(error), error=True)
            return
        self._start(
            RolloutRequest(
                *self._where(),
                task=self._task.value,
                robot=self._robot.value,
                policy=policy,
                arguments=arguments,
                seed=int(self._seed.value),
            )
        )

    def open(self, file: str, episode: int) -> None:
        """Show an episode of a recorded demonstration."""
        if not file.strip():
            self._page.say("Name the file of a demonstration: .../trajectory.h5", error=True)
            return
        self._start(RolloutRequest(*self._where(), trajectory=file.strip(), episode=episode))

    def stop(self) -> None:
        """End the making of a rollout; the recorded steps stay."""
        process, self._process = self._process, None
        if process is not None:
            process.stop()
        self._show_recording(False)

    def play(self) -> None:
        """Play from the present step, or from the first if the end is shown."""
        if self._view is None:
            return
        self._poses.take(self)
        if self._time_s >= self._view.last_s:
            self._time_s = 0.0
        self._show_running(True)
        self._ticker.start()

    def list_tasks(self) -> None:
        """Fill the list of tasks with those that the robot can likely do."""
        self._list.disabled = True
        self._text.content = "listing the tasks ..."

        def found(names: Any) -> None:
            self._task.options = (*KINDS, *names)
            self._text.content = f"{len(names)} tasks"

        def ended(failure: str) -> None:
            self._list.disabled = False
            if failure:
                self._text.content = plain_markdown(failure)

        RolloutProcess(TasksRequest(*self._where(), robot=self._robot.value), found, ended)

    # ---- Life.

    def leave(self) -> None:
        """Stop, and take the robot away."""
        self.stop()
        self._ticker.stop()
        self._show_running(False)
        view, self._view = self._view, None
        if view is not None:
            view.close()
        self._plots.visible = False
        self._play.disabled = self._scrub.disabled = self._clear.disabled = True
        self._text.content = _IDLE

    def reload(self) -> None:
        """Forget the rollout of the former bundle."""
        self.leave()

    def close(self) -> None:
        """End the process and the thread."""
        if self._process is not None:
            self._process.stop()
        self._ticker.close()

    # ---- Inside.

    def _where(self) -> tuple[str, str, str]:
        """Return scene, registry and revision of a request."""
        page = self._page
        return page.scene_id, str(page.registry.root.absolute()), page.revision

    def _start(self, request: RolloutRequest) -> None:
        self.leave()
        self._poses.take(self)
        self._text.content = "starting the simulator ..."
        self._process = RolloutProcess(request, self._received, self._ended)
        self._show_recording(True)

    def _received(self, message: RolloutHead | RolloutFrame) -> None:
        if isinstance(message, RolloutHead):
            self._view = RolloutView(self._page, message, self._plots)
            self._scrub.max = max(message.steps, 1)
            self._clear.disabled = False
            self._plots.visible = True
        elif self._view is not None:
            self._view.add(message)
            self._time_s = self._view.last_s
            self._show()

    def _ended(self, failure: str) -> None:
        self._process = None
        self._show_recording(False)
        if failure:
            self._text.content = plain_markdown(failure)
            self._page.say(failure, error=True)
        if self._view is None:
            return
        self._view.finish()
        self._scrub.max = max(self._view.count - 1, 1)
        self._play.disabled = self._scrub.disabled = False
        self._show()

    def _tick(self, seconds: float) -> None:
        view = self._view
        if view is None:
            self._ticker.stop()
            return
        self._time_s = min(self._time_s + seconds * float(self._pace.value[:-1]), view.last_s)
        self._show()
        if self._time_s >= view.last_s:
            self._pause()

    def _show(self) -> None:
        """Show the present time: poses, the scrubber, the text."""
        view = self._view
        if view is None:
            return
        view.show(self._time_s)
        step = view.step_at(self._time_s)
        if self._scrub.value != step:
            self._scrub.value = step
        text = view.text_at(step)
        if text != self._text.content:
            self._text.content = text

    def _scrubbed(self, event: Any) -> None:
        """Show the step that a viewer chose; the panel's own changes carry no client."""
        if event.client is None or self._view is None:
            return
        self._pause()
        self._poses.take(self)
        self._time_s = float(self._scrub.value) / self._view.head.fps
        self._show()

    def _pause(self) -> None:
        self._ticker.stop()
        self._show_running(False)

    def _take_task_of_run(self) -> None:
        """Choose the task and robot that a trained policy was trained for."""
        found = task_of_run(self._policy.value, self._page.scene_id)
        if found is not None:
            task, robot = found
            if task not in self._task.options:
                self._task.options = (*self._task.options, task)
            if robot not in self._robot.options:
                self._robot.options = (*self._robot.options, robot)
            self._task.value, self._robot.value = task, robot

    def _show_running(self, running: bool) -> None:
        self._play.label = "Pause rollout" if running else "Play rollout"
        self._play.icon = viser.Icon.PLAYER_PAUSE if running else viser.Icon.PLAYER_PLAY

    def _show_recording(self, recording: bool) -> None:
        self._record.label = "Stop" if recording else "Record"
        self._record.icon = viser.Icon.PLAYER_STOP if recording else viser.Icon.PLAYER_RECORD
