"""The assets stage on a generated room with true depth and ids: closed, posed, hollow and robust objects."""

import time
from dataclasses import replace

import numpy as np
import pytest
from gltf_validator import gltf_issues
from notes import Notes

from reconstruction.assets import AssetsConfig, build_assets
from reconstruction.assets.gltf import write_glb
from reconstruction.assets.solid import Solid, to_manifold
from reconstruction.core.types import BaseEntity, Instance, InstanceSet, Plane, Surface
from registry.geometry import transform_points

pytestmark = pytest.mark.stage

CONFIG = AssetsConfig(
    cells_along_longest=40, max_voxels=150_000, texture_max_px=128, texture_frames=4, base_texel_m=0.05
)
EMPTY = Surface(*(np.zeros((0, 3), kind) for kind in ("f4", "i4", "f4", "u1")), np.zeros(0, "f4"), 0.01, None)


def instances_of(capture, names):
    base, objects = [], []
    for entity in capture.entities:
        low, high = entity.mesh().bounds
        if entity.name == "floor":
            corners = [[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]]
            base.append(
                BaseEntity(entity.id, "floor", Plane(np.array([0, 0, 1.0, 0]), np.array(corners)), True)
            )
        elif entity.name in names:
            objects.append(
                Instance(
                    entity.id, entity.label, 0.9, (low + high) / 2, 0.0, high - low, entity.parent or 0, False
                )
            )
    return InstanceSet(np.zeros(0, np.int32), tuple(base), tuple(objects), capture.id_maps)


@pytest.fixture(scope="module")
def built(small_capture):
    found = instances_of(small_capture, ("can", "bowl", "book"))
    return build_assets(small_capture.posed, small_capture.depth, EMPTY, found, CONFIG), found


def test_every_glb_is_valid_gltf(built, tmp_path):
    """By Khronos' validator: no error and no warning."""
    assets, _ = built
    files = []
    for item in assets.objects:
        files.append(tmp_path / f"{item.id}.glb")
        write_glb(item.visual, files[-1])
    for item in assets.base:
        files.append(tmp_path / f"base_{item.id}.glb")
        write_glb(item.visual, files[-1])
    issues = gltf_issues(files)
    assert len(issues) == len(files) == 4
    assert not any(issue["severity"] < 2 for found in issues.values() for issue in found), issues


def test_the_validator_rejects_a_truncated_file(built, tmp_path):
    whole, torn = tmp_path / "whole.glb", tmp_path / "torn.glb"
    write_glb(built[0].objects[0].visual, whole)
    torn.write_bytes(whole.read_bytes()[:-400])
    assert any(issue["severity"] == 0 for issue in gltf_issues([torn])[str(torn)])


def test_objects_are_closed_and_at_their_true_poses(built, small_capture):
    from scipy.spatial import cKDTree

    assets, _ = built
    for item in assets.objects:
        entity = next(e for e in small_capture.entities if e.id == item.id)
        mesh = item.visual
        _, place = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
        edges = np.sort(
            np.concatenate([place.ravel()[mesh.faces[:, [a, b]]] for a, b in ((0, 1), (1, 2), (2, 0))]),
            axis=1,
        )
        _, count = np.unique(edges, axis=0, return_counts=True)
        assert (count % 2 == 0).all(), f"{entity.name} is not closed"
        assert mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-5)
        world = transform_points(item.world_from_object, mesh.vertices)
        truth = entity.mesh().sample(20000)
        assert cKDTree(truth).query(world)[0].mean() < 0.012, entity.name
        assert 0 < item.provenance.observed_fraction <= 1
        assert set(item.views) <= set(small_capture.posed.indices)
        np.testing.assert_allclose(
            item.world_from_object[:3, :3] @ item.world_from_object[:3, :3].T, np.eye(3), atol=1e-9
        )


def test_the_bowl_is_hollow(built, small_capture):
    assets, _ = built
    entity = next(e for e in small_capture.entities if e.name == "bowl")
    item = next(o for o in assets.objects if o.id == entity.id)
    world = transform_points(item.world_from_object, item.visual.vertices)
    low, high = entity.mesh().bounds
    middle = np.linalg.norm(world[:, :2] - (low + high)[:2] / 2, axis=1) < 0.2 * (high - low)[0]
    assert world[middle, 2].max() < low[2] + 0.6 * (high - low)[2]


def test_the_floor_extends_below_all_objects_and_faces_up(built):
    assets, _ = built
    (floor,) = assets.base
    corner = floor.visual.vertices[floor.visual.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert (normal[:, 2] > 0).all()
    for item in assets.objects:
        world = transform_points(item.world_from_object, item.visual.vertices)
        assert (world[:, :2] >= floor.visual.vertices[:, :2].min(axis=0)).all()
        assert (world[:, :2] <= floor.visual.vertices[:, :2].max(axis=0)).all()


def test_an_unseen_object_becomes_a_box_with_a_note(built, small_capture):
    _, found = built
    ghost = replace(
        found.objects[0], id=999, center=np.array([0.5, 0.5, 0.5]), extents_m=np.array([0.1, 0.2, 0.3])
    )
    notes = Notes()
    assets = build_assets(
        small_capture.posed,
        small_capture.depth,
        EMPTY,
        replace(found, objects=(ghost,)),
        CONFIG,
        progress=notes,
    )
    (item,) = assets.objects
    assert item.provenance.geometry == "box-fallback"
    assert any("999" in line for line in notes.notes)
    np.testing.assert_allclose(np.ptp(item.visual.vertices, axis=0), [0.1, 0.2, 0.3], atol=1e-6)


def test_an_object_without_a_collision_shape_becomes_a_box_and_the_others_stay(
    built, small_capture, monkeypatch
):
    """Also the floor's texture knows the box, and notes are in the order of objects, whichever is done first."""
    from reconstruction.assets import build

    assets, found = built
    bad, first = found.objects[1].id, found.objects[0].id
    made = build.collision_parts

    def fails_on_one(body, config, *, levels, progress, name):
        progress.note(f"{name}: noted")
        if name.startswith(f"object {first} "):
            time.sleep(0.5)  # the others take shape meanwhile
        if name.startswith(f"object {bad} ") and len(body.faces) > 12:
            raise ValueError("no shape")
        return made(body, config, levels=levels, progress=progress, name=name)

    monkeypatch.setattr(build, "collision_parts", fails_on_one)
    notes = Notes()
    again = build_assets(small_capture.posed, small_capture.depth, EMPTY, found, CONFIG, progress=notes)
    assert [item.id for item in again.objects] == [item.id for item in found.objects]
    for old, new in zip(assets.objects, again.objects):
        assert len(new.collision) > 0
        if new.id == bad:
            assert new.provenance.geometry == "box-fallback"
            assert len(new.collision) == 1
        else:
            np.testing.assert_array_equal(new.visual.vertices, old.visual.vertices)
            assert len(new.collision) == len(old.collision)
    told = [line.split()[1] for line in notes.notes if line.startswith("object")]
    assert told == sorted(told, key=[str(item.id) for item in found.objects].index)
    assert any(f"object {bad} " in line and "no shape" in line for line in notes.notes)


def test_results_are_deterministic(built, small_capture):
    assets, found = built
    again = build_assets(small_capture.posed, small_capture.depth, EMPTY, found, CONFIG)
    np.testing.assert_array_equal(again.objects[0].visual.vertices, assets.objects[0].visual.vertices)
    np.testing.assert_array_equal(again.objects[0].visual.texture, assets.objects[0].visual.texture)
    assert to_manifold(Solid(*_welded(again.objects[0].visual))) is not None


def _welded(mesh):
    place, inverse = np.unique(np.round(mesh.vertices.astype(float), 6), axis=0, return_inverse=True)
    return place, inverse.ravel()[mesh.faces].astype(np.int32)
