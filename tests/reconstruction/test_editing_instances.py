"""The user's corrections to the cut."""

import numpy as np
import pytest
from surfaces import floor_sheet, frames_of, merged, solid_box, surface_from

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.editing.anchors import Footage
from reconstruction.editing.instances import apply_overrides
from reconstruction.editing.overrides import Overrides
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.poses.lens import Lens
from registry.errors import UsageError

pytestmark = pytest.mark.stage


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
    return surface, posed, Footage(posed, depth, Lens.of(posed), surface), found


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
    surface, _, footage, found = scene
    table = found.objects[0]
    entry = {"id": table.id, "split": {"point": [0.0, 0, 0], "normal": [1, 0, 0]}}
    out = apply_overrides(found, surface, [entry], footage)
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
        ({"merge": [3]}, "at least 2"),
        ({"id": None, "relabel": "x"}, "must be the number"),
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
    surface, _, footage, found = scene
    with pytest.raises(UsageError, match=message):
        apply_overrides(found, surface, [{"id": found.objects[0].id, **change}], footage)


def pixel_on(footage: Footage, point, row: int = 0) -> dict:
    """Return a click on a world point in a keyframe, in the film's pixels."""
    camera, pose = footage.posed.camera, footage.posed.world_from_camera[row]
    local = (np.asarray(point) - pose[:3, 3]) @ pose[:3, :3]
    x, y = camera.fx * local[0] / local[2] + camera.cx, camera.fy * local[1] / local[2] + camera.cy
    return {"frame": int(footage.posed.indices[row]), "x": float(x), "y": float(y)}


RED_TOP, BLUE_TOP, TABLE_TOP, FLOOR = (
    (-0.24, 0.05, 0.65),
    (0.16, 0.05, 0.62),
    (-0.05, -0.3, 0.5),
    (-0.9, -0.8, 0),
)


def labels_of(found, surface, point) -> str:
    nearest = int(np.argmin(np.linalg.norm(surface.vertices - np.array(point), axis=1)))
    number = found.vertex_instance[nearest]
    return next((o.label for o in found.objects if o.id == number), "none")


def test_a_thing_is_meant_by_a_click_or_by_a_point(scene):
    surface, _, footage, found = scene
    entries = [
        {"pixel": pixel_on(footage, RED_TOP), "relabel": "red"},
        {"at": list(BLUE_TOP), "relabel": "blue"},
        {"pixel": pixel_on(footage, TABLE_TOP, row=2), "relabel": "desk"},
    ]
    out = apply_overrides(found, surface, entries, footage)
    assert [labels_of(out, surface, p) for p in (RED_TOP, BLUE_TOP, TABLE_TOP)] == ["red", "blue", "desk"]


def test_merge_by_clicks_and_go_on_with_what_it_made(scene):
    surface, _, footage, found = scene
    red, blue = ({"pixel": pixel_on(footage, p)} for p in (RED_TOP, BLUE_TOP))
    out = apply_overrides(found, surface, [{"merge": [red, blue]}, {**blue, "relabel": "pair"}], footage)
    assert len(out.objects) == 2
    assert labels_of(out, surface, RED_TOP) == "pair"
    assert consistent(out)


def test_split_by_clicks_gives_each_part_its_color(scene):
    """Merged wrongly, table and boxes come apart again at their creases, in the mesh and in the pictures."""
    surface, _, footage, found = scene
    whole = apply_overrides(found, surface, [{"merge": [o.id for o in found.objects]}], footage)
    clicks = [{"pixel": pixel_on(footage, p)} for p in (TABLE_TOP, RED_TOP)] + [{"at": list(BLUE_TOP)}]
    out = apply_overrides(whole, surface, [{"split": clicks}], footage)
    assert len(out.objects) == 3
    assert labels_of(out, surface, RED_TOP) != labels_of(
        out, surface, TABLE_TOP
    )  # each named by its own shape
    for point in (TABLE_TOP, RED_TOP, BLUE_TOP):
        nearest = int(np.argmin(np.linalg.norm(surface.vertices - np.array(point), axis=1)))
        before, after = (f.vertex_instance == f.vertex_instance[nearest] for f in (found, out))
        assert (before & after).sum() > 0.93 * (before | after).sum()
        shown_before = found.id_maps == found.vertex_instance[nearest]
        shown_after = out.id_maps == out.vertex_instance[nearest]
        assert (shown_before & shown_after).sum() > 0.9 * (shown_before | shown_after).sum()
    assert consistent(out)


def test_several_clicks_may_lie_on_one_part(scene):
    surface, _, footage, found = scene
    both = apply_overrides(found, surface, [{"merge": [o.id for o in found.objects]}], footage)
    boxes = [{"at": list(RED_TOP)}, {"at": list(BLUE_TOP)}]
    out = apply_overrides(both, surface, [{"split": [boxes, {"at": list(TABLE_TOP)}]}], footage)
    assert len(out.objects) == 2
    owner = [out.vertex_instance[np.argmin(np.linalg.norm(surface.vertices - np.array(p), axis=1))]
             for p in (RED_TOP, BLUE_TOP, TABLE_TOP)]  # fmt: skip
    assert owner[0] == owner[1] != owner[2]


def test_the_split_plane_may_go_through_a_click(scene):
    surface, _, footage, found = scene
    entry = {"id": found.objects[0].id, "split": {"point": {"at": [0, -0.3, 0.5]}, "normal": [1, 0, 0]}}
    assert len(apply_overrides(found, surface, [entry], footage).objects) == 4


def test_a_click_on_the_floor_or_beside_the_film_is_said(scene):
    surface, _, footage, found = scene
    with pytest.raises(
        UsageError, match=r"shows the floor \(1\), not a thing; the nearest is \w+ \d, \d+ pixels"
    ):
        apply_overrides(found, surface, [{"pixel": pixel_on(footage, FLOOR), "drop": True}], footage)
    with pytest.raises(UsageError, match="outside the frame of 320 x 240"):
        apply_overrides(found, surface, [{"pixel": {"frame": 0, "x": 400, "y": 3}, "drop": True}], footage)
    with pytest.raises(UsageError, match=r"no camera is known of frame 77 .*nearest with one are 0, 1, 2"):
        apply_overrides(found, surface, [{"pixel": {"frame": 77, "x": 4, "y": 3}, "drop": True}], footage)
    with pytest.raises(UsageError, match=r"at \[0.00, 0.00, 2.00\] shows nothing .*m away"):
        apply_overrides(found, surface, [{"at": [0, 0, 2], "drop": True}], footage)


def test_splits_between_things_and_merges_of_one_are_said(scene):
    surface, _, footage, found = scene
    red, blue = {"at": list(RED_TOP)}, {"at": list(BLUE_TOP)}
    with pytest.raises(UsageError, match="different things already"):
        apply_overrides(found, surface, [{"split": [red, blue]}], footage)
    with pytest.raises(UsageError, match="same thing"):
        apply_overrides(found, surface, [{"merge": [red, {"at": [-0.2, 0.02, 0.65]}]}], footage)
    with pytest.raises(UsageError, match="same spot"):
        apply_overrides(found, surface, [{"split": [red, {"at": [-0.2401, 0.05, 0.65]}]}], footage)


def test_a_click_may_count_in_another_size(scene):
    surface, _, footage, found = scene
    click = pixel_on(footage, RED_TOP)
    twice = {"frame": click["frame"], "x": 2 * click["x"], "y": 2 * click["y"], "size": [640, 480]}
    out = apply_overrides(found, surface, [{"pixel": twice, "relabel": "red"}], footage)
    assert labels_of(out, surface, RED_TOP) == "red"


@pytest.mark.parametrize("change", ["mesh: 3", "material: [wood]", "mass_kg: true", "mass_kg: null"])
def test_values_of_the_wrong_type_are_refused_when_the_file_is_read(tmp_path, change):
    (tmp_path / "fixes.yaml").write_text(f"- {{id: 3, {change}}}")
    with pytest.raises(UsageError, match=r"entry 1: (mesh|material|mass_kg) must be"):
        Overrides.load(tmp_path / "fixes.yaml")
