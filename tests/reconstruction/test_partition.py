"""The learned cut: multicut against brute force, the graph and its features on known solids, and the cut itself."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from fused_surfaces import box, fused
from surfaces import floor_sheet, frames_of, merged, sheet, surface_from, with_planes

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.depth.channels import AFFINITIES, OFFSETS_PX
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.cut import Shell
from reconstruction.instances.partition import multicut as solver
from reconstruction.instances.partition.base_parts import with_parts_of_base
from reconstruction.instances.partition.features import (
    EDGE_FEATURES,
    NODE_FEATURES,
    Shapes,
    Together,
    View,
    edge_features,
    node_features,
)
from reconstruction.instances.partition.graph import LABELS, graph_of_links, region_graph
from reconstruction.instances.partition.model import load_models
from reconstruction.instances.sightings import sightings
from registry.errors import EnvironmentMissing

pytestmark = pytest.mark.stage

TABLE = box((-0.3, -0.3, 0.0), (0.3, 0.3, 0.3), (120, 80, 50))
TOY = box((-0.05, -0.05, 0.3), (0.07, 0.05, 0.42), (200, 30, 30))


def all_partitions(count):
    """Every partition of a few nodes, as labels."""
    found = [[0]]
    for _ in range(count - 1):
        found = [[*labels, k] for labels in found for k in range(max(labels) + 2)]
    return np.array(found)


def best_energy(pairs, weights, partitions):
    """Energy of the best partition of a few nodes, by trying all."""
    return max(solver.energy(pairs, weights, labels) for labels in partitions)


def random_graph(rng, count):
    pairs = np.array([e for e in itertools.combinations(range(count), 2) if rng.random() < 0.6]).reshape(
        -1, 2
    )
    return pairs, rng.normal(size=len(pairs))


def test_multicut_is_nearly_as_good_as_trying_all_partitions():
    rng, partitions = np.random.default_rng(0), all_partitions(6)
    assert len(partitions) == 203  # Bell number
    found, best = [], []
    for _ in range(25):
        pairs, weights = random_graph(rng, 6)
        found.append(solver.energy(pairs, weights, solver.multicut(6, pairs, weights)))
        best.append(best_energy(pairs, weights, partitions))
    found, best = np.array(found), np.array(best)
    assert (found <= best + 1e-9).all()
    assert (found > best - 1e-9).mean() > 0.8
    assert found.sum() > 0.97 * best.sum()


def test_multicut_does_not_depend_on_the_order_or_direction_of_edges():
    rng = np.random.default_rng(1)
    pairs, weights = random_graph(rng, 60)
    whole = solver.multicut(60, pairs, weights)
    order = rng.permutation(len(pairs))
    np.testing.assert_array_equal(whole, solver.multicut(60, pairs[order][:, ::-1], weights[order]))
    assert 1 < whole.max() < 59


def test_moves_and_joins_never_lose_against_contraction_alone():
    rng = np.random.default_rng(2)
    gains = []
    for _ in range(10):
        pairs, weights = random_graph(rng, 40)
        alone = solver.contract_edges(40, pairs, weights)
        gains.append(
            solver.energy(pairs, weights, solver.multicut(40, pairs, weights))
            - solver.energy(pairs, weights, alone)
        )
    assert min(gains) > -1e-9
    assert max(gains) > 0


def test_labels_follow_the_unaries_unless_neighbors_outweigh_them():
    pairs = np.array([[0, 1], [1, 2], [2, 3]])
    unary = np.log([[0.9, 0.1], [0.4, 0.6], [0.1, 0.9], [0.1, 0.9]])
    alone, _ = solver.partition_with_labels(pairs, np.zeros(3), unary)
    np.testing.assert_array_equal(alone, [0, 1, 1, 1])
    joined, cluster = solver.partition_with_labels(pairs, np.array([5.0, -5.0, 0.0]), unary)
    np.testing.assert_array_equal(joined, [0, 0, 1, 1])
    assert cluster[0] == cluster[1] != cluster[2]
    assert cluster[2] == cluster[3]  # one label has one cluster, whatever lies between


def test_what_affinities_part_from_a_plane_is_proposed_as_a_thing():
    base, thing = LABELS.index("base"), LABELS.index("thing")
    label = np.array(
        [base] * 6 + [thing] * 2, np.int32
    )  # four of a wall, two of a picture, two of a thing before it
    pairs = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5], [5, 6], [6, 7]])
    affinity = np.array([3.0, 3.0, 3.0, -2.0, 3.0, 5.0, 3.0])
    cluster = np.array([0, 0, 0, 0, 0, 0, 1, 1], np.int32)
    area = np.full(8, 0.1)
    out, parts = with_parts_of_base(pairs, affinity, area, label, cluster)
    np.testing.assert_array_equal(out, [base] * 4 + [thing] * 4)
    np.testing.assert_array_equal(parts[4:] == parts[4], [True, True, False, False])
    assert len(np.unique(parts)) == 3
    large, _ = with_parts_of_base(pairs, affinity, 30 * area, label, cluster)
    np.testing.assert_array_equal(large, label)


def room(*solids):
    surface = with_planes(fused(list(solids)))
    posed, depth = frames_of(surface)
    shell = Shell.of(surface, NO_PROGRESS)
    return surface, posed, depth, shell, View.of(shell.graph, surface, sightings(surface, posed, depth))


@pytest.fixture(scope="module")
def toy_room():
    return room(TABLE, TOY)


def measured(view):
    graph = region_graph(view.mesh)
    return node_features(view, graph, Shapes.of(view.mesh, graph), Together.of(view, graph))


def test_features_of_regions_do_not_grow_with_the_number_of_keyframes(toy_room):
    view = toy_room[-1]
    surface = replace(view.surface, weights=2 * np.asarray(view.surface.weights))
    longer = View.of(view.mesh, surface, [frame for frame in view.frames for _ in range(2)])
    np.testing.assert_allclose(measured(longer), measured(view), atol=1e-5)


def test_the_sheet_of_a_region_is_the_whole_flat_side_that_it_is_a_part_of(toy_room):
    view = toy_room[-1]
    nodes = measured(view)
    column = {name: nodes[:, k] for k, name in enumerate(NODE_FEATURES)}
    top = (column["normal_z"] > 0.95) & (np.abs(column["height"] - 0.3) < 0.02) & (column["log_area"] > -8)
    assert top.sum() > 20
    assert np.median(column["sheet_length"][top]) > 0.6  # the table's top, its regions are 6 cm
    assert np.median(column["sheet_top"][top]) == pytest.approx(0.3, abs=0.02)
    side = (np.abs(column["normal_z"]) < 0.1) & (column["height"] > 0.33) & (column["log_area"] > -8)
    assert side.sum() > 0
    assert np.median(column["sheet_foot"][side]) == pytest.approx(
        0.3, abs=0.03
    )  # of the toy, not of the table
    assert np.median(column["sheet_length"][side]) < 0.2
    assert (column["sheet_log_area"] >= column["log_area"] - 1e-4).all()


def test_a_shard_behind_a_wall_moves_no_region_into_the_room():
    wall = sheet((-1.2, 1.2, 0), (2.4, 0, 0), (0, 0, 1.5), (200, 200, 190))
    shard = sheet((-0.1, 3.0, 0.4), (0.1, 0, 0), (0, 0, 0.1), (90, 90, 90))
    distances = []
    for parts in ((wall,), (wall, shard)):
        surface = surface_from(merged(floor_sheet((150, 120, 90)), *parts))
        assert "wall" in {plane.label for plane in surface.planes}
        posed, depth = frames_of(surface)
        shell = Shell.of(surface, NO_PROGRESS)
        view = View.of(shell.graph, surface, sightings(surface, posed, depth))
        graph = region_graph(view.mesh)
        on_wall = Shapes.of(view.mesh, graph).center[:, 1] > 1.15
        distances.append(measured(view)[on_wall, NODE_FEATURES.index("to_side")].max())
    assert max(distances) < 0.05


def test_borders_are_concave_where_things_touch_and_convex_around_them(toy_room):
    view = toy_room[-1]
    graph = region_graph(view.mesh)
    shapes = Shapes.of(view.mesh, graph)
    features = edge_features(view, graph, shapes, Together.of(view, graph))
    concavity = features[:, EDGE_FEATURES.index("concavity")]
    angle = features[:, EDGE_FEATURES.index("angle")]
    middle = 0.5 * (shapes.center[graph.pairs[:, 0]] + shapes.center[graph.pairs[:, 1]])
    around_toy = (np.abs(middle[:, :2]) < 0.09).all(axis=1) & graph.touching
    tilt = np.abs(shapes.normal[graph.pairs[:, 0], 2] - shapes.normal[graph.pairs[:, 1], 2])
    foot = around_toy & (np.abs(middle[:, 2] - 0.31) < 0.02) & (tilt > 0.5)
    rim = around_toy & (np.abs(middle[:, 2] - 0.41) < 0.02) & (angle > 0.5)
    assert foot.sum() > 3
    assert rim.sum() > 3
    assert (concavity[foot] < 0).mean() > 0.8  # some pairs at the foot meet at an upright, convex edge
    assert (concavity[rim] > 0).mean() > 0.8


def test_features_of_borders_do_not_depend_on_which_side_comes_first(toy_room):
    view = toy_room[-1]
    graph = region_graph(view.mesh)
    region = (graph.count - 1 - graph.region).astype(np.int32)
    turned = graph_of_links(region, graph.links, graph.touching[graph.link_pair])
    first, second = (
        edge_features(view, g, Shapes.of(view.mesh, g), Together.of(view, g)) for g in (graph, turned)
    )
    numbers = graph.count - 1 - graph.pairs
    order = np.lexsort((numbers.max(axis=1), numbers.min(axis=1)))
    np.testing.assert_array_equal(np.sort(numbers[order], axis=1), turned.pairs)
    np.testing.assert_allclose(first[order], second, atol=1e-4)


def with_affinities(surface, posed, depth, thing):
    """Depth maps with the affinities of a perfect network: `thing` (v,) says what each vertex is of."""
    affinity = []
    for frame in sightings(surface, posed, depth):
        ids = np.where(frame.vertex >= 0, np.asarray(thing, int)[np.maximum(frame.vertex, 0)], -1)
        said = np.full((AFFINITIES, *ids.shape), 250, np.uint8)
        for scale, px in enumerate(OFFSETS_PX):
            step = max(px // 2, 1)
            said[2 * scale, :, :-step][ids[:, step:] != ids[:, :-step]] = 5
            said[2 * scale + 1, :-step][ids[step:] != ids[:-step]] = 5
        affinity.append(said)
    return replace(depth, affinity=np.stack(affinity))


def test_pixel_pairs_of_two_things_part_the_regions_that_show_there(toy_room):
    surface, _, _, shell, _ = toy_room
    posed, depth = frames_of(surface, 1280, 960)
    on_toy = surface.vertices[:, 2] > 0.31
    told = with_affinities(surface, posed, depth, on_toy)
    view = View.of(shell.graph, surface, sightings(surface, posed, told))
    graph = region_graph(view.mesh)
    together = Together.of(view, graph)
    share = np.bincount(graph.region, weights=on_toy) / np.bincount(graph.region)
    a, b = graph.pairs.T
    apart = np.abs(share[a] - share[b])
    seen = together.pixel_pairs > 8
    assert (seen & (apart > 0.9)).sum() > 3
    assert (together.across[seen & (apart > 0.9), 2] < -1).mean() > 0.9
    assert (together.across[seen & (apart == 0), 2] > 1).mean() > 0.9
    assert (together.inside[:, 2] >= 0).mean() > 0.9
    silent = Together.of(toy_room[-1], graph)  # maps without affinities say nothing
    assert not silent.across.any()
    assert not silent.inside.any()


@pytest.mark.parametrize(("gap_m", "joined"), [(0.02, True), (0.06, False)])
def test_regions_are_joined_across_small_gaps_only(gap_m, joined):
    boards = [box((-0.2, -0.2, 0.5), (-gap_m / 2, 0.2, 0.6), (90, 90, 90)),
              box((gap_m / 2, -0.2, 0.5), (0.2, 0.2, 0.6), (90, 90, 90))]  # fmt: skip
    mesh = room(*boards)[3].graph
    graph = region_graph(mesh)
    x = np.bincount(graph.region, weights=mesh.points[:, 0]) / np.bincount(graph.region)
    z = np.bincount(graph.region, weights=mesh.points[:, 2]) / np.bincount(graph.region)
    a, b = graph.pairs.T
    between = (x[a] * x[b] < 0) & (np.minimum(z[a], z[b]) > 0.4)
    assert between.any() == joined
    assert not graph.touching[between].any()


def test_scores_are_the_same_for_any_numbering_of_regions(toy_room):
    view, model = toy_room[-1], load_models().superpoints
    graph = region_graph(view.mesh)
    shapes = Shapes.of(view.mesh, graph)
    together = Together.of(view, graph)
    nodes = node_features(view, graph, shapes, together)
    edges = edge_features(view, graph, shapes, together)
    scores = model.scores(nodes, edges, graph.pairs)
    turned = model.scores(nodes[::-1], edges, graph.count - 1 - graph.pairs)
    np.testing.assert_allclose(turned.label[::-1], scores.label, atol=1e-3)
    np.testing.assert_allclose(turned.affinity, scores.affinity, atol=1e-3)
    np.testing.assert_allclose(np.exp(scores.label).sum(axis=1), 1.0, atol=1e-5)
    assert scores.label.shape == (graph.count, len(LABELS))


def test_a_toy_on_a_table_on_the_floor_is_two_things(toy_room):
    surface = toy_room[0]
    posed, depth = frames_of(surface, 640, 480)
    height = surface.vertices[:, 2]
    depth = with_affinities(surface, posed, depth, (height > 0.005).astype(int) + (height > 0.305))
    found = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    place = [int(np.argmin(np.linalg.norm(surface.vertices - p, axis=1))) for p in
             ((0.0, 0.0, 0.42), (0.2, 0.2, 0.3), (0.45, 0.45, 0.0))]  # fmt: skip
    toy, table, floor = found.vertex_instance[place]
    assert len({toy, table, floor}) == 3
    assert floor == found.base[0].id
    assert next(o for o in found.objects if o.id == toy).support_hint == table
    again = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    np.testing.assert_array_equal(found.vertex_instance, again.vertex_instance)


def test_unreadable_weights_say_what_to_do(tmp_path):
    (tmp_path / "w.safetensors").write_bytes(b"no weights")
    with pytest.raises(EnvironmentMissing, match="Install the package again"):
        load_models(tmp_path / "w.safetensors")
