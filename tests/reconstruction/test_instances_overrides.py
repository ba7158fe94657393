"""The user's corrections to the cut."""

import numpy as np
import pytest
from surfaces import floor_sheet, frames_of, merged, solid_box, surface_from

from reconstruction.instances import InstancesConfig, apply_overrides, find_instances
from reconstruction.progress import NO_PROGRESS
from registry.errors import UsageError


@pytest.fixture(scope="module")
def scene():
    """A table with two boxes on it, cut into things."""
    surface = surface_from(
        merged(
            floor_sheet((200, 200, 190)),
            solid_box((-0.5, -0.4, 0.0), (0.5, 0.4, 0.5), (120, 80, 50)),
            solid_box((-0.3, 0.0, 0.5), (-0.18, 0.1, 0.65), (200, 30, 30)),
            solid_box((0.1, 0.0, 0.5), (0.22, 0.1, 0.62), (30, 60, 200)),
        )
    )
    posed, depth = frames_of(surface, 320, 240)
    found = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    assert len(found.objects) == 3
    return surface, posed, depth, found


def consistent(found) -> bool:
    known = {0, *(b.id for b in found.base), *(o.id for o in found.objects)}
    hints = {o.support_hint for o in found.objects}
    return (
        set(np.unique(found.vertex_instance)) <= known
        and set(np.unique(found.id_maps)) <= known
        and hints <= known
    )


def test_relabel(scene):
    surface, _, _, found = scene
    number = found.objects[1].id
    out = apply_overrides(found, surface, [{"id": number, "relabel": "mug"}])
    item = next(o for o in out.objects if o.id == number)
    assert (item.label, item.label_confidence) == ("mug", 1.0)
    assert consistent(out)


def test_drop_reparents_what_stood_on_it(scene):
    surface, _, _, found = scene
    table = found.objects[0]
    out = apply_overrides(found, surface, [{"id": table.id, "drop": True}])
    assert len(out.objects) == 2
    assert not (out.vertex_instance == table.id).any()
    assert not (out.id_maps == table.id).any()
    assert {o.support_hint for o in out.objects} == {table.support_hint}
    assert consistent(out)


def test_merge(scene):
    surface, _, _, found = scene
    table, one, two = found.objects
    before = (np.isin(found.vertex_instance, [one.id, two.id])).sum()
    out = apply_overrides(found, surface, [{"merge": [one.id, two.id]}])
    assert len(out.objects) == 2
    item = next(o for o in out.objects if o.id in (one.id, two.id))
    assert (out.vertex_instance == item.id).sum() == before
    assert item.support_hint == table.id
    np.testing.assert_allclose(item.extents_m[0], 0.52, atol=0.03)
    assert consistent(out)


def test_split_by_plane_cuts_vertices_and_pixels(scene):
    surface, posed, depth, found = scene
    table = found.objects[0]
    entry = {"id": table.id, "split": {"point": [0.0, 0, 0], "normal": [1, 0, 0]}}
    out = apply_overrides(found, surface, [entry], posed=posed, depth=depth)
    assert len(out.objects) == 4
    new = max(o.id for o in out.objects)
    assert (surface.vertices[out.vertex_instance == new, 0] > 0).all()
    assert (surface.vertices[out.vertex_instance == table.id, 0] <= 0).all()
    old_pixels, new_pixels = (out.id_maps == table.id).sum(), (out.id_maps == new).sum()
    assert old_pixels + new_pixels == (found.id_maps == table.id).sum()
    assert min(old_pixels, new_pixels) > 0.25 * max(old_pixels, new_pixels)
    assert (found.vertex_instance == table.id).sum() > (out.vertex_instance == table.id).sum()
    assert consistent(out)


def test_make_base(scene):
    surface, _, _, found = scene
    item = found.objects[-1]
    out = apply_overrides(found, surface, [{"id": item.id, "make_base": "wall"}])
    wall = next(b for b in out.base if b.id == item.id)
    assert wall.label == "wall"
    np.testing.assert_allclose(np.linalg.norm(wall.surface.plane[:3]), 1.0)
    residual = wall.surface.polygon @ wall.surface.plane[:3] + wall.surface.plane[3]
    np.testing.assert_allclose(residual, 0, atol=1e-9)
    assert consistent(out)


def test_anchor_guards_against_another_reconstruction(scene):
    surface, _, _, found = scene
    item = found.objects[-1]
    good = {"id": item.id, "relabel": "cup", "near": item.center.tolist()}
    assert consistent(apply_overrides(found, surface, [good]))
    with pytest.raises(UsageError, match="not near"):
        apply_overrides(found, surface, [{**good, "near": [5.0, 5.0, 0.0]}])


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"id": 99, "drop": True}, "no object 99"),
        ({"merge": [3]}, "at least two"),
        ({"id": None, "relabel": "x"}, "no object None"),
        ({"merge": [3, 77]}, "no object 77"),
    ],
)
def test_wrong_addresses_are_said(scene, entry, message):
    surface, _, _, found = scene
    with pytest.raises(UsageError, match=message):
        apply_overrides(found, surface, [entry])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"split": {"point": [0, 0, 0]}}, "needs"),
        ({"split": {"point": [0, 0, 9], "normal": [0, 0, 1]}}, "misses"),
        ({"split": {"point": [0, 0, 0], "normal": [0, 0, 0]}}, "no direction"),
        ({"split": {"point": [0, "a", 0], "normal": [0, 0, 1]}}, "three numbers"),
        ({"make_base": "sofa"}, "must be one of"),
        ({"relabel": "x", "near": [1, 2]}, "three numbers"),
    ],
)
def test_wrong_changes_are_said(scene, change, message):
    surface, _, _, found = scene
    with pytest.raises(UsageError, match=message):
        apply_overrides(found, surface, [{"id": found.objects[0].id, **change}])
