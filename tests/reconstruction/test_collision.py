"""Collision shapes of hollow objects and furniture: dropped marbles stay and rest on the true floor."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from notes import Notes
from scipy.spatial import cKDTree

from reconstruction.assets.collision import build, collision_parts, kept_parts, part_cache
from reconstruction.assets.collision.decomposition import Decomposer
from reconstruction.assets.collision.primitives import BOUND_M, fitted_primitive
from reconstruction.assets.collision.rings import find_hole
from reconstruction.assets.collision.slicing import own_levels
from reconstruction.assets.config import LEAST_HULLS, AssetsConfig
from reconstruction.assets.solid import Solid, box_solid, from_manifold
from reconstruction.core.progress import NO_PROGRESS
from registry.errors import EnvironmentMissing
from registry.primitives import primitive_of
from registry.simulation import BodySpec, Physics
from synthetic import containers, furnishing
from synthetic.furniture import Workshop
from synthetic.things import Place, Thing

pytestmark = pytest.mark.stage

manifold3d = pytest.importorskip("manifold3d")
MARBLE_M = 0.005  # radius
DROPPED_FROM_M = 0.02
MAKERS = {
    name: getattr(containers, f"make_{name}")
    for name in ("bowl", "mug", "cup", "plate", "tray", "open_box", "basket", "crate")
} | {"bookcase": furnishing.make_bookcase}


def made(name: str, seed: int) -> tuple[Thing, Solid]:
    """Return a thing of the generator and its closed mesh."""
    thing = MAKERS[name](Workshop(np.random.default_rng(seed), 0.01, 0.02), name)
    bodies = []
    for part in thing.parts:
        vertices = np.concatenate([patch.vertices for patch in part])
        starts = np.cumsum([0] + [len(patch.vertices) for patch in part])
        faces = np.concatenate([np.asarray(patch.faces) + start for patch, start in zip(part, starts)])
        _, index, inverse = np.unique(vertices.round(6), axis=0, return_index=True, return_inverse=True)
        faces = inverse.reshape(-1)[faces]
        faces = faces[
            (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        ]
        mesh = manifold3d.Mesh(vertices[index].astype(np.float32), faces.astype(np.uint32))
        bodies.append(manifold3d.Manifold(mesh))
    return thing, from_manifold(manifold3d.Manifold.batch_boolean(bodies, manifold3d.OpType.Add))


def floors_of(thing: Thing) -> list[Place]:
    """Return where marbles are dropped: the places in it, or the floor of a cup, which has none."""
    if thing.places:
        return list(thing.places)
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    disc = 0.28 * min(thing.size[:2]) * np.stack([np.cos(turn), np.sin(turn)], -1)
    return [Place(0.006, disc, inside=True, rim_m=thing.size[2] - 0.006)]


def drop_marbles(parts: list[np.ndarray], floors: list[Place]) -> list[tuple[np.ndarray, Place]]:
    """Drop a row of marbles onto every floor; return where each is after two seconds."""
    trimesh = pytest.importorskip("trimesh")
    ball = np.asarray(trimesh.creation.icosphere(subdivisions=2, radius=MARBLE_M).vertices)
    ground = np.array([[x, y, z] for x in (-3, 3) for y in (-3, 3) for z in (-0.05, 0.0)])
    physics = Physics(1 / 240, 0.0)
    for number, shape in ((1, parts), (2, [ground])):
        still = BodySpec(
            number, "still", tuple(shape), 1.0, np.zeros(3), None, 0.5, 0.0, np.eye(4), False, base=True
        )
        physics.add(still)
    dropped = []
    for floor in floors:
        center = floor.area.mean(axis=0)
        for corner in (*floor.area[:: max(1, len(floor.area) // 6)], center):
            pose = np.eye(4)
            pose[:2, 3] = center + 0.7 * (corner - center)
            pose[2, 3] = floor.height_m + MARBLE_M + min(DROPPED_FROM_M, 0.3 * floor.headroom_m)
            number = 10 + len(dropped)
            physics.add(BodySpec(number, "marble", (ball,), 0.0014, np.zeros(3), None, 0.4, 0.1, pose, True))
            dropped.append((number, floor))
    physics.step(480)
    return [(physics.pose(number)[:3, 3], floor) for number, floor in dropped]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", MAKERS)
def test_marbles_stay_and_rest_on_the_true_floor(name, seed):
    thing, solid = made(name, seed)
    parts = collision_parts(solid, AssetsConfig())
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    every = np.concatenate([part.vertices for part in parts])
    np.testing.assert_allclose(every.min(axis=0), low, atol=0.003)
    np.testing.assert_allclose(every.max(axis=0), high, atol=0.003)
    for at, floor in drop_marbles([part.vertices for part in parts], floors_of(thing)):
        assert (at[:2] > low[:2]).all()
        assert (at[:2] < high[:2]).all()
        assert at[2] - MARBLE_M == pytest.approx(floor.height_m, abs=0.001)


def test_a_table_is_its_slab_and_its_legs():
    legs = [
        box_solid(np.array([x, y, 0]), np.array([x + 0.05, y + 0.05, 0.7]))
        for x in (0, 1.15)
        for y in (0, 0.75)
    ]
    top = box_solid(np.array([0, 0, 0.7]), np.array([1.2, 0.8, 0.74]))
    bodies = [
        manifold3d.Manifold(manifold3d.Mesh(s.vertices.astype(np.float32), s.faces.astype(np.uint32)))
        for s in (*legs, top)
    ]
    solid = from_manifold(manifold3d.Manifold.batch_boolean(bodies, manifold3d.OpType.Add))
    assert own_levels(solid) == pytest.approx([0.7], abs=0.001)
    parts = collision_parts(solid, AssetsConfig())
    assert len(parts) == 5
    hulls = [Solid(part.vertices.astype(float), part.faces).volume for part in parts]
    assert sum(hulls) == pytest.approx(solid.volume, rel=0.01)


def test_a_ring_is_distinguished_from_a_cup_and_a_slab():
    tube = manifold3d.Manifold.cylinder(0.1, 0.05, 0.05, 48) - manifold3d.Manifold.cylinder(
        0.3, 0.04, 0.04, 48
    ).translate((0, 0, -0.1))
    hole = find_hole(from_manifold(tube))
    assert hole is not None
    np.testing.assert_allclose(hole.center, 0, atol=0.003)
    cup = tube + manifold3d.Manifold.cylinder(0.02, 0.045, 0.045, 48)
    for solid in (from_manifold(cup), box_solid(np.zeros(3), np.ones(3))):
        assert find_hole(solid) is None


OPTIONS = {"threshold": 0.1, "budget": 4, "hull_vertices": 48, "seed": 0}


@pytest.fixture
def decomposer():
    made = Decomposer()
    yield made
    made.close()


def test_a_crash_of_the_decomposer_affects_one_part(decomposer):
    solid = box_solid(np.zeros(3), np.ones(3))
    assert decomposer.run(solid.vertices, solid.faces + 1_000_000, OPTIONS) is None
    assert len(decomposer.run(solid.vertices, solid.faces, OPTIONS)) == 1


def test_a_hanging_decomposer_is_killed(decomposer):
    solid = box_solid(np.zeros(3), np.ones(3))
    decomposer.run(solid.vertices, solid.faces, OPTIONS)
    decomposer._limit_s = 0.3
    os.kill(decomposer._child.pid, signal.SIGSTOP)  # it hangs
    assert decomposer.run(solid.vertices, solid.faces, OPTIONS) is None
    decomposer._limit_s = 60
    assert len(decomposer.run(solid.vertices, solid.faces, OPTIONS)) == 1


def test_the_decomposer_starts_where_nothing_is_installed_but_coacd(decomposer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", "")
    (tmp_path / "coacd.py").write_text("raise ImportError('not this one')")
    solid = box_solid(np.zeros(3), np.ones(3))
    assert len(decomposer.run(solid.vertices, solid.faces, OPTIONS)) == 1


def test_missing_coacd_is_an_error(tmp_path, monkeypatch):
    (tmp_path / "coacd.py").write_text("raise ImportError('libgomp.so.1 is not there')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    solid = box_solid(np.zeros(3), np.ones(3))
    with pytest.raises(EnvironmentMissing, match=r"libgomp.so.1 is not there.*pip install coacd"):
        Decomposer().run(solid.vertices, solid.faces, OPTIONS)
    for python, why in ((str(tmp_path / "python"), "No such file"), ("/bin/false", "status 1")):
        with pytest.raises(EnvironmentMissing, match=why):
            Decomposer(python=python).run(solid.vertices, solid.faces, OPTIONS)


def test_parts_are_cached_by_mesh_and_options(tmp_path, monkeypatch):
    _, bowl = made("bowl", 0)
    config, make = AssetsConfig(), {"levels": (), "progress": NO_PROGRESS, "name": "bowl"}
    first = kept_parts(tmp_path, bowl, config, **make)
    (file,) = tmp_path.glob("*.npz")
    for part, fresh in zip(first, collision_parts(bowl, config), strict=True):
        np.testing.assert_array_equal(part.vertices, fresh.vertices)
    monkeypatch.setattr(part_cache, "collision_parts", None)  # nothing is computed again
    for now, before in zip(
        kept_parts(tmp_path, bowl, replace(config, texture_min_px=64), **make), first, strict=True
    ):
        np.testing.assert_array_equal(now.vertices, before.vertices)
        np.testing.assert_array_equal(now.faces, before.faces)
    monkeypatch.undo()
    kept_parts(tmp_path, bowl, replace(config, hulls_ring=8), **make)
    kept_parts(tmp_path, Solid(1.1 * bowl.vertices, bowl.faces), config, **make)
    assert len(list(tmp_path.glob("*.npz"))) == 3
    file.write_bytes(b"PK torn")
    assert len(kept_parts(tmp_path, bowl, config, **make)) == len(first)


def test_failures_are_not_cached(tmp_path, monkeypatch):
    _, bookcase = made("bookcase", 0)
    monkeypatch.setattr(build, "decompose", lambda *arguments: None)
    monkeypatch.setattr(build, "_sorted_out", lambda pieces, *arguments: ([], pieces))
    said = Notes()
    assert kept_parts(tmp_path, bookcase, AssetsConfig(), levels=(), progress=said, name="bookcase")
    assert "CoACD failed" in said.notes[0]
    assert not list(tmp_path.glob("*.npz"))


def test_the_least_recently_used_parts_are_deleted(tmp_path, monkeypatch):
    monkeypatch.setattr(part_cache, "_MOST_KEPT", 2)
    make = {"levels": (), "progress": NO_PROGRESS, "name": "box"}
    boxes = [box_solid(np.zeros(3), np.full(3, size)) for size in (1.0, 1.1, 1.2)]
    names = []
    for number, solid in enumerate(boxes):
        if number == 2:
            for age, name in enumerate(reversed(names)):  # the first was used again
                os.utime(name, (1e9 + age, 1e9 + age))
        kept_parts(tmp_path, solid, AssetsConfig(), **make)
        names += [file for file in tmp_path.glob("*.npz") if file not in names]
    assert not names[1].exists()
    assert names[0].exists()
    assert len(list(tmp_path.glob("*.npz"))) == 2


def test_a_full_scene_leaves_an_object_fewer_parts_but_some():
    config = AssetsConfig()
    assert config.with_hulls(500) == config
    assert config.with_hulls(10).hulls_ring == 10
    assert config.with_hulls(-3).hulls_small == LEAST_HULLS
    _, bowl = made("bowl", 0)
    assert len(collision_parts(bowl, config.with_hulls(10))) < len(collision_parts(bowl, config))


def _turned(mesh, noise_m=0.0, lying=False):
    """Return a solid of a mesh, at a heading, standing at z = 0, with noise on its vertices."""
    trimesh = pytest.importorskip("trimesh")
    mesh = mesh.copy()
    if lying:
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [0, 0, 1]))
    noise = np.random.default_rng(5).uniform(-noise_m, noise_m, mesh.vertices.shape)
    vertices = np.asarray(mesh.vertices) + noise + [0.03, -0.02, 0.0]
    vertices[:, 2] -= vertices[:, 2].min()
    return Solid(vertices, np.asarray(mesh.faces, np.int32))


def _fine_box(size):
    trimesh = pytest.importorskip("trimesh")
    return trimesh.creation.box(size).subdivide().subdivide().subdivide()


def _primitive_meshes():
    creation = pytest.importorskip("trimesh").creation
    can = creation.cylinder(0.035, 0.11, sections=48)
    return {
        "box": (_fine_box((0.2, 0.12, 0.07)), False, "box", (0.1, 0.06, 0.035)),
        "can": (can, False, "cylinder", (0.035, 0.055)),
        "lying can": (can, True, "cylinder", (0.035, 0.055)),
        "ball": (creation.icosphere(3, 0.04), False, "sphere", (0.04,)),
        "sausage": (creation.capsule(0.1, 0.03, [24, 24]), True, "capsule", (0.03, 0.05)),
    }


@pytest.mark.parametrize("noise_m", [0.0, 0.0008])
@pytest.mark.parametrize("name", ["box", "can", "lying can", "ball", "sausage"])
def test_a_solid_that_fits_a_primitive_collides_as_it(name, noise_m):
    trimesh = pytest.importorskip("trimesh")
    mesh, lying, shape, size = _primitive_meshes()[name]
    solid = _turned(mesh, noise_m, lying)
    (part,) = collision_parts(solid, AssetsConfig())
    primitive = primitive_of(part.vertices)
    assert primitive.shape == shape
    np.testing.assert_allclose(sorted(primitive.size), sorted(size), atol=1e-3)
    assert part.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-3)
    # Both ways, by another road: dense points of either surface beside the other one.
    own = trimesh.Trimesh(part.vertices, part.faces)
    seen = trimesh.Trimesh(solid.vertices, solid.faces)
    one, other = (trimesh.sample.sample_surface(m, 60_000, seed=1)[0] for m in (own, seen))
    gaps = [cKDTree(a).query(b)[0].max() for a, b in ((one, other), (other, one))]
    assert max(gaps) < BOUND_M + 0.0015  # the points lie up to that far apart


def test_other_solids_are_no_primitives():
    trimesh = pytest.importorskip("trimesh")
    egg = trimesh.creation.icosphere(3, 0.04).apply_scale((1.0, 1.0, 1.3))
    others = [egg, trimesh.creation.cone(0.05, 0.1), trimesh.creation.cylinder(0.05, 0.1, sections=6)]
    rough = (_fine_box((0.2, 0.12, 0.07)), 0.004)
    for mesh, noise_m in (*((mesh, 0.0) for mesh in others), rough):
        assert fitted_primitive(_turned(mesh, noise_m)) is None
    for name in ("mug", "open_box", "tray"):
        assert fitted_primitive(made(name, 0)[1]) is None


def test_a_primitive_ends_at_contact_levels():
    solid = _turned(_fine_box((0.2, 0.12, 0.07)))
    assert fitted_primitive(solid, (0.069,)) is not None
    assert fitted_primitive(solid, (0.06,)) is None
