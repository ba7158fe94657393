"""Procedural rooms: as many things as asked for, possible, varied, and the same for the same spec."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from registry.errors import UsageError
from registry.geometry import rigid
from synthetic import footprints
from synthetic.checks import bodies, carried_share, overlaps, validate_room
from synthetic.furniture import Workshop
from synthetic.layout import KINDS, Shape
from synthetic.procedural import RoomSpec, build_procedural_room, furnish, plan_room
from synthetic.shapes import COARSE, moved, signed_volume
from synthetic.suites import CI_CAPTURES, PRESETS, SUITE

pytestmark = pytest.mark.stage

# A preset that only films otherwise has the rooms of the default.
OF_OTHER_ROOMS = sorted(n for n, p in PRESETS.items() if n == "default" or p.room != PRESETS["default"].room)
ROUGH = {"step_m": COARSE, "density": 0.05}  # geometry is the same, only coarsely painted


def with_shifted(room, name, offset):
    """Return the room with one thing moved as its maker did not mean it."""
    pose = rigid(translation=np.array(offset, float))

    def move(entity):
        if entity.name != name:
            return entity
        return replace(
            entity,
            world_from_object=pose @ entity.world_from_object,
            solids=tuple(moved(s, pose) for s in entity.solids),
            pieces=tuple(p + offset for p in entity.pieces),
        )

    return replace(room, entities=tuple(move(e) for e in room.entities))


@pytest.fixture(scope="module")
def rooms():
    return {
        (objects, seed): build_procedural_room(RoomSpec(seed=seed, objects=objects, **ROUGH))
        for objects, seed in ((5, 0), (12, 0), (12, 1), (40, 0))
    }


@pytest.mark.parametrize(("objects", "seed"), [(5, 0), (12, 0), (12, 1), (40, 0)])
def test_rooms_are_possible_and_everything_stands(rooms, objects, seed):
    check = validate_room(rooms[objects, seed])
    assert check.problems == ()
    assert check.physics["stable_rate"] == 1.0
    assert check.physics["floating_rate"] == 0.0
    assert check.physics["spawn_penetration_mm"] < 0.05


@pytest.mark.end_to_end
@pytest.mark.parametrize("preset", OF_OTHER_ROOMS)
@pytest.mark.parametrize(("objects", "seed"), [(5, 100), (12, 101), (20, 100), (40, 101)])
def test_rooms_of_all_presets_are_possible(preset, objects, seed):
    spec = replace(PRESETS[preset].room, objects=objects, seed=seed, **ROUGH)
    assert validate_room(build_procedural_room(spec)).problems == ()


@pytest.mark.parametrize("name", [*CI_CAPTURES, "stacked12", "containers20"])
def test_named_rooms_are_possible(name):
    spec = {**CI_CAPTURES, **SUITE}[name].room
    assert validate_room(build_procedural_room(replace(spec, **ROUGH))).problems == ()


def test_the_check_finds_what_is_wrong(rooms):
    room = rooms[12, 0]
    small = next(e for e in room.objects if not e.fixed and e.parent == room.entity("table_1").id)
    lifted = validate_room(with_shifted(room, small.name, (0, 0, 0.03)), duration_s=1.0)
    assert any(p.startswith(f"{small.name}: 0% of its bottom") for p in lifted.problems)
    sunk = validate_room(with_shifted(room, small.name, (0, 0, -0.005)), duration_s=0.5)
    assert any("overlap" in p and small.name in p for p in sunk.problems)
    aside = with_shifted(room, small.name, (3.0, 3.0, 0))  # far beyond the table, in mid-air
    assert any(p.startswith(f"{small.name} does not stand") for p in validate_room(aside, 1.0).problems)
    hanging = next(e for e in room.objects if e.relation == "attached_to")
    inwards = -0.01 * np.sign(hanging.world_from_object[:3, 3]) * (1, 1, 0)
    assert f"{hanging.name} does not touch" in " ".join(
        validate_room(with_shifted(room, hanging.name, inwards), 0.1).problems
    )


@pytest.mark.parametrize(("objects", "seed"), [(3, 0), (5, 1), (8, 2), (17, 3), (26, 4)])
def test_a_room_has_as_many_things_as_asked_for(objects, seed):
    plan = plan_room(RoomSpec(seed=seed, objects=objects))
    assert len(plan.items) == objects
    assert len({item.name for item in plan.items}) == objects


def test_relations_are_what_the_geometry_says(rooms):
    room = rooms[40, 0]
    by_id = {e.id: e for e in room.entities}
    meshes = {e.id: e.mesh() for e in room.entities}
    assert {e.relation for e in room.objects} == {"supported_by", "attached_to"}
    inside = 0
    for thing in room.objects:
        parent = by_id[thing.parent]
        if thing.relation == "attached_to":
            assert parent.label == "wall"
            assert thing.fixed
            continue
        assert carried_share(meshes[thing.id], meshes[parent.id]) > 0.7
        others = [e for e in room.entities if e.id not in (thing.id, parent.id)]
        assert all(carried_share(meshes[thing.id], meshes[o.id]) < 0.1 for o in others), thing.name
        if parent.label in ("bowl", "tray", "open box", "basket", "crate"):
            inside += 1
            low, high = meshes[parent.id].bounds
            assert np.all(meshes[thing.id].bounds[0, :2] > low[:2])
            assert np.all(meshes[thing.id].bounds[1, :2] < high[:2])
            assert meshes[thing.id].bounds[0, 2] > low[2]  # on its floor, not beside it
    assert inside >= 3


def levels(plan):
    """How many things of a stack are below and including each thing; furniture is 0."""
    return Counter(item.level for item in plan.items)


def test_stacks_are_as_high_as_allowed_and_no_higher():
    tall = [plan_room(RoomSpec(seed=s, objects=14, stacks=0.7, containers=0.0)) for s in range(3)]
    assert all(max(levels(p)) == 3 for p in tall)
    flat = plan_room(RoomSpec(seed=1, objects=14, stacks=0.7, containers=0.0, max_stack=1))
    assert max(levels(flat)) == 1
    pairs = plan_room(RoomSpec(seed=1, objects=14, stacks=0.7, containers=0.0, max_stack=2))
    assert max(levels(pairs)) == 2


def test_knobs_do_what_they_say():
    plain = furnish(plan_room(RoomSpec(seed=2, objects=10, textureless_share=0.6, blank_walls=True, **ROUGH)))

    def is_plain(entity):
        return all(np.ptp(plain.textures[p.texture].pixels, axis=(0, 1)).max() == 0 for p in entity.patches)

    assert sum(is_plain(e) for e in plain.objects) == 6
    assert all(is_plain(e) for e in plain.base)
    bare = plan_room(RoomSpec(seed=2, objects=14, containers=0.0, wall_things=0.0))
    assert not any(item.hangs for item in bare.items)
    assert not {item.key for item in bare.items} & {"bowl", "tray", "open_box", "basket", "crate"}
    many = plan_room(RoomSpec(seed=2, objects=14, containers=0.25, wall_things=0.3))
    assert sum(item.hangs for item in many.items) == 4
    assert (
        len({i.support for i in many.items if i.support.split("_")[0] in ("bowl", "tray", "open", "basket")})
        >= 2
    )
    assert len(build_procedural_room(RoomSpec(seed=0, objects=5, walls=4, **ROUGH)).base) == 5


@pytest.mark.parametrize("gap", [0.01, 0.1])
def test_neighbors_keep_their_gap(gap):
    plan = plan_room(RoomSpec(seed=3, objects=16, clutter_gap_m=gap, containers=0.0))
    standing = [i for i in plan.items if i.level == 1]
    assert len(standing) > 3
    closest = np.inf
    for number, a in enumerate(standing):
        for b in standing[number + 1 :]:
            if a.parent is b.parent and a.bottom_m < b.top_m and b.bottom_m < a.top_m:
                closest = min(closest, footprints.distance(a.silhouette, b.silhouette))
    assert closest >= gap


def test_crowding_moves_things_together():
    bare = dict.fromkeys(("stacks", "containers", "side_furniture", "wall_things"), 0.0)

    def spread(crowding):
        gaps = []
        for seed in range(3):
            spec = RoomSpec(seed=seed, objects=7, clutter_gap_m=0.01, crowding=crowding, **bare)
            _, *things = plan_room(spec).items
            for a in things:
                gaps.append(
                    min(footprints.distance(a.silhouette, b.silhouette) for b in things if b is not a)
                )
        assert min(gaps) >= 0.01
        return np.median(gaps)

    assert spread(1.0) < 0.5 * spread(0.0)
    assert spread(1.0) < 0.05


def test_the_same_spec_gives_the_same_room_and_another_seed_another():
    spec = RoomSpec(seed=6, objects=9, **ROUGH)
    one, two, other = (build_procedural_room(s) for s in (spec, spec, replace(spec, seed=7)))
    assert [e.name for e in one.entities] == [e.name for e in two.entities]
    for a, b in zip(one.entities, two.entities):
        assert np.array_equal(a.world_from_object, b.world_from_object)
        assert all(np.array_equal(p.vertices, q.vertices) for p, q in zip(a.patches, b.patches))
    assert all(np.array_equal(one.textures[k].pixels, two.textures[k].pixels) for k in one.textures)
    poses = [[e.world_from_object.tolist() for e in room.objects] for room in (one, other)]
    assert poses[0] != poses[1]


def test_round_things_lie_in_containers():
    rolling = 0
    for seed in range(3):
        plan = plan_room(RoomSpec(seed=seed, objects=16, containers=0.25))
        for item in plan.items:
            if KINDS[item.key].rolls:
                rolling += 1
                assert item.parent is not None
                assert any(c is item and p.inside for c, p in item.parent.children)
    assert rolling >= 3


@pytest.mark.parametrize("key", sorted(KINDS))
@pytest.mark.parametrize("seed", [0, 1])
def test_makers_give_closed_solids_of_one_shape_at_any_fineness(key, seed):
    import trimesh

    def make(step_m, density):
        return KINDS[key].make(Workshop(np.random.default_rng([seed, 5]), step_m, density), "x/")

    fine, coarse = Shape.of(make(0.02, 0.2)), Shape.of(make(COARSE, 0.01))
    assert np.allclose(fine.low, coarse.low, atol=1e-9)
    assert np.allclose(fine.high, coarse.high, atol=1e-9)
    assert {p.texture for part in fine.model.parts for p in part} <= set(fine.model.textures)
    for part in (*fine.model.parts, *coarse.model.parts):
        assert signed_volume(part) > 0
    assert sum(map(signed_volume, fine.model.parts)) == pytest.approx(
        sum(map(signed_volume, coarse.model.parts))
    )
    # Convex pieces fill the hollow thing, not its hollow; handles are cut coarsely.
    if coarse.model.pieces:
        filled = sum(trimesh.convex.convex_hull(p).volume for p in coarse.model.pieces)
        assert 0.9 < filled / coarse.volume < 1.12
        assert max(len(p) for p in coarse.model.pieces) <= 255  # as many as PhysX takes
        points = np.concatenate(coarse.model.pieces)
        assert np.all(points > coarse.low - 2e-3)
        assert np.all(points < coarse.high + 2e-3)
        assert points[:, 2].min() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"objects": 1}, "objects=1"),
        ({"walls": 2}, "walls=2"),
        ({"stacks": 1.5}, "stacks=1.5"),
        ({"textureless_share": -0.1}, "textureless_share=-0.1"),
    ],
)
def test_impossible_specs_are_refused(fields, said):
    with pytest.raises(UsageError, match=said):
        RoomSpec(**fields)


def test_a_room_too_crowded_says_what_to_lower():
    with pytest.raises(UsageError, match="lower objects, clutter_gap_m"):
        plan_room(RoomSpec(objects=4, clutter_gap_m=3.0, stacks=0.0, side_furniture=0.0, wall_things=0.0))


def test_bodies_hold_what_hangs_and_free_the_rest(rooms):
    room = rooms[12, 0]
    specs = {s.id: s for s in bodies(room, {e.id: e.mesh() for e in room.entities})}
    for entity in room.entities:
        assert specs[entity.id].base == entity.base
        assert specs[entity.id].dynamic == (entity.relation == "supported_by")
    assert list(overlaps(room, {e.id: e.mesh() for e in room.entities})) == []


# Polygons


def test_distance_of_polygons():
    a, b = footprints.rectangle(2, 1), footprints.rectangle(1, 1, 4, 0)
    assert footprints.distance(a, b) == pytest.approx(2.5)
    assert footprints.distance(a, footprints.rectangle(1, 1, 1.5 + 3, 1 + 4)) == pytest.approx(5.0)  # corners
    assert footprints.distance(a, footprints.rectangle(1, 1, 1.4, 0)) == pytest.approx(-0.1)  # overlap
    round_a, round_b = footprints.disc(0.5, 200), footprints.turned(footprints.disc(0.3, 200), 0.0, 1.0, 1.0)
    assert footprints.distance(round_a, round_b) == pytest.approx(np.sqrt(2) - 0.8, abs=1e-3)


def test_hull_area_intersection_and_depth():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (400, 2))
    hull = footprints.convex_hull(points)
    assert footprints.depth_inside(points, hull) == pytest.approx(0.0, abs=1e-8)
    assert 3.7 < footprints.area(hull) < 4.0
    square = footprints.rectangle(2, 2)
    common = footprints.intersection(square, footprints.rectangle(2, 2, 1, 1))
    assert footprints.area(common) == pytest.approx(1.0)
    assert len(footprints.intersection(square, footprints.rectangle(1, 1, 5, 0))) == 0
    assert footprints.depth_inside(np.array([[0.9, 0.0]]), square) == pytest.approx(0.1)
    tilted = footprints.turned(square, np.pi / 4, 1.0, 2.0)
    assert footprints.area(tilted) == pytest.approx(4.0)
    assert np.allclose(tilted.mean(0), (1, 2))
