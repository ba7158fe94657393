"""Entries that no stage can apply are refused when the file is loaded, with the entry and what is allowed."""

import re

import pytest
import yaml

from reconstruction.config import PipelineConfig
from reconstruction.editing.overrides import Overrides
from reconstruction.runner import Run
from reconstruction.world import WorldConfig
from registry.errors import UsageError

CLICK = {"pixel": {"frame": 1, "x": 10, "y": 20}}
OTHER = {"pixel": {"frame": 2, "x": 30, "y": 20}}
SQUARE = {"frame": 4, "points": [[1, 1], [9, 1], [9, 9]]}
LENGTH = {"from": CLICK, "to": OTHER, "metres": 0.74}


def load(tmp_path, *entries) -> Overrides:
    path = tmp_path / "fixes.yaml"
    path.write_text(yaml.safe_dump(list(entries)))
    return Overrides.load(path)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({"id": 3, "size_m": 2}, "size_m must be three numbers"),
        ({"id": 3, "size_m": [0.2, 0.3, 0]}, "size_m must be three lengths of 0.001 to 20 m"),
        ({"id": 3, "size_m": [20, 30, 40]}, "size_m must be three lengths of 0.001 to 20 m"),
        ({"id": 3, "drop": True, "size_m": [1, 1, 1]}, "drop cannot be combined with size_m"),
        ({"id": 3, "move": {}}, "move needs `move: {by:"),
        ({"id": 3, "move": [1, 2, 3]}, "move needs"),
        ({"id": 3, "move": {"by": [1, 2]}}, "by must be three numbers"),
        ({"id": 3, "move": {"by": [1, 2, 3000]}}, "by must be within 100 m"),
        ({"id": 3, "move": {"by": [1, 0, 0], "to": [1, 0, 0]}}, "has by and to; keep one"),
        ({"id": 3, "move": {"turn_deg": 5, "wxyz": [1, 0, 0, 0]}}, "has turn_deg and wxyz"),
        ({"id": 3, "move": {"turn_deg": True}}, "turn_deg must be a number of degrees"),
        ({"id": 3, "move": {"wxyz": [1, 1, 0, 0]}}, "must be a unit quaternion"),
        ({"id": 3, "move": {"wxyz": [1, 0, 0]}}, "must be a unit quaternion"),
        ({"id": 3, "move": {"yaw": 3, "turn_deg": 3}}, "unknown 'yaw'; it may have by, to, turn_deg, wxyz"),
        ({"id": 3, "move": {"turn_deg": 3, "with_carried": "yes"}}, "with_carried must be true or false"),
        ({"move": {"turn_deg": 3}}, "needs one of `id: N`"),
        ({"id": 3, "drop_to_surface": False}, "drop_to_surface must be true, got False"),
        ({"id": 3, "scale": LENGTH}, "scale is about the whole scene; take id out"),
        ({"floor": CLICK, "relabel": "mug"}, "floor is about the whole scene; take relabel out"),
        ({"floor": {"id": 3}}, "floor needs a click.*ids and `at` count in the world frame"),
        ({"floor": 3}, "floor needs a click"),
        ({"floor": {"at": [0, 0, 0]}}, "floor needs a click.*ids and `at` count in the world frame"),
        ({"floor": {"frame": 3}}, "floor needs a click"),
        ({"scale": 0.74}, "scale needs {from: CLICK, to: CLICK, metres: 0.74}"),
        ({"scale": {**LENGTH, "metres": 0}}, "metres must be a positive number"),
        ({"scale": {**LENGTH, "metres": "74 cm"}}, "metres must be a positive number"),
        ({"scale": {**LENGTH, "to": CLICK}}, "from and to are the same point"),
        ({"scale": {**LENGTH, "to": {"at": [0, 0, 0]}}}, "to needs a click"),
        ({"up": CLICK}, "up needs {level: CLICK}"),
        ({"up": {"level": [CLICK, OTHER]}}, "one click, or three or more, got 2"),
        ({"up": {"level": CLICK, "normal": [0, 0, 1]}}, "up needs"),
        ({"up": {"normal": [0, 0, 0]}}, "has no direction"),
        ({"up": {"normal": [0, 0, 1], "frame": 1.5}}, "frame must be the number"),
        ({"add": {"label": "mug"}}, "add needs"),
        ({"add": {"label": "", "outline": SQUARE}}, "label must be text"),
        ({"add": {"label": "mug", "outline": []}}, "needs one or two outlines, got 0"),
        ({"add": {"label": "mug", "outline": [SQUARE, SQUARE]}}, "both outlines are in frame 4"),
        ({"add": {"label": "mug", "outline": {"frame": 4, "points": [[1, 1], [2, 2]]}}}, "three or more pixels"),
        ({"add": {"label": "mug", "outline": {"frame": 4, "points": [[1, 1], [2, 2], [3, 3]]}}}, "enclose nothing"),
        ({"add": {"label": "mug", "outline": SQUARE}, "mass_kg": 1}, "add cannot be combined"),
        ({"id": 3, "add": {"label": "mug", "outline": SQUARE}}, "add cannot be combined"),
    ],
)  # fmt: skip
def test_an_entry_that_cannot_be_applied_is_named(tmp_path, entry, said):
    pattern = ".*".join(re.escape(part) for part in said.split(".*"))
    with pytest.raises(UsageError, match=f"fixes.yaml: entry 2.*{pattern}"):
        load(tmp_path, {"id": 1, "relabel": "box"}, entry)


def test_two_entries_about_the_same_part_of_the_scene_are_refused(tmp_path):
    with pytest.raises(UsageError, match="floor comes twice"):
        load(tmp_path, {"floor": CLICK}, {"scale": LENGTH, "floor": OTHER})


def test_a_length_in_the_file_and_one_on_the_command_line_contradict(tmp_path):
    said = load(tmp_path, {"scale": LENGTH})
    for world, name in (
        (WorldConfig(scale="camera-height=1.5"), "--scale"),
        (WorldConfig(marker_size_m=0.1), "--marker-size"),
    ):
        with pytest.raises(UsageError, match=f"`scale` entry, and {name} is given"):
            Run(tmp_path, PipelineConfig(world=world), None, said)  # pyright: ignore[reportArgumentType]
    load(tmp_path, {"floor": CLICK}).check_lengths(
        PipelineConfig(world=WorldConfig(scale="camera-height=1.5"))
    )


def test_each_stage_sees_only_its_part_of_an_entry():
    entry = {"id": 3, "relabel": "mug", "move": {"turn_deg": 3}, "parent": 2, "relation": "attached_to"}
    said, other = Overrides([entry]), Overrides([{**entry, "move": {"turn_deg": 4}}])
    assert said.of_stage("assets") == [{"id": 3, "move": {"turn_deg": 3}}]
    assert said.of_stage("scene_graph") == [{"id": 3, "parent": 2, "relation": "attached_to"}]
    assert said.of_stage("assembly") == said.of_stage("world") == []
    changed = [
        s
        for s in ("world", "instances", "assets", "scene_graph", "assembly")
        if said.fingerprint_of_stage(s) != other.fingerprint_of_stage(s)
    ]
    assert changed == ["assets"]


def test_entries_with_world_coordinates_are_known():
    entries = [
        {"scale": LENGTH},
        {"id": 3, "relabel": "mug"},
        {"id": 3, "move": {"turn_deg": 3}},
        {"id": 3, "move": {"by": [0, 0, 1]}},
        {"at": [0, 0, 1], "drop": True},
        {"merge": [CLICK, {"id": 3, "near": [0, 0, 1]}]},
        {"id": 3, "split": {"point": CLICK, "normal": [0, 0, 1]}},
        {"id": 3, "split": [CLICK, OTHER]},
    ]
    assert Overrides(entries).entries_in_metres() == [4, 5, 6, 7]
