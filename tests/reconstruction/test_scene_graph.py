"""Relations of analytic scenes by geometry, and regions."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box, floor, room, tilt, tray, wall

from reconstruction.core.types import AssetSet
from reconstruction.scene_graph import SCENE_GRAPH_PRESETS, SceneGraphConfig, infer_scene_graph
from reconstruction.scene_graph.regions import dbscan, find_regions
from registry.errors import InputError


def relations(assets: AssetSet, **options) -> dict[int, tuple[str, int]]:
    graph = infer_scene_graph(assets, SceneGraphConfig(**options))
    assert len({e.child for e in graph.edges}) == len(graph.edges)
    return {e.child: (e.relation, e.parent) for e in graph.edges}


def furnished() -> AssetSet:
    return room(
        box(10, (1.0, 0.6, 0.4), (0, 0, 0), label="table"),
        box(11, (0.3, 0.2, 0.05), (0.2, 0, 0.4), label="book"),
        box(12, (0.08, 0.08, 0.1), (0.2, 0.03, 0.45), label="mug"),
        tray(13, (-0.25, 0, 0.4)),
        box(14, (0.07, 0.07, 0.1), (-0.3, 0.02, 0.412), label="can"),
        box(15, (0.5, 0.02, 0.4), (0, 0.99, 1.2), label="picture"),
        box(16, (0.3, 0.3, 0.3), (1.2, 0.3, 0), label="box"),
    )


TRUTH = {
    10: ("supported_by", 1),
    11: ("supported_by", 10),
    12: ("supported_by", 11),
    13: ("supported_by", 10),
    14: ("supported_by", 13),
    15: ("attached_to", 2),
    16: ("supported_by", 1),
}


@pytest.mark.parametrize("merging", ["online", "global", "naive"])
def test_furnished_room(merging):
    assert relations(furnished(), merging=merging) == TRUTH


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_a_centimeter_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    moved = []
    for item in furnished().objects:
        pose = item.world_from_object.copy()
        pose[:3, 3] += rng.uniform(-0.008, 0.008, 3)
        pose[:3, :3] = pose[:3, :3] @ tilt(rng.uniform(-0.8, 0.8))
        moved.append(replace(item, world_from_object=pose))
    assert relations(room(*moved)) == TRUTH


def test_ids_and_order_of_objects_do_not_matter():
    objects = furnished().objects
    assert relations(room(*reversed(objects))) == TRUTH


def test_thing_in_the_air_is_bridged_and_says_so():
    graph = infer_scene_graph(room(box(10, (0.2, 0.2, 0.2), (0, 0, 0.1))), SceneGraphConfig())
    (edge,) = graph.edges
    assert (edge.relation, edge.parent) == ("supported_by", 1)
    assert edge.confidence < 0.5
    assert "10 cm below" in edge.evidence


def test_deeply_sunk_box_still_finds_its_table():
    assets = room(box(10, (1, 1, 0.4), (0, 0, 0)), box(11, (0.1, 0.1, 0.12), (0, 0, 0.36)))
    assert relations(assets)[11] == ("supported_by", 10)


def test_support_hint_decides_between_two_equal_carriers():
    left, right = box(10, (0.2, 0.2, 0.3), (-0.1, 0, 0)), box(11, (0.2, 0.2, 0.3), (0.1, 0, 0))
    for hint in (10, 11):
        plank = box(12, (0.4, 0.1, 0.02), (0, 0, 0.3), hint=hint)
        assert relations(room(left, right, plank))[12] == ("supported_by", hint)


def test_no_floor_is_an_input_error():
    with pytest.raises(InputError, match="floor"):
        infer_scene_graph(AssetSet((wall(),), (box(5, (0.1, 0.1, 0.1), (0, 0, 0)),)), SceneGraphConfig())


def test_empty_room_has_an_empty_graph():
    assert infer_scene_graph(AssetSet((floor(),), ()), SCENE_GRAPH_PRESETS["fast"]).edges == ()


def test_dbscan_finds_clusters_and_strays():
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.normal(0, 0.05, (20, 2)), rng.normal(3, 0.05, (20, 2)), [[10.0, 10.0]]])
    labels = dbscan(points, 0.3, 3)
    assert len(set(labels[:20])) == 1
    assert len(set(labels[20:40])) == 1
    assert labels[0] != labels[20]
    assert labels[40] == -1


def test_regions_partition_objects_and_views_contain_them():
    places = (0, 0.2, 0.4, 3, 3.2, 3.4, 5.5)
    objects = [box(i, (0.1, 0.1, 0.1), (x, 0, 0)) for i, x in zip(range(5, 12), places)]
    regions = find_regions(objects, 0.5, 2, 0.25)
    members = [i for inside, _ in regions for i in inside]
    assert sorted(members) == list(range(5, 12))
    assert len(regions) == 2
    assert all(set(inside) <= set(seen) for inside, seen in regions)
    assert next(r for r in regions if 11 in r[0])[0] == (8, 9, 10, 11)
