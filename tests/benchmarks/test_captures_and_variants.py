"""Captures are found on disk as they are documented, and variants are named sets of arguments."""

import json
from pathlib import Path

import pytest

from benchmarks.captures import find_captures
from benchmarks.variants import VARIANTS, choose_variants, scene_id
from reconstruction.cli import build_parser
from registry.errors import UsageError


def _capture(folder: Path, *, video: bool = True, images: str = "", truth: str = "") -> Path:
    folder.mkdir(parents=True)
    if video:
        (folder / "video.mp4").write_bytes(b"film of " + folder.name.encode())
    if images:
        place = folder / images
        place.mkdir(exist_ok=True)
        for number in range(3):
            (place / f"{number}.JPG").write_bytes(bytes([number]))
    if truth:
        (folder / "ground_truth").mkdir()
        (folder / "ground_truth" / truth).write_text(json.dumps({"frames": []}))
    return folder


@pytest.fixture
def shelf(tmp_path):
    """Return a folder with one capture of each kind, and things that are none."""
    _capture(tmp_path / "b_room", truth="scene.json")
    _capture(tmp_path / "kitchen", truth="cameras.json")
    _capture(tmp_path / "photos", video=False, images="images")
    _capture(tmp_path / "scan", video=False, images=".")
    (tmp_path / "nothing").mkdir()
    (tmp_path / "README.md").write_text("text")
    return tmp_path


def test_every_kind_of_capture_is_found_in_name_order(shelf):
    found = find_captures([shelf])
    assert [(c.name, c.truth) for c in found] == [
        ("b_room", "scene"),
        ("kitchen", "cameras"),
        ("photos", "none"),
        ("scan", "none"),
    ]
    assert [c.source.name for c in found] == ["video.mp4", "video.mp4", "images", "scan"]
    assert found[0].ground_truth == shelf / "b_room" / "ground_truth"
    assert found[2].ground_truth is None


def test_a_capture_itself_and_a_choice_of_names(shelf):
    assert [c.name for c in find_captures([shelf / "kitchen"])] == ["kitchen"]
    assert [c.name for c in find_captures([shelf, shelf / "kitchen"], ["kitchen"])] == ["kitchen"]


def test_two_captures_of_one_name_are_told_apart(tmp_path):
    _capture(tmp_path / "old" / "room")
    _capture(tmp_path / "new" / "room")
    assert [c.name for c in find_captures([tmp_path / "old", tmp_path / "new"])] == ["old_room", "new_room"]


@pytest.mark.parametrize(
    ("folder", "only", "said"),
    [("gone", (), "no such folder"), ("nothing", (), "video.mp4"), (".", ("cellar",), "kitchen")],
)
def test_what_cannot_be_found_is_said(shelf, folder, only, said):
    with pytest.raises(UsageError, match=said):
        find_captures([shelf / folder], only)


def test_the_digest_covers_input_and_truth(shelf):
    capture = find_captures([shelf / "b_room"])[0]
    before = capture.digest()
    assert capture.digest() == before
    (shelf / "b_room" / "ground_truth" / "scene.json").write_text("{}")
    changed_truth = capture.digest()
    capture.source.write_bytes(b"another film")
    assert len({before, changed_truth, capture.digest()}) == 3


def test_labels_beside_captures_are_found_by_name_and_digested(shelf):
    (shelf / "labels").mkdir()
    before = find_captures([shelf / "scan"])[0]
    (shelf / "labels" / "scan.json").write_text("{}")
    (shelf / "labels" / "other.json").write_text("{}")
    found = find_captures([shelf])
    assert [c.labels and c.labels.name for c in found] == [None, None, None, "scan.json"]
    assert before.labels is None
    digests = {before.digest(), found[3].digest()}
    (shelf / "labels" / "scan.json").write_text("[]")
    assert len(digests | {found[3].digest()}) == 3


def test_an_oracle_needs_the_truth_that_it_gives(shelf):
    room, kitchen, photos, _ = find_captures([shelf])
    by_name = {variant.name: variant for variant in VARIANTS}
    assert len(by_name) == len(VARIANTS)
    assert by_name["oracle-instances"].applies_to(room)
    assert not by_name["oracle-instances"].applies_to(kitchen)
    assert by_name["oracle-poses"].applies_to(kitchen)
    assert not by_name["oracle-poses"].applies_to(photos)
    assert all(by_name[name].applies_to(photos) for name in ("default", "fast", "quality"))
    assert str(kitchen.ground_truth) in by_name["oracle-poses"].arguments_for(kitchen)


def test_variants_of_ones_own():
    chosen = choose_variants(["fast"], ['sharp=--set depth.side_px=640 --scale "camera-height=1.5"'])
    assert [variant.name for variant in chosen] == ["fast", "sharp"]
    assert chosen[1].arguments == ("--set", "depth.side_px=640", "--scale", "camera-height=1.5")


@pytest.mark.parametrize("wrong", ["sharp", "=--quiet", "a b=--quiet", "fast=--quiet", "default=--quiet"])
def test_malformed_or_taken_names_are_refused(wrong):
    with pytest.raises(UsageError, match="--variant"):
        choose_variants(["default"], [wrong])


def test_an_unknown_variant_lists_the_known_ones():
    with pytest.raises(UsageError, match="oracle-depth"):
        choose_variants(["defualt"], [])


def test_presets_are_arguments_that_the_command_knows_and_ids_that_the_registry_takes():
    for variant in VARIANTS:
        assert scene_id(variant).replace("_", "").isalnum()
        if variant.needs == "none":
            build_parser().parse_args(["reconstruct", "film.mp4", *variant.arguments])
