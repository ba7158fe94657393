"""The stage `views`: done where something asks for it, kept like any other, and what its consumers are shown."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
import avo_room as room

from reconstruction.assets.generation.pictures import object_pictures
from reconstruction.assets.physics.vlm import shown_pictures
from reconstruction.cache import StageStore
from reconstruction.config import PipelineConfig
from reconstruction.core import artifacts
from reconstruction.core.types import Instance, InstanceSet, PosedFrames
from reconstruction.instances.naming.views import ObjectView
from reconstruction.pipeline import DEFAULT_STAGE_NAMES, STAGE_NAMES, STAGES
from reconstruction.runner import Run
from reconstruction.views import AvoConfig, SceneViews, find_views, make_views
from reconstruction.views.pictures import hidden_holes
from registry.errors import UsageError

QUICK = AvoConfig(
    views=2,
    side_px=48,
    scan_side_px=32,
    steps=4,
    restarts=1,
    picture_side_px=96,
    remaining_share=0.0,
    min_gain=0.0,
)
NOWHERE = 99  # an id without Gaussians


def instance(number: int) -> Instance:
    return Instance(number, "box", 0.9, room.BOX_CENTER, 0.0, np.full(3, room.BOX_SIDE), room.FLOOR, False)


@pytest.fixture(scope="module")
def scene():
    return room.room()


@pytest.fixture(scope="module")
def found():
    return InstanceSet(
        np.zeros(0, np.int32), (), (instance(room.BOX), instance(NOWHERE)), np.zeros((1, 12, 16), np.uint16)
    )


@pytest.fixture(scope="module")
def made(scene, found) -> SceneViews:
    return make_views(scene, found, QUICK)


@pytest.fixture(scope="module")
def hidden_view(scene):
    """The box from where the panel hides its lower half: from an input camera."""
    (views,) = find_views(scene, [room.BOX], replace(QUICK, strategy="max-visibility", views=1))
    return views.views[0]


def run_with(tmp_path, *options: str) -> Run:
    config = PipelineConfig()
    for text in options:
        config = config.with_option(text)
    return Run(Path("video.mp4"), config, StageStore(tmp_path), input_digest="0" * 64)


def test_nobody_waits_for_views_that_nobody_asked_for(tmp_path):
    assert run_with(tmp_path).wanted_stages() == DEFAULT_STAGE_NAMES
    assert "views" not in DEFAULT_STAGE_NAMES


@pytest.mark.parametrize("option", ["assets.generator=hunyuan3d", "assets.physics=vlm"])
def test_a_generator_and_a_model_that_is_asked_about_things_want_views(tmp_path, option):
    run = run_with(tmp_path, option)
    assert run.wanted_stages() == STAGE_NAMES
    needs = {stage.name: run.needs_of(stage) for stage in STAGES}
    assert "views" in needs["assets"]
    assert "views" not in needs["scene_graph"]


def test_the_options_of_the_stage_are_those_of_avo(tmp_path):
    run = run_with(tmp_path, "avo.strategy=canonical", "avo.views=2")
    (stage,) = (s for s in STAGES if s.name == "views")
    assert run.options_of(stage) == AvoConfig(strategy="canonical", views=2)
    with pytest.raises(UsageError, match="there is no such backend"):
        run_with(tmp_path, "avo.strategy=blind")


def test_views_are_kept_whole(made, tmp_path):
    artifacts.save(made, tmp_path / "kept")
    again = artifacts.load(SceneViews, tmp_path / "kept")
    assert again.strategy == "avo"
    assert len(again.of(room.BOX)) == 2
    assert again.of(NOWHERE) == ()
    for kept, view in zip(again.of(room.BOX), made.of(room.BOX)):
        np.testing.assert_array_equal(kept.clean, view.clean)
        np.testing.assert_array_equal(kept.mask, view.mask)
        assert kept.camera == view.camera
        assert (kept.gain, kept.fronts, kept.visibility) == (view.gain, view.fronts, view.visibility)


def test_what_hides_a_thing_is_not_in_its_cleared_picture(hidden_view):
    assert hidden_view.visibility < 0.7
    picture, mask = hidden_view.cleared()
    red, green = picture[mask].mean(axis=0)[:2]
    assert red > 3 * green  # the box is red, the panel before it green
    assert mask.sum() > hidden_view.mask.sum()


def test_what_things_hide_from_all_frames_is_of_the_target_and_open_holes_are_not():
    outline = np.zeros((40, 60), bool)
    outline[5:35, 5:55] = True
    outline[10:20, 10:20] = outline[10:20, 40:50] = False
    depth = np.where(outline, 2.0, 0.0)
    whole = np.zeros((40, 60, 8))
    whole[..., 7], whole[..., 3] = 1.0, 3.0
    whole[10:20, 10:20, 3] = 1.5  # something stands before the left gap
    hidden = hidden_holes(outline, depth, whole)
    assert hidden[10:20, 10:20].all()
    assert hidden.sum() == 100


def frames(found: InstanceSet) -> PosedFrames:
    """One black keyframe."""
    image = np.zeros((1, 24, 32, 3), np.uint8)
    poses, points = np.eye(4)[None], np.zeros((0, 3))
    return PosedFrames(
        None, room.CAMERA, image, np.zeros(1, np.int32), np.zeros(1), poses, np.zeros(1, np.float32), image[:0],
        np.zeros(0, np.int32), np.zeros(0), poses[:0], points, points.astype(np.uint8), np.zeros(0, np.float32),
        np.zeros((0, 2), np.int32), 1, True, 0.0,
    )  # fmt: skip


def test_a_generator_is_shown_the_view_and_a_keyframe_of_what_has_none(made, found):
    ids = found.id_maps.copy()
    ids[0, 2:10, 3:12] = NOWHERE
    found = replace(found, id_maps=ids)
    shown = object_pictures(found, frames(found), list(found.objects), 1, made)
    color, mask = made.of(room.BOX)[0].cleared()
    np.testing.assert_array_equal(shown[room.BOX].pictures[0].color, color)
    assert 0 < shown[room.BOX].pictures[0].mask.sum() <= mask.sum()
    assert not shown[NOWHERE].pictures[0].color.any()  # the keyframe is black
    assert set(object_pictures(found, frames(found), list(found.objects), 1)) == {NOWHERE}


def test_a_generator_is_not_shown_the_inside_of_a_shell(made, found):
    inside, outside = (replace(view, fronts=share) for view, share in zip(made.of(room.BOX), (0.2, 0.9)))
    views = SceneViews("avo", (replace(made.targets[0], views=(inside, outside)),))
    (picture,) = object_pictures(found, frames(found), [found.objects[0]], 2, views)[room.BOX].pictures
    np.testing.assert_array_equal(picture.color, outside.cleared()[0])


def test_a_model_sees_the_whole_thing_first_and_photographs_beside_it(hidden_view):
    photographs = [ObjectView(row, np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), bool)) for row in range(3)]
    shown = shown_pictures(photographs, [hidden_view])
    np.testing.assert_array_equal(shown[0].crop, hidden_view.cleared()[0])
    assert [one.row for one in shown] == [-1, 0, 1]
    assert shown_pictures(photographs, []) == photographs
