"""The structure: its surface, its plates, what stands on it, and its place in graph, assembly and bundle."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box, floor, wall
from scipy.spatial import ConvexHull, cKDTree
from surfaces import Patchwork, floor_sheet, merged, sheet, solid_box, surface_from

from reconstruction.assembly import AssemblyConfig, assemble
from reconstruction.assembly.structure import clear_structure
from reconstruction.assets.collision.plates import PLATE_M, plate_parts
from reconstruction.assets.config import AssetsConfig
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import AssetSet, InstanceSet, StructureAsset
from reconstruction.editing.addresses import parse_address
from reconstruction.editing.anchors import Pointer
from reconstruction.instances.cut import Cut, Shell, Thing
from reconstruction.instances.describe import describe
from reconstruction.instances.structure import find_structure
from reconstruction.scene_graph import SceneGraphConfig, infer_scene_graph
from registry.errors import UsageError

GRAY, RED, WHITE = (200, 200, 190), (160, 20, 20), (240, 240, 235)
FLOOR = floor_sheet(GRAY)
# A counter without a box of its own: its top and its front.
COUNTER = merged(
    sheet((-0.5, 0.3, 0.9), (1.0, 0, 0), (0, 0.6, 0), RED),
    sheet((-0.5, 0.3, 0.06), (1.0, 0, 0), (0, 0, 0.84), RED),
)
CUP = solid_box((0.0, 0.5, 0.9), (0.08, 0.58, 1.0), WHITE)
TABLE = solid_box((-0.5, -0.9, 0.0), (0.1, -0.5, 0.4), (120, 80, 50))


def cut_of(*parts: Patchwork, things: tuple[Patchwork, ...]) -> tuple[Shell, Cut]:
    shell = Shell.of(surface_from(merged(FLOOR, *parts, *things)), NO_PROGRESS)
    tree = cKDTree(shell.graph.points)
    owned = [Thing(np.unique(tree.query(part.vertices)[1])) for part in things]
    return shell, Cut(owned, shell.owner.copy())


def seen(shell: Shell) -> np.ndarray:
    """Ten views of every vertex."""
    return np.full(len(shell.graph.points), 10.0)


def test_surface_of_no_object_is_structure_and_carries_what_stands_on_it():
    shell, cut = cut_of(COUNTER, things=(CUP, TABLE))
    structure = find_structure(shell, cut, seen(shell), 0.02)
    assert structure is not None
    found = shell.graph.points[structure.vertices]
    assert cKDTree(COUNTER.vertices).query(found)[0].max() < 1e-6
    assert shell.graph.areas[structure.vertices].sum() > 0.95 * (0.6 + 0.84)
    cup, table = cut.things
    assert cup.rests_on is structure
    assert not cup.attached
    assert table.rests_on is None
    ids = cut.owner.copy()
    objects = {item.id: item for item in describe(shell.graph, cut.things, shell.base, ids, structure)}
    number = int(ids[structure.vertices[0]])
    assert number == max(objects) + 1
    cups = objects[int(ids[cup.vertices[-1]])]
    assert cups.support_hint == number
    # Its box ends on the counter. Without the structure it would reach down to the floor.
    assert cups.center[2] - 0.5 * cups.extents_m[2] == pytest.approx(0.9, abs=0.015)


def test_a_bed_beside_a_ledge_of_its_height_does_not_stand_on_it():
    bed = sheet((-0.9, -0.9, 0.36), (1.6, 0, 0), (0, 0.8, 0), WHITE)  # its sides were not measured
    ledge = sheet((0.72, -0.9, 0.36), (0.12, 0, 0), (0, 0.25, 0), RED)
    shell, cut = cut_of(ledge, COUNTER, things=(bed,))
    assert find_structure(shell, cut, seen(shell), 0.02) is not None
    assert cut.things[0].rests_on is None


def test_rims_around_objects_and_crumbs_are_no_structure():
    rim = sheet((0.1, -0.9, 0.4), (0.03, 0, 0), (0, 0.4, 0), (120, 80, 50))  # beside the table's top
    crumb = sheet((0.6, 0.6, 0.5), (0.12, 0, 0), (0, 0.12, 0), RED)
    strip = sheet((0.6, -0.9, 0.4), (0.05, 0, 0), (0, 0.6, 0), RED)
    shell, cut = cut_of(rim, crumb, strip, things=(TABLE,))
    assert find_structure(shell, cut, seen(shell), 0.02) is None
    assert find_structure(shell, cut, seen(shell), 0.005) is not None


def test_surface_near_the_floor_and_on_walls_is_of_those():
    rug = sheet((0.3, -0.6, 0.03), (0.5, 0, 0), (0, 0.5, 0), RED)
    shell, cut = cut_of(rug, things=(TABLE,))
    assert find_structure(shell, cut, seen(shell), 0.02) is None


@pytest.mark.parametrize("why", ["artifact", "few views", "in the box of an object"])
def test_surface_that_is_doubtful_or_of_an_object_is_no_structure(why):
    inside = sheet((-0.4, -0.85, 0.2), (0.3, 0, 0), (0, 0.3, 0), RED)
    outside = sheet((0.4, 0.2, 0.2), (0.3, 0, 0), (0, 0.3, 0), RED)
    shell, cut = cut_of(inside if why == "in the box of an object" else outside, things=(TABLE,))
    views = seen(shell) - (5 if why == "few views" else 0)
    if why == "artifact":
        cut = replace(cut, artifact=np.ones(len(views), bool))
    assert find_structure(shell, cut, views, 0.02) is None
    shell, cut = cut_of(outside, things=(TABLE,))
    assert find_structure(shell, cut, seen(shell), 0.02) is not None


def distances(points: np.ndarray, plates) -> np.ndarray:
    """How far points (n, 3) are outside of the nearest plate."""
    equations = [ConvexHull(np.asarray(p.vertices, float)).equations for p in plates]
    return np.min([(points @ e[:, :3].T + e[:, 3]).max(axis=1) for e in equations], axis=0)


@pytest.fixture(scope="module")
def plates():
    return plate_parts(COUNTER.vertices, COUNTER.faces, AssetsConfig())


def test_plates_cover_the_surface_and_nothing_else(plates):
    assert distances(COUNTER.vertices, plates).max() < 0.005
    corners = np.concatenate([p.vertices for p in plates])
    assert cKDTree(COUNTER.vertices).query(corners)[0].max() < PLATE_M + 0.005
    # The space below the counter and the air above it stay free.
    inside = np.array(
        [[x, y, z] for x in (-0.4, 0, 0.4) for y in (0.4, 0.6, 0.8) for z in (0.2, 0.5, 0.8, 0.93)]
    )
    assert distances(inside, plates).min() > 0.01


def test_planes_become_few_plates_and_their_number_is_bounded(plates):
    assert len(plates) <= 12
    few = plate_parts(COUNTER.vertices, COUNTER.faces, replace(AssetsConfig(), hulls_structure=1))
    assert len(few) == 1
    assert all(len(p.vertices) <= AssetsConfig().hull_vertices for p in plates)


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_a_centimeter_keeps_plates_on_the_surface(seed):
    moved = COUNTER.vertices + np.random.default_rng(seed).normal(0, 0.003, COUNTER.vertices.shape)
    found = plate_parts(moved, COUNTER.faces, AssetsConfig())
    assert np.percentile(distances(COUNTER.vertices, found), 98) < 0.01
    corners = np.concatenate([p.vertices for p in found])
    assert cKDTree(COUNTER.vertices).query(corners)[0].max() < PLATE_M + 0.02


def furnished(plates, *objects) -> AssetSet:
    structure = StructureAsset(99, mesh_of_surface(COUNTER), plates, 1.0)
    return AssetSet((floor(), wall()), objects, None, structure)


def mesh_of_surface(part: Patchwork):
    return replace(
        box_mesh(), vertices=part.vertices.astype(np.float32),
        faces=part.faces.astype(np.int32), uvs=np.zeros((len(part.vertices), 2), np.float32),
    )  # fmt: skip


def box_mesh():
    return box(1, (0.1, 0.1, 0.1), (0, 0, 0)).visual


@pytest.mark.stage
def test_an_object_on_the_structure_has_it_as_parent_moves_and_rests(plates):
    # The wall is 30 cm behind. One cup hovers and one is sunk in, both by a centimeter.
    assets = furnished(
        plates, box(10, (0.08, 0.08, 0.1), (0.2, 0.6, 0.91)), box(11, (0.08, 0.08, 0.1), (-0.2, 0.6, 0.89))
    )
    graph = infer_scene_graph(assets, SceneGraphConfig())
    assert {e.child: (e.relation, e.parent) for e in graph.edges} == {
        10: ("supported_by", 99), 11: ("supported_by", 99),
    }  # fmt: skip
    scene = assemble(assets, graph, AssemblyConfig())
    assert scene.physics_report["stable_rate"] == 1.0
    assert scene.physics_report["floating_rate"] == 0.0
    assert scene.physics_report["spawn_penetration_mm"] <= 1.0
    for item in scene.placed:
        assert item.dynamic
        assert item.world_from_object[2, 3] == pytest.approx(0.9, abs=0.006)


@pytest.mark.stage
def test_plates_give_way_to_what_reaches_into_them_from_the_side(plates):
    # A crate on the floor reaches 2 cm into the counter's front.
    assets = furnished(plates, box(10, (0.3, 0.3, 0.3), (0.0, 0.17, 0.0)))
    scene = assemble(assets, infer_scene_graph(assets, SceneGraphConfig()), AssemblyConfig())
    assert scene.physics_report["spawn_penetration_mm"] <= 1.0
    assert scene.placed[0].moved_m < 0.01
    kept = np.concatenate([p.vertices for p in scene.structure])
    assert kept[:, 2].max() == pytest.approx(0.9, abs=0.005)
    assert distances(np.array([[0.0, 0.3, 0.15]]), scene.structure)[0] > 0.0


def test_a_click_on_the_structure_means_it_and_is_no_thing():
    shell, cut = cut_of(COUNTER, things=(CUP,))
    structure = find_structure(shell, cut, seen(shell), 0.02)
    ids = cut.owner.copy()
    objects = describe(shell.graph, cut.things, shell.base, ids, structure)
    number = int(ids[structure.vertices[0]])
    found = InstanceSet(ids, shell.base, objects, np.zeros((0, 1, 1), np.uint16), number)
    assert found.last_id == number
    pointer = Pointer(found, surface_from(merged(FLOOR, COUNTER, CUP)))
    address = parse_address({"at": [0.4, 0.5, 0.9]}, "parent")
    assert pointer.entity(address).id == number
    with pytest.raises(UsageError, match=r"the structure \(\d+\)"):
        pointer.thing(address)


@pytest.mark.stage
@pytest.mark.parametrize("sunk_m", [0.03, 0.08])
def test_an_object_that_is_sunk_into_a_plate_is_lifted_or_cut_clear(plates, sunk_m):
    assets = furnished(plates, box(10, (0.12, 0.12, 0.2), (0.1, 0.6, 0.9 - sunk_m)))
    scene = assemble(assets, infer_scene_graph(assets, SceneGraphConfig()), AssemblyConfig())
    assert scene.physics_report["spawn_penetration_mm"] <= 1.0
    assert scene.physics_report["stable_rate"] == 1.0
    top = scene.placed[0].world_from_object[2, 3] + 0.2
    assert 1.1 - sunk_m - 0.005 <= top <= 1.1 + 0.005


def test_plates_never_vanish_altogether(plates):
    assets = furnished(plates[:1], box(10, (1.2, 0.3, 1.0), (0.0, 0.3, 0.0)))
    kept = clear_structure(assets, AssemblyConfig()).structure
    assert kept is not None
    assert len(kept.collision) == 1
