"""Things that the user outlines: of known boxes on a table, the cut is made to miss one, and `add` brings it back."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from surfaces import floor_sheet, frames_of, merged, sheet, solid_box, surface_from

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import Instance, InstanceSet, Surface
from reconstruction.editing.addresses import Address
from reconstruction.editing.anchors import Footage, Pointer
from reconstruction.editing.instances import apply_overrides
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.poses.lens import Lens
from registry.errors import UsageError
from registry.geometry import invert_rigid, transform_points

pytestmark = pytest.mark.stage
LOW, HIGH = np.array([-0.3, 0.0, 0.5]), np.array([-0.18, 0.1, 0.65])
GLASS_LOW, GLASS_HIGH = np.array([0.1, -0.3, 0.5]), np.array([0.18, -0.22, 0.62])


def outline_of(
    footage: Footage, frame: int, low: np.ndarray, high: np.ndarray, margin_px: float = 2.0
) -> dict:
    """Return the outline of a box in a frame, drawn just outside of it."""
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    local = transform_points(invert_rigid(footage.posed.world_from_camera[frame]), corners)
    u, v = footage.depth.camera.project(local)
    hull = cv2.convexHull(np.column_stack([u, v]).astype(np.float32))[:, 0].astype(float)
    middle = hull.mean(axis=0)
    away = hull - middle
    hull = middle + away * (1 + margin_px / np.linalg.norm(away, axis=1, keepdims=True))
    return {"frame": frame, "points": hull.round(1).tolist()}


class Scene:
    """A table with two boxes on it, cut into things, of which the red one is given to the table."""

    def __init__(self) -> None:
        self.surface: Surface = surface_from(
            merged(
                floor_sheet((200, 200, 190)),
                solid_box((-0.5, -0.4, 0.0), (0.5, 0.4, 0.5), (120, 80, 50)),
                solid_box(LOW, HIGH, (200, 30, 30)),
                solid_box((0.1, 0.0, 0.5), (0.22, 0.1, 0.62), (30, 60, 200)),
            )
        )
        posed, depth = frames_of(self.surface, 480, 360)
        self.footage = Footage(posed, depth, Lens.of(posed), self.surface)
        self.whole = find_instances(posed, depth, self.surface, InstancesConfig(), progress=NO_PROGRESS)
        self.table, *small = sorted(self.whole.objects, key=lambda o: -float(np.prod(o.extents_m)))
        self.red = min(small, key=lambda o: o.center[0])
        self.missed = merged_into_table(self.whole, self.red, self.table)

    def outline(self, frame: int, low: np.ndarray, high: np.ndarray, margin_px: float = 2.0) -> dict:
        """See `outline_of`."""
        return outline_of(self.footage, frame, low, high, margin_px)

    def added(self, *outlines: dict, found: InstanceSet | None = None) -> InstanceSet:
        entry = {"add": {"label": "mug", "outline": list(outlines)}}
        return apply_overrides(found or self.missed, self.surface, [entry], self.footage)


def merged_into_table(found: InstanceSet, red: Instance, table: Instance) -> InstanceSet:
    return replace(
        found,
        vertex_instance=np.where(found.vertex_instance == red.id, table.id, found.vertex_instance).astype(
            np.int32
        ),
        id_maps=np.where(found.id_maps == red.id, table.id, found.id_maps).astype(np.uint16),
        objects=tuple(o for o in found.objects if o.id != red.id),
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.mark.parametrize("frames", [(0,), (1,), (0, 2)])
def test_the_outlined_thing_gets_its_surface_box_and_support(scene, frames):
    before = scene.missed
    out = scene.added(*(scene.outline(frame, LOW, HIGH) for frame in frames))
    (item,) = {o.id: o for o in out.objects}.keys() - {o.id for o in before.objects}
    mug = next(o for o in out.objects if o.id == item)
    assert item == max(o.id for o in before.objects) + 1 or item > max(b.id for b in before.base)
    assert (mug.label, mug.label_confidence, mug.support_hint) == ("mug", 1.0, scene.table.id)
    np.testing.assert_allclose(mug.center, 0.5 * (LOW + HIGH), atol=0.015)
    np.testing.assert_allclose(sorted(mug.extents_m), sorted(HIGH - LOW), atol=0.025)
    true = scene.whole.vertex_instance == scene.red.id
    got = out.vertex_instance == item
    assert (true & got).sum() / (true | got).sum() > 0.8
    pixels, drawn = scene.whole.id_maps == scene.red.id, out.id_maps == item
    assert (pixels & drawn).sum() / (pixels | drawn).sum() > 0.8
    others = [o for o in out.objects if o.id != item]
    assert others == list(before.objects)


def test_entries_after_it_find_it_by_a_click_inside_the_outline(scene):
    out = scene.added(scene.outline(0, LOW, HIGH))
    x, y = np.mean(scene.outline(0, LOW, HIGH)["points"], axis=0)
    pointer = Pointer(out, scene.surface, scene.footage)
    assert pointer.thing(Address("pixel", frame=0, pixel=(float(x), float(y)))).label == "mug"


def test_a_thing_that_exists_is_not_added_again(scene):
    with pytest.raises(
        UsageError, match=rf"add mug: the outline in frame 0 shows .* {scene.red.id}, which is a thing"
    ):
        scene.added(scene.outline(0, LOW, HIGH), found=scene.whole)


def test_one_outline_of_a_glass_asks_for_a_second(scene):
    with pytest.raises(UsageError, match=r"outline in frame 0 has next to no surface.*glass.*second frame"):
        scene.added(scene.outline(0, GLASS_LOW, GLASS_HIGH))


def test_two_outlines_of_a_glass_give_a_box_around_it(scene):
    out = scene.added(*(scene.outline(frame, GLASS_LOW, GLASS_HIGH, 0.5) for frame in (0, 1)))
    glass = out.objects[-1]
    low, high = glass.center - 0.5 * glass.extents_m, glass.center + 0.5 * glass.extents_m
    np.testing.assert_array_equal(out.vertex_instance, scene.missed.vertex_instance)
    # The hull holds the thing, and is a few times as large at most.
    if glass.yaw_rad == 0:
        assert (low < GLASS_LOW + 0.01).all()
        assert (high > GLASS_HIGH - 0.01).all()
    assert np.prod(glass.extents_m) > 0.9 * np.prod(GLASS_HIGH - GLASS_LOW)
    assert np.prod(glass.extents_m) < 3 * np.prod(GLASS_HIGH - GLASS_LOW)
    np.testing.assert_allclose(glass.center, 0.5 * (GLASS_LOW + GLASS_HIGH), atol=0.03)
    assert low[2] == pytest.approx(0.5, abs=0.01)
    pointer = Pointer(out, scene.surface, scene.footage)
    for frame in (0, 1):
        x, y = np.mean(scene.outline(frame, GLASS_LOW, GLASS_HIGH)["points"], axis=0)
        assert pointer.thing(Address("pixel", frame=frame, pixel=(float(x), float(y)))).id == glass.id
    x, y = np.mean(scene.outline(0, [0.1, 0.0, 0.5], [0.22, 0.1, 0.62])["points"], axis=0)
    assert pointer.thing(Address("pixel", frame=0, pixel=(float(x), float(y)))).id != glass.id


def test_outlines_of_different_places_do_not_meet(scene):
    away = np.array([-0.5, 0.5, 0])
    elsewhere = scene.outline(1, GLASS_LOW + away, GLASS_HIGH + away)
    with pytest.raises(UsageError, match=r"frame 0 and frame 1 .* do not meet in space"):
        scene.added(scene.outline(0, GLASS_LOW, GLASS_HIGH), elsewhere)


def test_a_picture_flat_on_a_wall_needs_one_outline():
    low, high = np.array([-0.2, 1.2, 0.7]), np.array([0.3, 1.2, 1.1])
    surface = surface_from(
        merged(
            floor_sheet((200, 200, 190)),
            sheet((-1.2, 1.2, 0), (2.4, 0, 0), (0, 0, 1.5), (150, 170, 160)),
            solid_box((-0.5, -0.4, 0.0), (0.5, 0.4, 0.5), (120, 80, 50)),
        )
    )
    posed, depth = frames_of(surface, 480, 360)
    footage = Footage(posed, depth, Lens.of(posed), surface)
    found = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    wall = next(b for b in found.base if b.label == "wall")
    entry = {"add": {"label": "picture", "outline": outline_of(footage, 0, low, high, 0.5)}}
    out = apply_overrides(found, surface, [entry], footage)
    picture = out.objects[-1]
    assert (picture.support_hint, picture.attached_hint) == (wall.id, True)
    np.testing.assert_allclose(picture.center, 0.5 * (low + high), atol=0.03)
    np.testing.assert_allclose(picture.extents_m, [0.025, 0.5, 0.4], atol=0.02)
    x, y = np.mean(entry["add"]["outline"]["points"], axis=0)
    pointer = Pointer(out, surface, footage)
    assert pointer.thing(Address("pixel", frame=0, pixel=(float(x), float(y)))).id == picture.id
    assert (out.id_maps[1] == picture.id).any()
    assert not (out.id_maps[2] == picture.id).any()  # from behind
    # It has no surface, but it is a thing: outlined again, in another frame and less exactly, it is not a second one.
    again = {"add": {"label": "picture", "outline": outline_of(footage, 1, low, high, 4.0)}}
    with pytest.raises(UsageError, match=f"shows picture {picture.id}, which is a thing already"):
        apply_overrides(out, surface, [again], footage)
    beside = {
        "add": {
            "label": "poster",
            "outline": outline_of(footage, 0, low - [0.7, 0, 0], high - [0.7, 0, 0], 0.5),
        }
    }
    assert len(apply_overrides(out, surface, [beside], footage).objects) == len(out.objects) + 1
