"""Graphs with truth from generated rooms, the ruler, and training of the learned cut's weights."""

import json

import lightgbm
import numpy as np
import pytest
import torch
from scipy.special import expit

from priors import crops, duplicates, partition
from priors.partition_figures import area_under_curve, by_truth
from priors.partition_network import Network
from priors.partition_rooms import NEEDED, example, film_of
from priors.partition_ruler import Figures, compare
from priors.partition_trees import PAIRS, arrays_of, mean_of
from priors.samples import open_rooms
from reconstruction.instances.partition.model import FEATURES, TREES, load_models
from registry.errors import UsageError

pytestmark = pytest.mark.end_to_end


@pytest.fixture(scope="module")
def graph(data):
    return example(open_rooms(data / "shapes", NEEDED)[0], data / "cache", None)


def test_true_ids_of_vertices_are_the_ids_that_keyframes_show(data, graph):
    from priors.partition_rooms import fused
    from registry.geometry import invert_rigid

    room = open_rooms(data / "shapes", NEEDED)[0]
    points = np.asarray(fused(room, data / "cache").vertices, np.float64)
    a, right, judged = room.arrays, 0, 0
    fx, fy = a["focal"]
    height, width = a["exact_ids"].shape[1:]
    for row, pose in enumerate(a["world_from_camera"]):
        inverse = invert_rigid(np.asarray(pose))
        local = points @ inverse[:3, :3].T + inverse[:3, 3]
        u, v = (fx * local[:, 0] / local[:, 2] + width / 2), (fy * local[:, 1] / local[:, 2] + height / 2)
        there = (local[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < width) & (v < height) & (graph.true_ids > 0)
        u, v, z = u[there].astype(int), v[there].astype(int), local[there, 2]
        near = np.abs(a["exact_depth"][row][v, u] - z) < 0.01
        right += (a["exact_ids"][row][v, u] == graph.true_ids[there])[near].sum()
        judged += near.sum()
    assert judged > 1000
    assert right > 0.95 * judged


def test_superpoints_and_targets_hold_the_truth(graph):
    targets = partition.Targets.of(graph)
    ids, pure = graph.region_ids()
    assert len(ids) == len(graph.nodes) == graph.region.max() + 1
    assert np.isfinite(graph.nodes).all()
    assert np.isfinite(graph.edges).all()
    assert pure.mean() > 0.9
    a, b = graph.pairs.T
    two = (ids[a] != ids[b]) & (
        np.maximum(ids[a], ids[b]) > graph.base_entities
    )  # a thing and something else
    assert two.any()
    assert (targets.same[two] == 0).all()
    assert (targets.same_weight[~(pure[a] & pure[b])] == 0).all()


def test_the_truth_scores_best_and_merged_things_less(graph):
    base = int(graph.base_entities)
    perfect, _ = compare(
        np.where(graph.true_ids > base, graph.true_ids, 0), graph.true_ids, base, graph.areas, graph.pixels
    )
    assert perfect.true > 2
    seen = perfect.hits[0]
    assert perfect.hits == (seen, seen)  # things without any surface cannot be found
    superpoints, matched = compare(by_truth(graph), graph.true_ids, base, graph.areas, graph.pixels)
    assert 0 < superpoints.hits[1] <= superpoints.hits[0] <= seen
    assert max(matched.values()) > 0.8
    one, _ = compare((graph.true_ids > base).astype(int), graph.true_ids, base, graph.areas, graph.pixels)
    assert one.hits[0] <= 1
    assert one.found == 1
    assert Figures(4, 5, (3, 2)).shares() == {"recall_25": 0.75, "precision_25": 0.6, "recall_50": 0.5}


def test_area_under_curve_of_known_orders():
    positive = np.array([False, False, True, True])
    assert area_under_curve(np.array([1.0, 2, 3, 4]), positive) == 1.0
    assert area_under_curve(np.array([4.0, 3, 2, 1]), positive) == 0.0
    assert area_under_curve(np.array([1.0, 1, 1, 1]), positive) == 0.5


def graph_of(rng, features):
    """Features of 30 regions and of their borders; the last region has no neighbor."""
    pairs = np.unique(np.sort(rng.integers(0, 29, (60, 2)), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    nodes, edges = (
        rng.normal(size=(count, width)).astype(np.float32) for count, width in zip((30, len(pairs)), features)
    )
    return nodes, edges, pairs


def stumps(features, rng):
    """Trees for random rows, and LightGBM's own prediction of other ones."""
    rows = rng.normal(size=(400, features)).astype(np.float32)
    target = (rows[:, 0] + rows[:, 1] * rows[:, 2] > 0).astype(float)
    booster = lightgbm.train(PAIRS | {"min_data_in_leaf": 5, "seed": 0}, lightgbm.Dataset(rows, target), 20)
    return arrays_of(booster.dump_model()), booster


def test_numpy_says_what_pytorch_says(tmp_path):
    torch.manual_seed(0)
    networks = [Network(FEATURES, 16, 2) for _ in range(2)]
    rng = np.random.default_rng(0)
    trees = {name: stumps(count, rng)[0] for name, count in TREES.items()}
    partition.export(partition.ensemble_of(networks), trees, tmp_path / "w.safetensors")
    models = load_models(tmp_path / "w.safetensors")
    nodes, edges, pairs = graph_of(rng, FEATURES)
    with torch.no_grad():
        # layers are float16 in the file
        said = [n.half().float()(*(torch.from_numpy(x) for x in (nodes, edges, pairs))) for n in networks]
    scores = models.superpoints.scores(nodes, edges, pairs)
    affinity, label = (torch.stack(values).mean(dim=0) for values in zip(*said))
    np.testing.assert_allclose(scores.affinity, affinity.numpy(), atol=1e-4)
    np.testing.assert_allclose(scores.label, label.log_softmax(dim=1).numpy(), atol=1e-4)


def test_trees_say_what_lightgbm_says():
    rng = np.random.default_rng(1)
    trees, booster = stumps(12, rng)
    rows = rng.normal(size=(500, 12)).astype(np.float32)
    rows[:50, 0] = trees.threshold[0]  # at a threshold
    np.testing.assert_allclose(trees(rows), booster.predict(rows, raw_score=True), atol=1e-5)
    assert np.ptp(trees(rows)) > 0.5
    with pytest.raises(ValueError, match="12 features got 11"):
        trees(rows[:, 1:])
    alone = lightgbm.train(PAIRS, lightgbm.Dataset(rows[:50], np.r_[np.zeros(25), np.ones(25)]), 3)
    constant = arrays_of(alone.dump_model())  # too few rows for any node
    np.testing.assert_allclose(constant(rows), alone.predict(rows, raw_score=True), atol=1e-6)


def test_the_mean_of_trees_scores_the_mean():
    rng = np.random.default_rng(3)
    (first, _), (second, _) = stumps(9, rng), stumps(9, rng)
    rows = rng.normal(size=(200, 9)).astype(np.float32)
    both = mean_of([first, second, second])
    np.testing.assert_allclose(both(rows), (first(rows) + 2 * second(rows)) / 3, atol=1e-6)


def test_training_learns_writes_weights_and_says_figures(data, tmp_path):
    arguments = [str(data), "--out", str(tmp_path), "--cache", str(data / "cache"), "--rounds", "20"]
    assert partition.main([*arguments, "--steps", "1"]) == 0
    early = json.loads((tmp_path / "figures.json").read_text())["train, superpoints"]
    assert partition.main([*arguments, "--steps", "150"]) == 0
    late = json.loads((tmp_path / "figures.json").read_text())
    assert late["train, superpoints"]["log_loss"] < 0.8 * early["log_loss"]
    assert late["train, superpoints"]["auc"] > 0.7
    wanted = {"asa", "auc", "recall_25", "precision_25", "recall_50", "by_truth_recall_25"}
    assert wanted <= set(late["shapes, superpoints"])
    assert wanted - {"asa", "auc"} <= set(late["shapes, things"])
    assert late["shapes, things"]["recall_25"] <= late["shapes, things"]["by_truth_recall_25"]
    models = load_models(tmp_path / "partition.safetensors")
    assert len(models.superpoints.members) > 1
    assert len(models.pairs.first_leaf) == 20
    assert len(models.proposals.first_leaf) == partition._SEEDS * 20


def test_noise_on_features_keeps_their_means(graph):
    fit = partition.Fit(1, 1, 16, 1, 0.0, 0.3, 0.5, 300)
    network = partition.train([graph], fit, 0)
    rng = np.random.default_rng(0)
    blurred = partition.blurred(graph, network, fit, rng)
    scale = network.edge_scale.numpy()
    away = (blurred.edges - graph.edges) * scale
    assert np.abs(away.mean(axis=0)).max() < 0.2
    assert 0.2 < np.isclose(blurred.edges, network.edge_mean.numpy()).mean() < 0.5


def test_rooms_of_other_code_are_refused(data, tmp_path):
    import shutil

    folder = next((data / "train").glob("0*"))
    other = tmp_path / "train" / folder.name
    shutil.copytree(folder, other)
    about = json.loads((other / "room.json").read_text())
    about["film"]["fov_deg"] += 1
    (other / "room.json").write_text(json.dumps(about))
    with pytest.raises(UsageError, match="make it anew"):
        film_of(open_rooms(tmp_path / "train", NEEDED)[0], None)


def test_heads_learn_from_crops_and_are_written_beside_what_ships(data, tmp_path, capsys):
    arguments = [str(data), "--out", str(tmp_path), "--cache", str(data / "cache"), "--heads", "1"]
    assert crops.main([*arguments, "--epochs", "40"]) == 0
    losses = [
        float(line.split("loss ")[1].split()[0])
        for line in capsys.readouterr().out.splitlines()
        if "loss" in line
    ]
    assert len(losses) == 40
    assert np.mean(losses[-3:]) < 0.9 * losses[0]
    models, shipped = load_models(tmp_path / "partition.safetensors"), load_models()
    assert len(models.crops.heads) == 1
    np.testing.assert_array_equal(models.proposals.value, shipped.proposals.value)
    assert {"shapes, things", "train, things"} <= set(json.loads((tmp_path / "figures.json").read_text()))


def test_trees_of_duplicates_learn_and_are_written_beside_what_ships(data, tmp_path):
    arguments = [str(data), "--out", str(tmp_path), "--cache", str(data / "cache"), "--rounds", "60"]
    assert duplicates.main(arguments) == 0
    models, shipped = load_models(tmp_path / "partition.safetensors"), load_models()
    assert len(models.duplicates.first_leaf) == duplicates._SEEDS * 60
    np.testing.assert_array_equal(models.proposals.value, shipped.proposals.value)
    assert set(models.crops.weights) == set(shipped.crops.weights)
    assert {"train, alone", "shapes, counted once"} <= set(
        json.loads((tmp_path / "figures.json").read_text())
    )
    rooms = open_rooms(data / "train", NEEDED)
    found = duplicates.shipped_proposals(rooms, data / "cache", None, 1)
    for room in duplicates.pairs_of(rooms, found, data / "cache", 1):
        said, true = expit(models.duplicates(room.pairs.rows)), room.truth()
        assert ((said - true) ** 2).mean() < 0.95 * true.var()
