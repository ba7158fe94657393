"""Instances on a generated room with true depth, and on surfaces built by hand with known answers."""

from dataclasses import replace

import numpy as np
import pytest
from notes import Notes
from surfaces import floor_sheet, frames_of, merged, solid_box, surface_from, with_planes

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import InstanceSet, Surface
from reconstruction.instances import INSTANCES_PRESETS, InstancesConfig, find_instances
from reconstruction.surface import SurfaceConfig, fuse_surface

pytestmark = pytest.mark.stage


def run(surface: Surface, progress=NO_PROGRESS) -> InstanceSet:
    posed, depth = frames_of(surface, 480, 360)
    return find_instances(posed, depth, surface, InstancesConfig(), progress=progress)


def object_at(found: InstanceSet, surface: Surface, point: tuple[float, float, float]) -> int:
    nearest = int(np.argmin(np.linalg.norm(surface.vertices - np.array(point), axis=1)))
    return int(found.vertex_instance[nearest])


def by_id(found: InstanceSet, number: int):
    return next(o for o in found.objects if o.id == number)


TABLE_TOP = ((-0.5, -0.4, 0.0), (0.5, 0.4, 0.5), (120, 80, 50))


def test_box_on_table_on_floor():
    """A table block with a red box on it: two things, one on the other, the floor beneath."""
    surface = surface_from(
        merged(
            floor_sheet((200, 200, 190)),
            solid_box(*TABLE_TOP),
            solid_box((0.0, 0.0, 0.5), (0.12, 0.1, 0.65), (200, 30, 30)),
        )
    )
    found = run(surface)
    assert [b.label for b in found.base] == ["floor"]
    assert found.base[0].observed
    assert len(found.objects) == 2
    table, box = object_at(found, surface, (-0.4, 0, 0.5)), object_at(found, surface, (0.06, 0.05, 0.65))
    assert by_id(found, box).support_hint == table
    assert by_id(found, table).support_hint == found.base[0].id
    np.testing.assert_allclose(by_id(found, box).extents_m, [0.12, 0.1, 0.15], atol=0.02)
    np.testing.assert_allclose(by_id(found, table).extents_m, [1.0, 0.8, 0.5], atol=0.03)
    np.testing.assert_allclose(by_id(found, box).center, [0.06, 0.05, 0.575], atol=0.015)
    assert table < box  # the larger thing has the smaller id


def test_two_colored_box_stays_whole():
    """A label of another color, without any crease, must not cut a thing."""
    box = solid_box((0.0, 0.0, 0.5), (0.12, 0.1, 0.68), (200, 30, 30))
    box.colors[box.vertices[:, 2] > 0.6] = (30, 60, 200)
    found = run(surface_from(merged(floor_sheet((200, 200, 190)), solid_box(*TABLE_TOP), box)))
    assert len(found.objects) == 2


def test_bump_of_the_table_is_no_object():
    """A low swelling of the support's own color is noise of the depth."""
    table = solid_box(*TABLE_TOP)
    top = (table.normals[:, 2] > 0.9) & (np.linalg.norm(table.vertices[:, :2] - [0.2, 0.1], axis=1) < 0.1)
    height = 0.02 * np.cos(np.linalg.norm(table.vertices[top, :2] - [0.2, 0.1], axis=1) / 0.1 * np.pi / 2)
    table.vertices[top, 2] += height
    found = run(surface_from(merged(floor_sheet((200, 200, 190)), table)))
    assert len(found.objects) == 1


def test_noise_does_not_make_objects():
    """3 mm of jitter changes neither the number of things nor their size by much."""
    surface = surface_from(
        merged(
            floor_sheet((200, 200, 190)),
            solid_box(*TABLE_TOP),
            solid_box((0.0, 0.0, 0.5), (0.12, 0.1, 0.65), (200, 30, 30)),
        )
    )
    jitter = np.random.default_rng(0).normal(0, 0.002, surface.vertices.shape).astype(np.float32)
    noisy = with_planes(replace(surface, vertices=surface.vertices + jitter))
    found = run(noisy)
    assert len(found.objects) == 2
    small = by_id(found, object_at(found, surface, (0.06, 0.05, 0.65)))
    np.testing.assert_allclose(small.extents_m, [0.12, 0.1, 0.15], atol=0.03)


def test_empty_room_is_legal_and_noted():
    """A floor alone gives a base, no object, and a note that says so."""
    notes = Notes()
    found = run(surface_from(floor_sheet((200, 200, 190))), notes)
    assert found.objects == ()
    assert [b.label for b in found.base] == ["floor"]
    assert any("empty room" in line for line in notes.notes)


def test_missing_floor_is_assumed():
    """Without any surface near z = 0 a floor is assumed below everything and said to be."""
    notes = Notes()
    surface = surface_from(solid_box((0.0, 0.0, 0.8), (0.3, 0.3, 1.1), (90, 120, 40)))
    found = run(surface, notes)
    assert found.base[0].label == "floor"
    assert not found.base[0].observed
    outline = found.base[0].surface.polygon
    assert (outline[:, :2].min(axis=0) < 0.0).all()
    assert (outline[:, :2].max(axis=0) > 0.3).all()
    assert any("assumed" in line for line in notes.notes)
    assert len(found.objects) == 1


def test_empty_surface():
    """No surface at all: an assumed floor and nothing else."""
    nothing = surface_from(floor_sheet((200, 200, 190)))
    empty = replace(
        nothing,
        vertices=np.zeros((0, 3), np.float32),
        faces=np.zeros((0, 3), np.int32),
        normals=np.zeros((0, 3), np.float32),
        colors=np.zeros((0, 3), np.uint8),
        weights=np.zeros(0, np.float32),
    )
    posed, depth = frames_of(nothing)
    found = find_instances(posed, depth, with_planes(empty), InstancesConfig(), progress=NO_PROGRESS)
    assert found.objects == ()
    assert not found.base[0].observed


def find_in(capture, surface: Surface) -> InstanceSet:
    return find_instances(capture.posed, capture.depth, surface, InstancesConfig(), progress=NO_PROGRESS)


@pytest.fixture(scope="module")
def room(small_capture) -> tuple[Surface, InstanceSet]:
    """The surface of the generated room from true depth, and its instances."""
    config = SurfaceConfig(voxel_size_m=0.016)
    surface = fuse_surface(small_capture.posed, small_capture.depth, config, progress=NO_PROGRESS)
    return surface, find_in(small_capture, surface)


def test_generated_room(small_capture, room):
    """On a filmed room with true depth most things are found, and pixels carry the right thing's id."""
    surface, found = room
    assert found.id_maps.shape == small_capture.id_maps.shape
    assert found.id_maps.dtype == np.uint16
    assert found.vertex_instance.shape == (len(surface.vertices),)
    known = {0, *found.static_ids, *(o.id for o in found.objects)}
    assert set(np.unique(found.id_maps)) <= known
    assert set(np.unique(found.vertex_instance)) <= known
    assert "floor" in {b.label for b in found.base}
    assert "wall" in {b.label for b in found.base}
    seen, right = 0, 0
    for entity in small_capture.entities:
        mask = small_capture.id_maps == entity.id
        if entity.base or mask.sum() < 500 * len(mask):
            continue
        names, counts = np.unique(found.id_maps[mask], return_counts=True)
        best = int(names[np.argmax(counts)])
        union = (mask | (found.id_maps == best)).sum()
        seen += 1
        right += best in {o.id for o in found.objects} and counts.max() / union > 0.6
    assert seen >= 3
    assert right >= 0.7 * seen


def test_same_input_gives_same_bits(small_capture, room):
    """Two runs agree exactly."""
    surface, one = room
    two = find_in(small_capture, surface)
    np.testing.assert_array_equal(one.id_maps, two.id_maps)
    np.testing.assert_array_equal(one.vertex_instance, two.vertex_instance)
    assert [o.label for o in one.objects] == [o.label for o in two.objects]


@pytest.mark.parametrize("name", ["fast", "default", "quality"])
def test_presets_exist(name):
    assert isinstance(INSTANCES_PRESETS[name], InstancesConfig)
