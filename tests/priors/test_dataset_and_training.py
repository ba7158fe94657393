"""Rooms on disk, samples of them, and training that can be stopped: the ground of the networks that ship."""

import json

import numpy as np
import pytest
import torch
import yaml

from priors import captures, dataset, mending, train
from priors.rooms import HELD_OUT, SPLITS, draw_film, families_of
from priors.samples import border_of, draw_sample, load_sample, open_rooms
from reconstruction.depth.channels import BINS

pytestmark = pytest.mark.end_to_end

FRAMES = 6


def test_held_out_families_never_occur_in_training():
    trained = families_of("train")
    for sorts in HELD_OUT.values():
        assert not set(sorts.get("shapes", ())) & set(trained.shapes)
        assert not set(sorts.get("furniture", ())) & set(trained.furniture)
        for name in sorts.get("materials", ()):
            assert getattr(trained.materials, name) == 0
    for split in SPLITS[1:]:
        assert families_of(split) != trained


def test_a_finished_room_is_kept_and_a_torn_one_is_made_again(data, capsys):
    room = open_rooms(data / "train")[0].folder
    before = (room / "cost.npy").stat().st_mtime_ns
    (data / "train" / "00009.part").mkdir()
    seed = str(int(room.name))
    arguments = [str(data), "--rooms", "1", "--seed", seed, "--frames", str(FRAMES), "--processes", "1"]
    assert dataset.main(arguments) == 0
    assert "1 of 1 rooms are there" in capsys.readouterr().out
    assert (room / "cost.npy").stat().st_mtime_ns == before
    assert len(open_rooms(data / "train")) == 1  # the torn one is no room
    manifest = json.loads((data / "manifest.json").read_text())
    assert {r["split"] for r in manifest["rooms"]} == {"train", "shapes"}
    assert all(len(digest) == 64 for r in manifest["rooms"] for digest in r["sha256"].values())


def test_costs_are_least_near_the_true_depth(data):
    room = open_rooms(data / "train")[0]
    gaps = []
    for row in range(FRAMES):
        sample = load_sample(room, row)
        gray = sample.color.mean(0)
        textured = (np.abs(np.gradient(gray)[0]) + np.abs(np.gradient(gray)[1])) > 0.04
        known = (sample.place >= 0) & textured & ~border_of(sample.place, sample.rho)
        gaps.append(np.abs(sample.correlation.argmax(0) - sample.place)[known])
    assert np.median(np.concatenate(gaps)) < 1.0  # bins


def test_another_range_keeps_costs_and_truth_together(data):
    room = open_rooms(data / "train")[0]
    depths = room.arrays["true_depth"]
    low, high = float(depths[depths > 0].min()), float(depths.max())
    for seed in range(6):
        sample = draw_sample(room, np.random.default_rng(seed))
        known = sample.place >= 0
        depth = 1 / (sample.rho[0] + sample.rho[1] * sample.place[known])
        assert low * 0.999 <= depth.min()
        assert depth.max() <= high * 1.001
        assert sample.correlation.shape[0] == BINS
        assert 0 <= sample.color.min() <= sample.color.max() <= 1


def _train(network, data, out, steps, **more):
    values = {
        "network": network, "data": str(data), "out": str(out), "steps": steps, "batch": 1, "check_every": 2,
        "check_keyframes": 1, "widths": [16, 16, 16], "held_out": ["shapes"], "threads": 1, "warm_up": 1000, **more,
    }  # fmt: skip
    config = out.with_suffix(".yaml")
    config.write_text(yaml.safe_dump(values))
    assert train.main([str(config)]) == 0
    return torch.load(out / "checkpoint.pt", weights_only=True)


@pytest.mark.parametrize(
    ("network", "figures"),
    [
        ("aggregation", {"net_off5", "sgm_off5", "net_off5_border"}),
        ("mending", {"entropy", "off_before", "off_after_steps", "agreed_known_after"}),
    ],
)
def test_stopped_training_goes_on_to_the_same_weights(network, figures, data, tmp_path):
    whole = _train(network, data, tmp_path / "whole", 4)
    _train(network, data, tmp_path / "parts", 2)
    parts = _train(network, data, tmp_path / "parts", 4)
    assert parts["step"] == whole["step"] == 4
    for name, value in whole["slow"].items():
        assert torch.equal(value, parts["slow"][name]), name
    assert (tmp_path / "whole" / "best.safetensors").is_file()
    curve = [json.loads(line) for line in (tmp_path / "whole" / "curve.jsonl").read_text().splitlines()]
    assert [entry["step"] for entry in curve] == [2, 4]
    assert figures <= set(curve[0]["shapes"])


def test_samples_for_mending_say_how_likely_each_candidate_is(data):
    room = open_rooms(data / "train", mending.ARRAYS)[0]
    sample = mending.load_sample(room, 1)
    likelihood = mending.likelihoods(sample)
    own, best = likelihood[0], likelihood[1:-1].max(0)
    known = (sample.candidates[0] > 0) & (sample.truth > 0)
    assert (likelihood[:-1][sample.candidates == 0] < -100).all()
    assert (own[known] > likelihood[-1][known]).mean() > 0.5  # most depth is nearly right
    # Beside steps of depth, pixels are wrong that a neighbor's surface puts right.
    steps = mending.beside_steps(sample.truth)
    wrong = known & (own < likelihood[-1])
    assert (best > -1)[wrong & steps].sum() > 50
    crop = mending.draw_sample(room, np.random.default_rng(0))
    assert crop.features.shape[1:] == crop.truth.shape == crop.candidates.shape[1:]
    batch = mending.stack([crop, crop])
    assert batch[2][:, mending.beside_steps(crop.truth)].max() == 4


def test_where_nothing_stands_no_candidate_is_right():
    """A plane of depth 2 whose upper half has no true surface: `none` is likeliest there, and it has weight."""
    truth = np.full((24, 32), 2.0, np.float32)
    truth[:12] = 0
    candidates = np.full((3, 24, 32), 0.5, np.float32)
    sample = mending.Sample(
        np.zeros((13, 24, 32), np.float32), candidates, truth, np.zeros((24, 32), np.int32)
    )
    likelihood = mending.likelihoods(sample)
    assert (likelihood.argmax(0)[:12] == 3).all()
    assert (likelihood.argmax(0)[12:] == 0).all()
    assert (mending.stack([sample])[2].numpy() > 0).all()


@pytest.fixture(scope="module")
def open_film():
    """The first film of the split whose room lacks a wall, and which walls the same room has in all."""
    for number in range(20):
        film = draw_film("train", number)
        if len(film.room.base) < film.base_entities:
            return film
    raise AssertionError("none of 20 rooms lacks a wall")


def test_some_rooms_lack_walls_and_what_hangs_there(open_film):
    ids = {e.id for e in open_film.room.entities}
    assert {e.parent for e in open_film.room.entities} - {None} <= ids
    assert set(np.unique(open_film.film_set.face_entity)) <= ids
    # The camera turned to where the wall was sees the background's color, as it is drawn.
    from synthetic.film import render_color, render_truth

    camera, pose = open_film.camera(64, 48), np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # looks along +y
    west, east, _, north = open_film.room.extent
    pose[:3, 3] = (west + east) / 2, north + 50, 1.2  # beyond the room: nothing at all
    assert (render_truth(open_film.film_set, camera, pose)[0] == 0).all()
    color = render_color(open_film.film_set, camera, pose, quick=True)
    assert np.allclose(color, open_film.film_set.background, atol=1)


def test_a_film_of_a_held_out_room_becomes_a_capture(open_film, tmp_path):
    from reconstruction.measure.ground_truth import GroundTruth

    captures.write_film(open_film, tmp_path / "room", 3)
    assert (tmp_path / "room" / "video.mp4").stat().st_size > 1000
    truth = GroundTruth.load(tmp_path / "room" / "ground_truth")
    assert truth is not None
    scene = json.loads((tmp_path / "room" / "ground_truth" / "scene.json").read_text())
    assert {e["id"] for e in scene["entities"]} == {e.id for e in open_film.room.entities}


def test_training_may_start_from_given_weights(data, tmp_path):
    from safetensors.torch import load_file

    _train("mending", data, tmp_path / "first", 2, seed=1)
    start = tmp_path / "first" / "best.safetensors"
    moved = _train("mending", data, tmp_path / "second", 2, start=str(start))
    fresh = _train("mending", data, tmp_path / "third", 2)
    given = load_file(start)
    name = "unet.enter.0.weight"
    away = [float((state["net"][name] - given[name].float()).abs().mean()) for state in (moved, fresh)]
    assert away[0] < 0.1 * away[1]  # two steps at the start of the warm-up hardly move them


def test_without_predictions_and_completion_what_was_measured_stays(data):
    room = open_rooms(data / "train", mending.ARRAYS)[0]
    whole, fewer = (mending.load_sample(room, 1, predictions=flag) for flag in (True, False))
    measured = mending.load_sample(room, 1, agreed=True)
    known = [s.candidates[0] > 0 for s in (whole, fewer, measured)]
    assert known[0].sum() > known[1].sum()
    assert np.array_equal(whole.candidates[0][known[1]], fewer.candidates[0][known[1]])
    assert np.array_equal(known[2], np.asarray(room.arrays["agreed"][1]) > 0)


def test_unknown_fields_of_a_config_are_refused(tmp_path, capsys):
    config = tmp_path / "c.yaml"
    config.write_text("network: mending\ndata: x\nout: y\nsteppes: 3\n")
    with pytest.raises(SystemExit):
        train.main([str(config)])
    assert "steppes" in capsys.readouterr().err
    config.write_text("data: x\nout: y\n")
    with pytest.raises(SystemExit):
        train.main([str(config)])
    assert "aggregation, mending" in capsys.readouterr().err
