"""Families of varied shapes: closed, outwards, standing, the same in the fine and the coarse version."""

import numpy as np
import pytest
import trimesh

from synthetic import footprints
from synthetic.furniture import Workshop
from synthetic.layout import KINDS
from synthetic.shape_families import SHAPE_FAMILIES, random_look
from synthetic.shapes import COARSE, signed_volume

pytestmark = pytest.mark.stage

_ALL = {key: kind for family in SHAPE_FAMILIES.values() for key, kind in family.items()}
_KEYS = list(_ALL)


def made(key, seed, step_m=COARSE, density=0.01):
    stream = [seed, _KEYS.index(key)]
    return _ALL[key].make(Workshop(np.random.default_rng(stream), step_m, density), f"{key}/")


def points_of(thing):
    return np.concatenate([patch.vertices for part in thing.parts for patch in part])


def open_parts(thing):
    """Return the numbers of parts that are not closed once corners are joined as `Entity.mesh` does."""
    patches = [(number, patch) for number, part in enumerate(thing.parts) for patch in part]
    counts = [len(p.vertices) for _, p in patches]
    offsets = np.cumsum([0, *counts[:-1]])
    vertices = np.concatenate([p.vertices for _, p in patches])
    owner = np.repeat([number for number, _ in patches], counts)
    faces = np.concatenate([p.faces + offset for (_, p), offset in zip(patches, offsets)])
    keys = np.column_stack([np.round(vertices * 1e7).astype(np.int64), owner])
    joined = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    faces, owner = joined[faces], owner[faces[:, 0]]
    whole = (faces != np.roll(faces, 1, axis=1)).all(1)
    corner = np.zeros((joined.max() + 1, 3))
    corner[joined] = vertices
    a, b, c = np.moveaxis(corner[faces], 1, 0)
    edges = np.linalg.norm([b - a, c - b, a - c], axis=-1).max(0)
    whole &= np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-8 * np.maximum(edges, 1e-12)
    faces, owner = faces[whole], owner[whole]
    ahead = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    code, back = ahead @ [len(corner), 1], ahead @ [1, len(corner)]
    single = ~np.isin(code, back)
    return set(np.repeat(owner, 3)[single].tolist())


def welded(solid):
    """Join the patches of a solid to a mesh."""
    offsets = np.cumsum([0] + [len(p.vertices) for p in solid[:-1]])
    vertices = np.concatenate([p.vertices for p in solid])
    faces = np.concatenate([p.faces + o for p, o in zip(solid, offsets)])
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=7)
    mesh.update_faces(mesh.nondegenerate_faces())
    return mesh


def test_keys_are_unique_and_new():
    assert len(_KEYS) == sum(len(family) for family in SHAPE_FAMILIES.values())
    assert all(len(family) >= 4 for family in SHAPE_FAMILIES.values())
    assert not {key for key in _KEYS if key in KINDS and KINDS[key] is not _ALL[key]}


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("key", _KEYS)
def test_things_are_closed_and_stand(key, seed):
    coarse, fine = made(key, seed), made(key, seed, 0.04, 0.05)
    points = points_of(coarse)
    low, high = points.min(0), points.max(0)
    for bound, other in ((low, points_of(fine).min(0)), (high, points_of(fine).max(0))):
        np.testing.assert_allclose(bound, other, atol=1e-6)
    np.testing.assert_allclose(high - low, coarse.size, atol=1e-6)
    assert abs(low[2]) < 1e-9
    assert 0.04 <= max(coarse.size) <= 0.47
    # It stands on an area, not on a point or an edge.
    foot = footprints.convex_hull(points[points[:, 2] < 1e-6, :2])  # as `Shape.of` finds it
    assert len(foot) >= 3
    assert footprints.area(foot) > 1e-5
    assert all(signed_volume(part) > 0 for part in (*coarse.parts, *fine.parts))
    assert not open_parts(coarse)
    for thing in (coarse, fine):
        patches = [patch for part in thing.parts for patch in part]
        assert {p.texture for p in patches} <= set(thing.textures)
        assert all(np.isfinite(p.normals).all() and np.isfinite(p.uvs_m).all() for p in patches)
        assert all(np.allclose(np.linalg.norm(p.normals, axis=1), 1, atol=1e-6) for p in patches)
    for place in coarse.places:
        assert footprints.area(place.area) > 0
        assert 0 <= place.height_m <= coarse.size[2] + 1e-9


@pytest.mark.parametrize("key", _KEYS[::7])
def test_parts_join_to_a_closed_surface(key):
    parts = [welded(part) for part in made(key, 5).parts]
    assert all(part.is_watertight for part in parts)
    mesh = parts[0] if len(parts) == 1 else trimesh.boolean.union(parts, engine="manifold")
    assert mesh.is_watertight
    assert 0 < mesh.volume <= 1.001 * sum(part.volume for part in parts)


@pytest.mark.parametrize("key", _KEYS[::5])
def test_the_same_seed_makes_the_same_thing(key):
    one, two = made(key, 3, 0.03, 0.1), made(key, 3, 0.03, 0.1)
    np.testing.assert_array_equal(points_of(one), points_of(two))
    assert one.textures.keys() == two.textures.keys()
    for name, look in one.textures.items():
        np.testing.assert_array_equal(look.pixels, two.textures[name].pixels)
    assert not np.array_equal(points_of(one)[:8], points_of(made(key, 4, 0.03, 0.1))[:8])


def test_many_looks_are_plain():
    shop = Workshop(np.random.default_rng(0), COARSE, 0.1)
    plain = [np.ptp(random_look(shop, 0.1, 0.1).pixels.reshape(-1, 3), axis=0).max() == 0 for _ in range(300)]
    assert 0.28 < np.mean(plain) < 0.48
