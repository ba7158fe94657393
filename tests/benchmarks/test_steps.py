"""Steps of stages are timed as they follow each other."""

import time

import pytest

from benchmarks.steps import StepClock, main, table_of


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
    lines = table_of([clock.steps, clock.steps, clock.steps])
    assert [line.split("|")[2].strip() for line in lines[2:]] == ["sleeping", "working", "**all**", "**all**"]


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
