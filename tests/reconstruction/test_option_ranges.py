"""Numbers of options: finite and in range, checked when they are parsed, with the option's name in the message."""

import dataclasses

import pytest

from reconstruction.cli import build_parser
from reconstruction.config import PRESET_NAMES, PipelineConfig, describe_options
from reconstruction.frames import FramesConfig
from reconstruction.ranges import numeric_options, range_of
from reconstruction.surface import SurfaceConfig
from registry.errors import UsageError

OPTIONS = [
    (option, value)
    for stage in dataclasses.fields(PipelineConfig)
    for option, value in numeric_options(stage.name, getattr(PipelineConfig(), stage.name))
]


def test_every_preset_is_in_range():
    for name in PRESET_NAMES:
        assert PipelineConfig.from_preset(name)
    assert len(OPTIONS) > 150


@pytest.mark.parametrize("wrong", ["nan", "inf", "-inf", "-1", "1e300", "x", "", "0x10", "1e", "9" * 5000])
def test_a_number_that_no_option_can_have_is_refused_by_all(wrong):
    for option, value in OPTIONS:
        if wrong == "-1" and range_of(option).low <= -1:
            continue
        with pytest.raises(UsageError, match=rf"--set {option}=") as caught:
            PipelineConfig().with_option(f"{option}={wrong}")
        assert len(str(caught.value).replace(wrong, "")) < 300
        if wrong in ("nan", "inf", "-1") and isinstance(value, float):
            assert str(range_of(option).high)[:3] in str(caught.value) or "must" in str(caught.value)


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("surface.voxel_size_m=0", "surface.voxel_size_m is 0.0; it must be a number from 0.001 to 1000"),
        ("frames.max_keyframes=1", "it must be a number from 2 to 100000"),
        ("frames.max_keyframes=96.5", "'96.5' is not a whole number"),
        ("depth.min_correlation=2", "from -1 to 1"),
        ("avo.fov_deg=180", "avo.fov_deg must lie in"),
        ("assets.hull_vertices=300", "from 4 to 255"),
        ("poses.seed=-1", "from 0 to 4294967295"),
        ("world.marker_size_m=nan", "from 0 to 5"),
        ("assembly.foot_bands_mm=", "at least one number"),
        ("assembly.foot_bands_mm=2,nan", "assembly.foot_bands_mm is nan"),
        ("assembly.freeze_unstable=1", "neither true nor false"),
        ("world.scale=camera-height=nan", "not a positive length"),
    ],
)
def test_the_message_names_the_option_and_what_it_may_be(option, says):
    with pytest.raises(UsageError) as caught:
        PipelineConfig().with_option(option)
    assert says in str(caught.value)


def test_options_that_are_set_in_python_are_checked_too():
    with pytest.raises(UsageError, match=r"frames\.step is nan"):
        PipelineConfig(frames=FramesConfig(step=float("nan")))
    with pytest.raises(UsageError, match=r"surface\.voxel_size_m is '1'"):
        PipelineConfig(surface=SurfaceConfig(voxel_size_m="1"))  # pyright: ignore[reportArgumentType]


def test_the_list_of_options_shows_the_ranges():
    lines = {line.strip().partition("=")[0]: line for line in describe_options().splitlines()}
    assert lines["surface.voxel_size_m"].endswith("(0.001 to 1000)")
    for option, _ in OPTIONS:
        assert f"({range_of(option)})" in lines[option]


@pytest.mark.parametrize(
    "line",
    [
        "reconstruct v.mp4 --marker-size nan",
        "reconstruct v.mp4 --marker-size 0",
        "reconstruct v.mp4 --marker-size -0.1",
        "reconstruct v.mp4 --marker-size 10cm",
        "reconstruct v.mp4 --seed -1",
        "reconstruct v.mp4 --seed 1e3",
        "reconstruct v.mp4 --keep-results 0",
        "marker --out m.pdf --size inf",
        "marker --out m.pdf --id -1",
        "benchmark generate s --out x.json --seeds 0",
        "benchmark generate s --out x.json --per-scene -3",
        "benchmark generate s --out x.json --test-share nan",
        "benchmark generate s --out x.json --seed 99999999999",
        "benchmark run s.json --policy still --episodes 0",
        "benchmark run s.json --policy still --jobs 0",
        "benchmark run s.json --policy still --fresh-seeds -1",
        "train s --steps 0",
        "train s --envs 0",
        "train s --seed -1",
        "train s --eval-episodes -1",
        "studio s --port 70000",
    ],
)
def test_a_flag_out_of_range_is_refused_by_the_parser(line, capsys):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(line.split())
    assert caught.value.code == 2
    flag = next(word for word in reversed(line.split()) if word.startswith("--"))
    message = capsys.readouterr().err.splitlines()[-1]
    assert f"argument {flag}: " in message
    assert "from" in message
