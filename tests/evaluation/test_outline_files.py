"""Malformed labels give one error with file, place and remedy."""

import json
import re
from pathlib import Path

import pytest
from outline_drawing import draw
from truth_bundle import write_bundle

from reconstruction.measure import load_outlines, score_outlines
from registry.errors import UsageError

SQUARE = [[2, 2], [9, 2], [9, 9], [2, 9]]


def contract(**changed) -> dict:
    frame = {"index": 0, "width": 40, "height": 30, "things": [{"name": "mug", "polygon": SQUARE}]}
    frame |= changed.pop("frame", {})
    return {"frames": [frame], "things": {"mug": {"parent": "floor"}}, "ignore": []} | changed


def coco(**changed) -> dict:
    annotation = {"id": 7, "image_id": 1, "category_id": 1, "segmentation": [[2, 2, 9, 2, 9, 9]]}
    annotation |= changed.pop("annotation", {})
    image = {"id": 1, "file_name": changed.pop("picture", "00010.jpg"), "width": 40, "height": 30}
    twice = [annotation, annotation] if changed.pop("twice", False) else [annotation]
    return {"images": [image], "annotations": twice, "categories": [{"id": 1, "name": "mug"}]}


def labelme(*shapes: dict, picture: str = "00010.jpg") -> dict:
    return {"shapes": list(shapes), "imagePath": picture, "imageWidth": 40, "imageHeight": 30}


def shape(**changed) -> dict:
    return {"label": "mug", "points": SQUARE, "group_id": None, "shape_type": "polygon"} | changed


THING = {"name": "mug", "polygon": SQUARE}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([1, 2], "no known format; known are .*COCO.*labelme"),
        ({"entities": []}, "no known format"),
        ({"frames": [], "intrinsics": {}}, "give the folder"),
        (contract(frames=[]), "no labelled frame"),
        (contract(frame={"width": None}), "`width` is None, expected a whole number"),
        (contract(frame={"index": 2.5}), "`index` is 2.5"),
        (contract(frame={"index": float("inf")}), "`index` is inf"),
        (contract(frame={"things": "mug"}), "malformed .*docs/evaluation.md"),
        (contract(things=["mug"]), "malformed"),
        (contract(frame={"index": -1}), "counts from 0"),
        (contract(frame={"things": [THING | {"polygon": SQUARE[:2]}]}), "frame 0, mug: .*three or more"),
        (contract(frame={"things": [THING | {"polygon": [[1, 2, 3]] * 3}]}), "frame 0, mug"),
        (contract(frame={"things": [THING | {"polygon": [[1, 2], [3]]}]}), "points"),
        (contract(frame={"things": [THING | {"polygon": [*SQUARE, [70, 5]]}]}), r"\(70, 5\) is outside of the 40x30"),
        (contract(frame={"things": [THING | {"polygon": [*SQUARE, [5, float("nan")]]}]}), "not finite"),
        (contract(frame={"ignore_regions": [[[0, 0], [0, -9], [5, 5]]]}), "an ignored region: .*outside"),
        (contract(frame={"things": [THING | {"name": "cup"}]}), "'cup' is not in `things`"),
        (contract(frame={"things": [{"polygon": SQUARE}]}), "'name' is missing"),
        (contract(things={"mug": {"parent": "tabel"}}), "'mug': its parent 'tabel'"),
        (contract(ignore=["cup"]), "`ignore` names 'cup'"),
        (contract(frames=contract()["frames"] * 2), "frame 0 is labelled twice"),
        (coco(annotation={"segmentation": {"counts": "x", "size": [1, 1]}}), "annotation 7: .*instead of masks"),
        (coco(annotation={"segmentation": []}), "annotation 7"),
        (coco(annotation={"segmentation": [[1, 2, 3]]}), "flat list"),
        (coco(annotation={"category_id": 5}), "category 5"),
        (coco(annotation={"image_id": 5}), "image 5"),
        (coco(twice=True), "two annotations of 'mug'"),
        (coco(picture="kitchen.jpg"), "kitchen.jpg is unknown; name images by the number"),
        (coco(picture="take2_00010.jpg"), "take2_00010.jpg is unknown"),
        (labelme(shape(shape_type="circle", points=SQUARE[:2])), "'mug' is a circle"),
        (labelme(shape(), shape()), "two shapes are 'mug'"),
        (labelme(shape(group_id=1), shape(group_id=2)), "two shapes are 'mug'"),
    ],
)  # fmt: skip
def test_malformed_labels(tmp_path, data, message):
    path = tmp_path / "labels.json"
    path.write_text(json.dumps(data))
    with pytest.raises(UsageError, match=message) as caught:
        load_outlines(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(("content", "message"), [(b"{", "not JSON"), (b"\xff\xfe\x00", "not a text file")])
def test_a_file_that_is_not_json(tmp_path, content, message):
    path = tmp_path / "labels.json"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=message):
        load_outlines(path)


def test_a_missing_file(tmp_path):
    with pytest.raises(UsageError, match="no such file"):
        load_outlines(tmp_path / "labels.json")
    with pytest.raises(UsageError, match="no JSON file"):
        load_outlines(tmp_path)


def test_optional_features_of_the_formats(tmp_path):
    path = tmp_path / "labels.json"
    edge = contract(frame={"things": [THING | {"polygon": [[-0.5, 0], [40.5, 0], [40, 30]]}]})
    path.write_text(json.dumps(edge))  # slightly outside of the image
    assert load_outlines(path).frames[0].label_map(["mug"])[0, 20] == 0
    box = {"shape_type": "rectangle", "points": [[2, 3], [9, 8]]}
    path.write_text(json.dumps(labelme(shape(**box), shape(label="Ignore"), picture="f-00010.png")))
    (frame,) = load_outlines(path).frames
    assert (frame.index, len(frame.outlines), len(frame.ignored)) == (10, 1, 1)
    assert (frame.label_map(["mug"]) == 0).sum() == 7 * 5
    path.write_text(json.dumps(coco(annotation={"iscrowd": 1})))
    assert len(load_outlines(path).frames[0].ignored) == 1


def test_the_example_in_the_docs_is_valid(tmp_path):
    page = (Path(__file__).resolve().parents[2] / "docs" / "evaluation.md").read_text()
    (shown,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    path = tmp_path / "labels.json"
    path.write_text(shown)
    labels = load_outlines(path)
    assert labels.things == {"table": "floor", "mug": "table"}
    assert set(labels.frames[0].label_map(["table", "mug"]).ravel()) == {0, 1, 2, 3}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"index": 9000}, "frame 9000 does not exist, room.mp4 has 21 frames"),
        ({"width": 180, "height": 240}, "frame 0 is 180x240, but the video is 240x180"),
    ],
)
def test_labels_of_another_video_are_refused(truth, tmp_path, change, message):
    path = draw(truth).contract(tmp_path / "labels.json")
    data = json.loads(path.read_text())
    data["frames"][0].update(change, things=[], ignore_regions=[])
    path.write_text(json.dumps(data))
    bundle = write_bundle(truth, tmp_path / "bundle")
    with pytest.raises(UsageError, match=message):
        score_outlines(bundle, [], load_outlines(path))


def test_labels_without_evaluated_objects_are_refused(truth, tmp_path):
    drawing = draw(truth)
    bundle = write_bundle(truth, tmp_path / "bundle")
    drawing.ignore = list(drawing.parents)
    for change in ("all ignored", "nothing outlined"):
        if change == "nothing outlined":
            drawing.frames, drawing.parents, drawing.ignore = {0: []}, {}, []
        path = drawing.contract(tmp_path / "labels.json")
        with pytest.raises(UsageError, match="no object that is evaluated"):
            score_outlines(bundle, [], load_outlines(path))
