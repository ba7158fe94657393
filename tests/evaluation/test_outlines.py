"""Outline metrics: true outlines score perfectly, each known fault changes the expected metrics."""

import json

import numpy as np
import pytest
from outline_drawing import FRAMES, draw, pieces, true_ids
from truth_bundle import KINDS, Change, write_bundle

from reconstruction.core.types import Camera, DistortedCamera
from reconstruction.measure import LabelledFrame, Outline, load_outlines, score_outlines
from reconstruction.measure.outline_labels import filled
from reconstruction.measure.scene import placed_meshes
from reconstruction.poses.lens import Lens
from registry.errors import UsageError
from registry.geometry import rigid

pytestmark = pytest.mark.stage

RATES = ("outline_recall_25", "outline_recall_50", "outline_precision_25", "outline_precision_50")


@pytest.fixture(scope="module")
def room(truth, tmp_path_factory):
    """Write the truth as a bundle."""
    return write_bundle(truth, tmp_path_factory.mktemp("room") / "bundle")


def scored(bundle, path, lens=None):
    return score_outlines(bundle, placed_meshes(bundle), load_outlines(path), lens)


def of(scores, name: str) -> dict:
    return next(item for item in scores.things if item["name"] == name)


def asked(truth) -> list[str]:
    """Return the objects visible in some labelled frame."""
    return sorted({name for shapes in draw(truth).frames.values() for name, _ in shapes})


def test_true_outlines_are_all_found(truth, room, tmp_path):
    scores = scored(room, draw(truth).contract(tmp_path / "labels.json"))
    assert {name: scores.metrics[name] for name in RATES} == dict.fromkeys(RATES, 1)
    assert scores.metrics["outline_edges"] == 1
    assert [view.frame.index for view in scores.views] == list(FRAMES)
    assert sorted(item["name"] for item in scores.things) == asked(truth)
    for item in scores.things:
        assert item["match"] == truth.entity(item["name"]).id
        assert item["iou"] > 0.9  # polygons have no holes, and two renderers differ by single pixels at edges
        assert item["parent_right"]
    assert scores.extra == []


def test_another_world_changes_nothing(truth, room, tmp_path):
    path = draw(truth).contract(tmp_path / "labels.json")
    turn = rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), [0.3, -1.2, 0.0])
    change = Change(estimated_from_true=np.diag([1.25, 1.25, 1.25, 1.0]) @ turn)
    moved = scored(write_bundle(truth, tmp_path / "bundle", change), path)
    before = scored(room, path)
    assert moved.metrics == before.metrics
    for item in before.things:
        assert of(moved, item["name"])["iou"] == pytest.approx(item["iou"], abs=0.01)


def test_pictures_of_another_size_measure_the_same(truth, room, tmp_path):
    drawing = draw(truth)
    small = scored(room, drawing.contract(tmp_path / "small.json"))
    drawing.size = (drawing.size[0] * 3, drawing.size[1] * 3)
    drawing.frames = {i: [(n, 3 * p) for n, p in shapes] for i, shapes in drawing.frames.items()}
    large = scored(room, drawing.contract(tmp_path / "large.json"))
    assert large.metrics == small.metrics
    assert large.views[0].shown.shape == drawing.size[::-1]
    for item in small.things:
        if item["pixels"] > 400:  # a line of pixels around a thing is half a pixel wider three times as large
            assert of(large, item["name"])["iou"] == pytest.approx(item["iou"], abs=0.12)


def test_a_missing_object_is_a_missed_thing(truth, tmp_path):
    bundle = write_bundle(truth, tmp_path / "bundle", Change(missing=("carton",)))
    scores = scored(bundle, draw(truth).contract(tmp_path / "labels.json"))
    n = len(asked(truth))
    assert scores.metrics["outline_recall_25"] == pytest.approx((n - 1) / n)
    assert scores.metrics["outline_precision_25"] == 1
    assert of(scores, "carton")["match"] is None
    assert scores.metrics["outline_edges"] == 1


def test_nothing_found_scores_nothing(truth, tmp_path):
    bundle = write_bundle(truth, tmp_path / "bundle", Change(missing=KINDS))
    scores = scored(bundle, draw(truth).contract(tmp_path / "labels.json"))
    assert [scores.metrics[name] for name in RATES] == [0, 0, 0, 0]
    assert scores.metrics["outline_edges"] is None


def test_an_object_that_nobody_outlined_lowers_precision_unless_it_is_ignored(truth, room, tmp_path):
    drawing, n = draw(truth), len(asked(truth))
    polygons = {i: [p for name, p in shapes if name == "carton"] for i, shapes in drawing.frames.items()}
    drawing.ignore = ["carton"]
    ignored = scored(room, drawing.contract(tmp_path / "ignored.json"))
    drawing.ignore = []
    for shapes in drawing.frames.values():
        shapes[:] = [shape for shape in shapes if shape[0] != "carton"]
    unknown = scored(room, drawing.contract(tmp_path / "unknown.json"))
    drawing.regions = polygons
    region = scored(room, drawing.contract(tmp_path / "region.json"))
    assert unknown.metrics["outline_precision_25"] == pytest.approx((n - 1) / n)
    assert [item["id"] for item in unknown.extra] == [truth.entity("carton").id]
    for scores in (ignored, region):
        assert scores.metrics["outline_precision_25"] == 1
        assert scores.metrics["outline_objects"] == n - 1
        assert "carton" not in {item["name"] for item in scores.things}


def test_a_region_under_an_outline_is_judged(truth, room, tmp_path):
    """Outlines cover ignored regions: objects on outlines count even if the whole frame is one region."""
    drawing = draw(truth)
    width, height = drawing.size
    whole = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    plain = scored(room, drawing.contract(tmp_path / "plain.json"))
    drawing.regions = {index: [whole] for index in FRAMES}
    assert scored(room, drawing.contract(tmp_path / "region.json")).metrics == plain.metrics


def test_a_swapped_parent_is_a_wrong_edge(truth, tmp_path):
    bundle = write_bundle(truth, tmp_path / "bundle", Change(parent={"carton": "floor"}))
    scores = scored(bundle, draw(truth).contract(tmp_path / "labels.json"))
    n = len(asked(truth))
    assert truth.entity("carton").parent != truth.entity("floor").id
    assert scores.metrics["outline_edges"] == pytest.approx((n - 1) / n)
    assert of(scores, "carton")["parent_right"] is False
    assert [scores.metrics[name] for name in RATES] == [1, 1, 1, 1]


def test_a_relation_to_what_was_not_found_is_not_asked(truth, tmp_path):
    bundle = write_bundle(
        truth, tmp_path / "bundle", Change(missing=("table",), parent=dict.fromkeys(KINDS, "floor"))
    )
    scores = scored(bundle, draw(truth).contract(tmp_path / "labels.json"))
    on_table = [name for name in asked(truth) if truth.entity(name).parent == truth.entity("table").id]
    assert on_table
    assert all(of(scores, name)["parent_right"] is None for name in on_table)


def test_iou_is_summed_over_frames(truth, room, tmp_path):
    """With an outline shifted in one of two frames, intersections and unions are summed over both."""
    drawing, (first, second) = draw(truth), FRAMES[:2]
    masks = [true_ids(truth, index) == truth.entity("carton").id for index in (first, second)]
    assert all(mask.sum() > 60 for mask in masks)
    shifted = np.zeros_like(masks[0])
    shifted[:, 4:] = masks[0][:, :-4]
    drawing.frames = {
        first: [("carton", p) for p in pieces(shifted)],
        second: [("carton", p) for p in pieces(masks[1])],
    }
    expected = ((masks[0] & shifted).sum() + masks[1].sum()) / ((masks[0] | shifted).sum() + masks[1].sum())
    assert 0.4 < expected < 0.95
    item = of(scored(room, drawing.contract(tmp_path / "labels.json")), "carton")
    assert item["iou"] == pytest.approx(expected, abs=0.04)


def test_two_outlines_of_one_object_match_once(truth, room, tmp_path):
    drawing = draw(truth)
    for shapes in drawing.frames.values():
        shapes[:0] = [("copy", polygon + 1.0) for name, polygon in shapes if name == "carton"]
    drawing.parents["copy"] = "table"
    scores = scored(room, drawing.contract(tmp_path / "labels.json"))
    matches = [item["match"] for item in scores.things if item["match"] is not None]
    assert len(matches) == len(set(matches))
    assert of(scores, "copy")["match"] is None
    assert of(scores, "carton")["match"] == truth.entity("carton").id


def test_frames_without_a_camera_are_said_and_the_rest_is_measured(truth, tmp_path):
    path = draw(truth).contract(tmp_path / "labels.json")
    bundle = write_bundle(truth, tmp_path / "bundle")
    frames = bundle.scene["cameras"]["frames"]
    frames[:] = [frame for frame in frames if frame["index"] != FRAMES[1]]
    scores = scored(bundle, path)
    assert scores.without_camera == (FRAMES[1],)
    assert [view.frame.index for view in scores.views] == [FRAMES[0], FRAMES[2]]
    assert scores.metrics["outline_frames"] == 2
    assert scores.metrics["outline_recall_50"] == 1


def test_no_labelled_frame_with_a_camera_lists_those_that_have_one(truth, tmp_path):
    path = draw(truth).contract(tmp_path / "labels.json")
    bundle = write_bundle(truth, tmp_path / "bundle")
    frames = bundle.scene["cameras"]["frames"]
    frames[:] = [frame for frame in frames if frame["index"] in (3, 7, 11)]
    with pytest.raises(UsageError, match=r"0, 10, 20.*label some of 3, 7, 11"):
        scored(bundle, path)


def test_the_lens_bends_the_scene_as_the_film(truth, room, tmp_path):
    """Outlines on a video with barrel distortion match the scene only with the lens."""
    width, height = truth.camera.width, truth.camera.height
    side = float(max(width, height))
    nominal = Camera(width, height, side, side, width / 2, height / 2)
    params = np.array([1.2 * side, 1.2 * side, width / 2, height / 2, -0.45, 0.1, 0.001, -0.002])
    lens = Lens(nominal, DistortedCamera("OPENCV", width, height, params))
    filmed = {index: lens.as_filmed(true_ids(truth, index)) for index in FRAMES}
    path = draw(truth, filmed).contract(tmp_path / "labels.json")
    bent, straight = scored(room, path, lens), scored(room, path)
    large = [item["name"] for item in bent.things if item["pixels"] > 150]
    assert len(large) >= 4
    for name in large:
        assert of(bent, name)["iou"] > 0.85
    mean = np.mean([of(straight, name)["iou"] for name in large])
    assert mean < np.mean([of(bent, name)["iou"] for name in large]) - 0.1


def test_a_film_that_shows_more_than_its_straightened_frames_is_drawn_to_its_borders(truth, room, tmp_path):
    """A lens that scales by 0.8 gives the image of a camera with 0.8 of the focal length."""
    width, height = truth.camera.width, truth.camera.height
    side = float(max(width, height))
    nominal = Camera(width, height, side, side, width / 2, height / 2)
    params = np.array([0.8 * side, width / 2, height / 2])
    lens = Lens(nominal, DistortedCamera("SIMPLE_PINHOLE", width, height, params))
    path = draw(truth).contract(tmp_path / "labels.json")
    through = scored(room, path, lens)
    wide = write_bundle(truth, tmp_path / "bundle")
    params = wide.scene["cameras"]["params"]
    assert params[2:] == [width / 2, height / 2]
    params[:2] = [0.8 * params[0], 0.8 * params[1]]
    for found, wanted in zip(through.views, scored(wide, path).views):
        assert (wanted.shown[:, :15] > 0).any() or (wanted.shown[-15:] > 0).any()
        assert (found.shown == wanted.shown).mean() > 0.98


def test_a_polygon_covers_the_pixels_whose_centers_are_inside():
    square = np.array([[1.0, 1], [3, 1], [3, 3], [1, 3]])
    assert np.argwhere(filled(square, (5, 5))).tolist() == [[1, 1], [1, 2], [2, 1], [2, 2]]
    assert not filled(np.array([[1.6, 1.6], [2.4, 1.6], [2.4, 2.4], [1.6, 2.4]]), (5, 5)).any()
    frame = np.array([[0, 0], [8, 0], [8, 8], [0, 8], [0, 0], [2, 2], [2, 6], [6, 6], [6, 2], [2, 2]])
    ring = filled(frame.astype(float), (8, 8))
    assert not ring[2:6, 2:6].any()  # even-odd: what is inside twice is outside
    assert ring.sum() == 64 - 16


def test_a_later_outline_wins_and_covers_regions():
    square = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
    frame = LabelledFrame(0, 6, 6, (Outline("a", square), Outline("b", square + 2)), (square + 1,))
    drawn = frame.label_map(["a", "b"])
    assert drawn[3, 3] == 1
    assert drawn[1, 1] == 0
    assert drawn[5, 0] == 3
    assert frame.label_map(["a", "b"])[4, 1] == 2
    assert (drawn == 0).sum() == 12
    assert (drawn == 1).sum() == 16


@pytest.mark.parametrize("format_", ["coco", "labelme"])
def test_coco_and_labelme_say_the_same(truth, room, tmp_path, format_):
    drawing = draw(truth)
    drawing.regions = {FRAMES[0]: [np.array([[0.0, 0], [20, 0], [20, 15]])]}
    own = scored(room, drawing.contract(tmp_path / "labels.json"))
    other = scored(room, getattr(drawing, format_)(tmp_path / format_))
    assert {k: v for k, v in other.metrics.items() if k != "outline_edges"} == {
        k: v for k, v in own.metrics.items() if k != "outline_edges"
    }
    assert other.metrics["outline_edges"] is None  # these formats say nothing of parents
    for item in own.things:
        assert of(other, item["name"])["iou"] == item["iou"]


def test_images_of_a_folder_are_found_by_their_place_in_name_order(truth, tmp_path):
    path = draw(truth).coco(tmp_path / "coco.json")
    names = [f"f_{number:05d}.JPG" for number in range(20, -1, -10)]
    labels = load_outlines(path, names)
    assert [frame.index for frame in labels.frames] == [2, 1, 0]
    with pytest.raises(UsageError, match="--video"):
        load_outlines(path, None)
    with pytest.raises(UsageError, match="none of the 1 images"):
        load_outlines(path, ["a.jpg"])


def test_outlines_alone_are_enough(truth, room, tmp_path):
    """A file without `things` and `ignore` is valid: only names and polygons are required."""
    path = draw(truth).contract(tmp_path / "labels.json")
    data = json.loads(path.read_text())
    for key in ("things", "ignore", "capture"):
        data.pop(key)
    path.write_text(json.dumps(data))
    scores = scored(room, path)
    assert scores.metrics["outline_recall_50"] == 1
    assert scores.metrics["outline_edges"] is None
