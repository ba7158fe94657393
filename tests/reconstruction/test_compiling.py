"""Whoever waits for Numba is told so, and the step goes on where it was."""

import numba

from reconstruction.core.compiling import compilation_shown


class Recorder:
    def __init__(self) -> None:
        self.said: list[tuple] = []

    def start(self, total: int, label: str) -> None:
        self.said.append(("start", total, label))

    def advance(self, n: int = 1) -> None:
        self.said.append(("advance", n))

    def note(self, message: str) -> None:
        self.said.append(("note", message))


def fresh_kernels():
    @numba.njit
    def inner(x):
        return x + 1

    @numba.njit
    def outer(x):
        return inner(x) * 2

    return outer


def test_compilation_is_a_step_of_its_own_and_the_old_step_comes_back() -> None:
    kernel, watcher = fresh_kernels(), Recorder()
    with compilation_shown(watcher) as progress:
        progress.start(5, "measuring")
        progress.advance(2)
        assert kernel(3) == 8
        progress.advance()
    steps = [s for s in watcher.said if s[0] != "note"]
    assert steps == [
        ("start", 5, "measuring"),
        ("advance", 2),
        ("start", 0, "compiling outer (first use)"),
        ("start", 5, "measuring"),
        ("advance", 2),
        ("advance", 1),
    ]
    notes = [s[1] for s in watcher.said if s[0] == "note"]
    assert "first use" in notes[0]
    assert notes[-1].startswith("compiled 1 kernel (")


def test_nothing_is_said_of_what_is_compiled_already() -> None:
    kernel = fresh_kernels()
    kernel(1)
    watcher = Recorder()
    with compilation_shown(watcher) as progress:
        progress.start(1, "measuring")
        kernel(2)
    assert watcher.said == [("start", 1, "measuring")]


def test_nobody_listens_after_the_block() -> None:
    watcher = Recorder()
    with compilation_shown(watcher):
        pass
    fresh_kernels()(1)
    assert watcher.said == []
