"""Steps of stages are timed as they follow each other."""

import time

import pytest

from benchmarks.steps import Step, StepClock, main, table_of
from reconstruction.core.profiling import Usage


def test_steps_are_measured_one_after_another():
    clock = StepClock()
    with clock.stage("depth"):
        clock.start(3, "sleeping")
        time.sleep(0.2)
        clock.note("no step")
        clock.start(3, "working")
        end = time.process_time() + 0.2
        while time.process_time() < end:
            pass
    with clock.stage("world"):
        pass
    assert [(s.stage, s.label) for s in clock.steps] == [
        ("depth", "(before the first step)"), ("depth", "sleeping"), ("depth", "working"),
        ("world", "(before the first step)"),
    ]  # fmt: skip
    asleep, busy = clock.steps[1].usage, clock.steps[2].usage
    assert asleep.wall_s >= 0.2
    assert asleep.cpu_s < 0.15 < busy.cpu_s


def test_a_table_has_medians_over_rounds_and_leaves_out_short_steps():
    def steps(wall_s: float) -> list[Step]:
        return [
            Step("depth", "sleeping", Usage(wall_s, 0.1, 0.0)),
            Step("depth", "no time", Usage(0.0, 0.0, 0.0)),
            Step("world", "working", Usage(2.0, 4.0, 0.0)),
        ]

    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in table_of([steps(w) for w in (1.0, 9.0, 2.0)])
    ]
    assert rows[2:] == [
        ["depth", "sleeping", "2.0", "0.1", "0.1"],
        ["world", "working", "2.0", "4.0", "2.0"],
        ["depth", "**all**", "2.0", "0.1", "0.1"],
        ["world", "**all**", "2.0", "4.0", "2.0"],
    ]


def test_steps_end_with_an_error():
    clock = StepClock()
    with pytest.raises(ValueError, match="inside"), clock.stage("depth"):
        raise ValueError("inside")
    assert len(clock.steps) == 1


@pytest.mark.stage
def test_a_stage_of_a_film_is_measured_twice(demo_video, capsys):
    assert main([str(demo_video), "--stages", "frames", "--rounds", "2"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| frames")]
    assert any("**all**" in row for row in rows)
    wall = [float(row.split("|")[3]) for row in rows]
    assert sum(wall[:-1]) <= wall[-1] + 0.1
