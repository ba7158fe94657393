"""Labels by models: which pictures they are shown, how sure they may be, and what happens where they fail."""

from dataclasses import replace

import numpy as np
import pytest
import tiny_models
from chat_server import Server, chat
from notes import Notes
from surfaces import floor_sheet, frames_of, merged, solid_box, surface_from

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import Camera, Instance, InstanceSet, PosedFrames, VideoSource
from reconstruction.instances import (
    InstancesConfig,
    backends,
    load_namer,
    make_instances,
    name_instances,
    outside_inputs,
)
from reconstruction.instances.naming import Name, apply_names, best_views, collage
from reconstruction.instances.naming.clip import choose, read_vocabulary
from reconstruction.instances.naming.vlm import VlmNamer
from reconstruction.learned.vlm import Endpoint, VlmClient
from registry.errors import EnvironmentMissing, UsageError

pytestmark = pytest.mark.stage

HEIGHT, WIDTH = 60, 80


def scene() -> tuple[InstanceSet, PosedFrames]:
    """Return three frames with a red thing (2), a green one (3) at a border, and one that nothing shows (4)."""
    images = np.full((3, HEIGHT, WIDTH, 3), 120, np.uint8)
    ids = np.ones((3, HEIGHT // 2, WIDTH // 2), np.uint16)
    for row, (top, size) in enumerate(((5, 8), (8, 14), (9, 13))):
        ids[row, top : top + size, 10 : 10 + size] = 2
        images[row, 2 * top : 2 * (top + size), 20 : 20 + 2 * size] = (200, 30, 30)
    ids[0, :9, 31:] = 3
    ids[1, 20:28, 31:39] = 3
    images[0, :18, 62:], images[1, 40:56, 62:78] = (30, 180, 30), (30, 180, 30)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (0.0, 3.0, 3.1)
    posed = PosedFrames(
        source=VideoSource("v.mp4", "", WIDTH, HEIGHT, 30.0, 30, 1.0),
        camera=Camera(WIDTH, HEIGHT, 70.0, 70.0, WIDTH / 2, HEIGHT / 2), images=images,
        indices=np.array([1, 11, 21], np.int32), times_s=np.arange(3.0), world_from_camera=poses,
        sharpness=np.ones(3, np.float32), held_out_images=images[:0], held_out_indices=np.zeros(0, np.int32),
        held_out_times_s=np.zeros(0), held_out_world_from_camera=poses[:0], points=np.zeros((0, 3)),
        point_colors=np.zeros((0, 3), np.uint8), point_errors_px=np.zeros(0, np.float32),
        observations=np.zeros((0, 2), np.int32), chosen_frames=3, ordered=True, reprojection_error_px=0.5,
    )  # fmt: skip
    objects = tuple(
        Instance(
            i,
            "unknown" if i != 3 else "plant",
            0.2,
            np.array([0.5, 0, 2.0]),
            0.0,
            np.full(3, 0.1 * i),
            1,
            False,
        )
        for i in (2, 3, 4)
    )
    return InstanceSet(np.array([1, 2, 3, 4], np.int32), (), objects, ids), posed


def unchanged(before: InstanceSet, after: InstanceSet) -> bool:
    """Tell whether nothing but labels differs."""
    same = all(
        {**new, "label": old["label"], "label_confidence": old["label_confidence"]} == old
        for old, new in zip(_plain(before), _plain(after), strict=True)
    )
    return same and after.vertex_instance is before.vertex_instance and after.id_maps is before.id_maps


def _plain(found: InstanceSet) -> list[dict]:
    """Return the fields of the objects with tuples for arrays, so that == works."""
    return [{**vars(o), "center": tuple(o.center), "extents_m": tuple(o.extents_m)} for o in found.objects]


# ---- Pictures.


def test_views_are_the_largest_whole_ones_from_different_sides() -> None:
    found, posed = scene()
    views = best_views(found, posed, count=2)
    assert [view.row for view in views[2]] == [1, 0]  # 2 is almost as large, but from where 1 is
    assert [view.row for view in views[3]] == [1, 0]  # 0 is larger, but cut by the border
    assert views[4] == []


def test_crops_hold_the_object_at_the_resolution_of_the_image() -> None:
    found, posed = scene()
    view = best_views(found, posed, count=1)[2][0]
    assert view.mask.sum() == 28 * 28
    assert (view.crop[view.mask] == (200, 30, 30)).all()
    assert (view.crop[~view.mask] == 120).all()
    assert (~view.mask).sum() > 100
    dimmed = view.dimmed()
    assert (dimmed[view.mask] == (200, 30, 30)).all()
    assert (dimmed[~view.mask] == 48).all()
    changed = (view.outlined() != dimmed).any(axis=2)
    assert changed.any()
    assert not changed[view.mask.nonzero()[0].min() + 4 : view.mask.nonzero()[0].max() - 4, 20:30].all()


def test_pictures_of_any_size_stand_beside_each_other() -> None:
    whole = collage([np.zeros((10, 30, 3), np.uint8), np.zeros((900, 100, 3), np.uint8)], height_px=90)
    assert whole.shape[0] == 90
    assert whole.dtype == np.uint8
    assert (whole == 0).any(axis=(0, 2)).sum() == 90 + 10


# ---- Applying names.


def test_names_change_labels_and_nothing_else() -> None:
    found, _ = scene()
    watcher = Notes()
    named = apply_names(found, [Name("red cup", 0.7), None, Name("box", 0.99)], "a model", progress=watcher)
    assert [(o.label, o.label_confidence) for o in named.objects] == [
        ("red cup", 0.7),
        ("plant", 0.2),
        ("box", 0.9),
    ]
    assert unchanged(found, named)
    assert watcher.notes == ["labels: a model named 2 of 3 objects; 3 keep their embedded labels"]


@pytest.mark.parametrize("label", ["", "Cup", "a/b", "../../x", "<b>cup</b>", "x" * 41, "cup\n"])
def test_what_files_could_stumble_over_is_no_label(label) -> None:
    with pytest.raises(ValueError, match="is no label"):
        Name(label, 0.5)


# ---- CLIP.


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Tiny models gain nothing from threads, and lose much to them on a busy machine."""
    with tiny_models.one_thread():
        yield


def test_confidence_is_the_margin_over_all_views() -> None:
    words = ("cup", "bowl", "box")
    sure = np.array([[0.7, 0.2, 0.05, 0.05], [0.6, 0.2, 0.1, 0.1]])
    name = choose(words, sure)
    assert (name.label, round(name.confidence, 6)) == ("cup", 0.45)
    torn = np.array([[0.8, 0.1, 0.05, 0.05], [0.25, 0.65, 0.05, 0.05]])
    name = choose(words, torn)
    assert (name.label, round(name.confidence, 6)) == ("cup", 0.15)  # though its mean is 0.525
    assert choose(words, np.array([[0.3, 0.28, 0.22, 0.2]])) is None  # as good as each other
    assert choose(words, np.array([[0.1, 0.1, 0.1, 0.7]])) is None  # it looks like no thing


@pytest.mark.parametrize("seed", range(20))
def test_confidence_never_exceeds_what_any_reading_of_the_views_supports(seed) -> None:
    rng = np.random.default_rng(seed)
    logits = rng.normal(size=(3, 6)) * rng.uniform(0.5, 6)
    probabilities = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    name = choose(tuple("abcdef"), probabilities)
    if name is not None:
        mean = np.sort(probabilities.mean(axis=0))
        assert 0.1 <= name.confidence <= mean[-1] - mean[-2] + 1e-12


def test_the_vocabulary_is_the_users_or_a_list_of_household_things() -> None:
    assert read_vocabulary("Cup,  desk lamp , cup,") == ("cup", "desk lamp")
    household = read_vocabulary("")
    assert len(household) > 50
    assert {"table", "cup", "book"} <= set(household)
    with pytest.raises(UsageError, match="at least two"):
        read_vocabulary("cup")
    with pytest.raises(UsageError, match="is no label"):
        read_vocabulary("cup, b/../w")


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory) -> str:
    return tiny_models.save_clip(tmp_path_factory.mktemp("clip"))


def test_a_clip_model_is_loaded_and_names_what_it_sees(clip_folder, monkeypatch) -> None:
    config = InstancesConfig(
        labels="clip", labels_model=clip_folder, labels_vocabulary="cup, lamp, box, chair"
    )
    namer = load_namer(config)
    found, posed = scene()
    monkeypatch.setattr("reconstruction.instances.naming.clip._MIN_MARGIN", 0.0)
    monkeypatch.setattr("reconstruction.instances.naming.clip._NO_THING", ())
    namer = load_namer(config)
    names = namer.name_objects(found, posed, progress=NO_PROGRESS)
    assert names == namer.name_objects(found, posed, progress=NO_PROGRESS)
    assert names[2] is None  # nothing shows it
    assert {name.label for name in names[:2]} <= {"cup", "lamp", "box", "chair"}
    views = best_views(found, posed)[2]
    probabilities = namer.probabilities([view.dimmed() for view in views])
    assert probabilities.shape == (3, 4)
    assert np.allclose(probabilities.sum(axis=1), 1)
    alone = namer.probabilities([views[0].dimmed()])
    assert np.allclose(alone, probabilities[:1], atol=1e-5)
    named = name_instances(namer, found, posed, progress=NO_PROGRESS)
    assert unchanged(found, named)


def test_a_missing_clip_model_names_its_own_option(tmp_path) -> None:
    pytest.importorskip("transformers")
    with pytest.raises(EnvironmentMissing, match=r"instances\.labels: .*instances\.labels_model=DIR"):
        load_namer(InstancesConfig(labels="clip", labels_model=str(tmp_path / "none")))


# ---- A vision-language model.


@pytest.fixture
def server():
    with Server() as running:
        yield running


def vlm_of(server) -> VlmNamer:
    return VlmNamer(VlmClient(Endpoint(server.url, "tiny-vl", pause_s=0.001, timeout_s=2.0)))


def test_a_vlm_is_asked_about_each_object_that_shows(server) -> None:
    server.responses = [
        chat('{"id": 2, "label": "Red Cup", "certainty": "certain"}'),
        chat('{"id": 3, "label": "house plant", "certainty": "likely"}'),
    ]
    found, posed = scene()
    named = name_instances(vlm_of(server), found, posed, progress=NO_PROGRESS)
    labels = [(o.label, o.label_confidence) for o in named.objects]
    assert labels == [("red cup", 0.8), ("house plant", 0.5), ("unknown", 0.2)]
    assert unchanged(found, named)
    assert len(server.requests) == 2
    text = server.requests[0]["messages"][0]["content"][0]["text"]
    assert "Object number: 2" in text
    assert "20 x 20 cm on the ground, 20 cm high" in text


def test_what_a_vlm_does_not_know_keeps_its_label(server) -> None:
    server.responses = [
        chat('{"id": 2, "label": "unknown", "certainty": "certain"}'),
        chat('{"id": 3, "label": "cactus", "certainty": "unsure"}'),
    ]
    found, posed = scene()
    watcher = Notes()
    named = name_instances(vlm_of(server), found, posed, progress=watcher)
    assert [o.label for o in named.objects] == ["unknown", "plant", "unknown"]
    assert watcher.notes == ["labels: tiny-vl named 0 of 3 objects; 2, 3, 4 keep their embedded labels"]


def test_an_answer_about_another_object_is_not_believed(server) -> None:
    server.responses = [
        chat('{"id": 3, "label": "cup", "certainty": "certain"}'),
        chat('{"id": 2, "label": "mug", "certainty": "certain"}'),
        chat('{"id": 2, "label": "plate", "certainty": "certain"}'),
    ]
    found, posed = scene()
    watcher = Notes()
    named = name_instances(vlm_of(server), found, posed, progress=watcher)
    assert [o.label for o in named.objects] == ["mug", "plant", "unknown"]
    assert "there is no object 3 in the pictures" in server.requests[1]["messages"][2]["content"]
    assert any("object 3: tiny-vl: no usable answer in 3 attempts" in note for note in watcher.notes)


def test_an_endpoint_that_is_away_is_noted_once(server) -> None:
    server.responses = [(401, {}, "no")]
    found, posed = scene()
    watcher = Notes()
    named = name_instances(vlm_of(server), found, posed, progress=watcher)
    assert [o.label for o in named.objects] == ["unknown", "plant", "unknown"]
    assert len(server.requests) == 1
    assert len(watcher.notes) == 2
    assert "HTTP 401" in watcher.notes[0]
    assert "3 objects are not asked about" in watcher.notes[0]


# ---- The stage.


def test_the_stage_finds_things_and_has_them_named(server, monkeypatch) -> None:
    surface = surface_from(
        merged(floor_sheet((200, 200, 190)), solid_box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.4), (120, 80, 50)))
    )
    posed, depth = frames_of(surface, 160, 120)
    server.responses = [chat('{"id": 2, "label": "crate", "certainty": "likely"}')]
    monkeypatch.setenv("SIMRECON_VLM_URL", server.url)
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "tiny-vl")
    watcher = Notes()
    plain = make_instances(posed, depth, surface, InstancesConfig(), progress=watcher)
    named = make_instances(posed, depth, surface, InstancesConfig(labels="vlm"), progress=watcher)
    assert [(o.id, o.label, o.label_confidence) for o in named.objects] == [(2, "crate", 0.5)]
    assert [o.id for o in plain.objects] == [2]
    assert plain.objects[0].label != "crate"
    assert np.array_equal(named.vertex_instance, plain.vertex_instance)
    assert np.array_equal(named.id_maps, plain.id_maps)
    assert "labels: tiny-vl named 1 of 1 objects" in watcher.notes


def test_embedded_labels_need_nothing(monkeypatch) -> None:
    monkeypatch.delenv("SIMRECON_VLM_URL", raising=False)
    assert load_namer(InstancesConfig()) is None
    with pytest.raises(EnvironmentMissing, match="SIMRECON_VLM_URL"):
        load_namer(InstancesConfig(labels="vlm"))


def test_other_files_behind_the_same_config_are_another_input(tmp_path, monkeypatch) -> None:
    assert outside_inputs(InstancesConfig()) == ()
    (tmp_path / "00000.png").write_bytes(b"1")
    config = InstancesConfig(masks="folder", masks_path=str(tmp_path))
    before = outside_inputs(config)
    (tmp_path / "00000.png").write_bytes(b"2")
    assert len(before) == 1
    assert outside_inputs(config) != before
    assert outside_inputs(replace(config, masks="embedded")) == ()
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "one")
    first = outside_inputs(InstancesConfig(labels="vlm"))
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "two")
    assert outside_inputs(InstancesConfig(labels="vlm")) != first


def test_the_bundle_says_who_made_masks_and_labels(monkeypatch) -> None:
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "some-vl")
    assert backends(InstancesConfig()) == {"masks": "embedded", "labels": "embedded"}
    assert backends(InstancesConfig(masks="sam2", labels="vlm")) == {
        "masks": "sam2 (facebook/sam2.1-hiera-small)",
        "labels": "vlm (some-vl)",
    }
    assert backends(InstancesConfig(masks="folder", labels="clip", labels_model="m")) == {
        "masks": "folder",
        "labels": "clip (m)",
    }
