"""Furniture families and arrangements: every kind is sound, every layout builds, the old rooms stay as they were."""

import hashlib
from dataclasses import asdict

import numpy as np
import pytest

from registry.errors import UsageError
from synthetic import footprints
from synthetic.arrangements import LAYOUTS
from synthetic.furniture import Workshop
from synthetic.furniture_families import (
    CLOTH_KINDS,
    FURNITURE_FAMILIES,
    furniture_keys,
    kind_named,
    shape_families,
)
from synthetic.layout import KINDS, Shape
from synthetic.procedural import RoomSpec, build_procedural_room, furnish, plan_room
from synthetic.random_rooms import draw_room
from synthetic.shapes import COARSE, signed_volume

pytestmark = pytest.mark.stage

ROUGH = {"step_m": COARSE, "density": 0.03}
ALL = tuple(FURNITURE_FAMILIES)
KEYS = [*furniture_keys(ALL), *CLOTH_KINDS]


def make(key, seed, step_m=COARSE, density=0.01):
    return kind_named(key).make(Workshop(np.random.default_rng([seed, 5]), step_m, density), "x/")


def meshed(part):
    import trimesh

    starts = np.cumsum([0] + [len(p.vertices) for p in part[:-1]])
    faces = np.concatenate([p.faces + s for p, s in zip(part, starts)])
    mesh = trimesh.Trimesh(np.concatenate([p.vertices for p in part]), faces, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True, digits_vertex=7)
    return mesh


@pytest.mark.parametrize("key", KEYS)
def test_furniture_is_closed_stands_and_has_one_shape_at_any_fineness(key):
    for seed in (0, 1):
        fine, coarse = Shape.of(make(key, seed, 0.05, 0.05)), Shape.of(make(key, seed))
        assert np.allclose(fine.low, coarse.low, atol=1e-9)
        assert np.allclose(fine.high, coarse.high, atol=1e-9)
        assert fine.volume == pytest.approx(coarse.volume)
        assert coarse.low[2] == pytest.approx(0.0, abs=1e-9)
        assert {p.texture for part in fine.model.parts for p in part} == set(fine.model.textures)
        for part in coarse.model.parts:
            assert signed_volume(part) > 0
            if seed == 0:
                mesh = meshed(part)
                assert mesh.is_watertight
                assert mesh.is_winding_consistent


def test_places_lie_on_a_surface():
    """What a kind offers as a support is there, to a millimetre or, where it sags, to half a centimetre."""
    for key in KEYS:
        model = make(key, 3)
        if not model.places:
            continue
        meshes = [meshed(part) for part in model.parts]
        for place in model.places:
            x, y = place.area.mean(0)
            want = place.height_m + (0.0 if place.sag is None else float(place.sag(x, y)))
            tops = []
            for mesh in meshes:
                hits = mesh.ray.intersects_location([[x + 1e-4, y + 2e-4, 3.0]], [[0, 0, -1.0]])[0]
                tops += list(hits[:, 2]) if len(hits) else []
            assert np.abs(np.array(tops) - want).min() < (1e-3 if place.sag is None else 8e-3), (
                key,
                place.name,
            )


def test_names_of_kinds_are_unique():
    keys = [*KINDS, *CLOTH_KINDS, *furniture_keys(ALL)]
    keys += [f"{f}_{k}" for f, kinds in shape_families().items() for k in kinds]
    assert len(set(keys)) == len(keys)


def digest(spec):
    room, out = build_procedural_room(spec), hashlib.sha256()
    for e in room.entities:
        out.update(e.name.encode() + e.label.encode() + str(e.parent).encode())
        out.update(np.round(e.world_from_object, 7).tobytes())
        for p in (*e.patches, *(p for s in e.solids for p in s)):
            out.update(np.round(p.vertices, 6).tobytes() + np.ascontiguousarray(p.faces).tobytes())
    return out.hexdigest()[:16]


@pytest.mark.parametrize(
    ("spec", "before"),
    [
        (RoomSpec(seed=11, objects=9, step_m=0.15, density=0.1), "660f114ea474f667"),
        (RoomSpec(seed=77, objects=40, clutter_gap_m=0.012, step_m=COARSE, density=0.05), "5149d3f105b32608"),
    ],
)
def test_rooms_of_before_are_what_they_were(spec, before):
    assert digest(spec) == before


def overlapping(plan):
    """Return pairs on one support whose silhouettes overlap, cloths under things aside."""
    out = []
    for number, a in enumerate(plan.items):
        for b in plan.items[number + 1 :]:
            if a.parent is None or a.parent is not b.parent:
                continue
            level = a.bottom_m < b.top_m and b.bottom_m < a.top_m
            if level and footprints.distance(a.silhouette, b.silhouette) < -0.002:
                out.append((a.name, b.name))
    return out


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_builds(layout):
    for seed in range(3):
        spec = RoomSpec(
            seed=seed, objects=10, layout=layout, furniture=ALL, uneven=0.5, clutter_gap_m=0.015,
            household=seed == 0, **ROUGH,
        )  # fmt: skip
        plan = plan_room(spec)
        assert len(plan.items) == 10
        assert overlapping(plan) == []
        room = furnish(plan)
        by_name = {e.name: e for e in room.entities}
        shape = plan.shape
        way = shape.walk(np.radians(np.linspace(-164, -16, 40)))
        assert np.all(
            (way > (shape.west + 0.2, shape.south + 0.2)) & (way < (shape.east - 0.2, shape.north + 9))
        )
        for item in plan.items:
            entity = by_name[item.name]
            assert by_name[item.support].id == entity.parent
            if item.parent is not None:
                assert item.bottom_m == pytest.approx(
                    item.parent.pose[2, 3] + _support_height(item), abs=0.06
                )
            if item.level == 0 and not item.hangs and item.parent is None:
                inside = [footprints.depth_inside(p[None], item.silhouette) for p in way]
                assert max(inside) < 0, item.name  # nobody walks through furniture
            low, high = item.silhouette.min(0), item.silhouette.max(0)
            assert low[0] > shape.west - 0.02
            assert high[0] < shape.east + 0.02
            assert high[1] < shape.north + 0.02


def _support_height(item):
    place = next(p for c, p in item.parent.children if c is item)
    return place.height_m


def test_uneven_supports_carry_things_at_their_height():
    seen = 0
    for seed in range(2):
        plan = plan_room(
            RoomSpec(seed=seed, objects=14, furniture=ALL, layout="bedroom", uneven=1.0, **ROUGH)
        )
        for item in plan.items:
            place = next((p for c, p in item.parent.children if c is item), None) if item.parent else None
            if place is None or place.sag is None:
                continue
            seen += 1
            x, y = (np.linalg.inv(item.parent.pose) @ item.pose)[:2, 3]
            rest = item.bottom_m - item.parent.pose[2, 3] - place.height_m
            assert rest == pytest.approx(float(place.sag(x, y)), abs=0.03)
    assert seen >= 3


def test_chairs_are_pushed_below_tables_without_touching():
    from synthetic.shapes import moved

    below = 0
    for seed in range(4):
        plan = plan_room(
            RoomSpec(seed=seed, objects=14, furniture=("tables", "seating"), layout="dining", household=False)
        )
        table = plan.items[0]
        for chair in plan.items[1:]:
            if chair.parent is None and not chair.hangs:
                below += footprints.distance(table.silhouette, chair.silhouette) < -0.02
                for part in chair.model.parts:
                    points = np.concatenate([p.vertices for p in moved(part, chair.pose)])
                    for other in table.bodies:
                        outline, low, high = other
                        if points[:, 2].min() < high and points[:, 2].max() > low:
                            assert footprints.distance(footprints.convex_hull(points[:, :2]), outline) > 0
    assert below >= 2


def test_drawn_rooms_can_be_planned():
    shapes = tuple(shape_families())[:3]
    layouts = set()
    for seed in range(6):
        spec = draw_room(seed, shapes=shapes, density=0.05, objects=(5, 12))
        assert spec == draw_room(seed, shapes=shapes, density=0.05, objects=(5, 12))
        layouts.add(spec.layout)
        assert len(plan_room(spec).items) == spec.objects
    assert len(layouts) >= 3
    held = draw_room(3, shapes=shapes, furniture=("storage", "wall"), layouts=("living", "corner"))
    assert held.layout == "corner"
    assert set(held.furniture) <= {"storage", "wall"}


def test_specs_survive_json_and_unknown_names_are_refused():
    spec = RoomSpec(furniture=("tables",), layout="dining")
    values = asdict(spec) | {"furniture": ["tables"], "families": []}
    assert RoomSpec(**values) == spec
    for fields, said in (
        ({"layout": "attic"}, "layout=attic"),
        ({"furniture": ("lamps",)}, "furniture=lamps"),
        ({"layout": "bedroom"}, "beds"),
        ({"uneven": 2.0}, "uneven=2.0"),
    ):
        with pytest.raises(UsageError, match=said):
            RoomSpec(**fields)
