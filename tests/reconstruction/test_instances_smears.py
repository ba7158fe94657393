"""Surface that is smeared from a thing to the wall behind it goes to the wall; a thing of the wall's color stays."""

import numpy as np
import pytest
from surfaces import filmed, looking_at, merged, sheet, solid_box, surface_from

from reconstruction.instances import InstancesConfig
from reconstruction.instances.cut import Shell
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.sightings import sightings
from reconstruction.instances.smears import without_smears, without_wall_bumps
from reconstruction.progress import NO_PROGRESS
from reconstruction.types import Camera

LOW, HIGH = (-0.08, 0.3, 0.0), (0.08, 0.42, 0.25)
WALL_Y = 0.6


def carton_before_wall(color, striped, at_x=(0.0,)):
    """Cartons before a wall, as fused with smears from their sides to the wall, and films of the truth."""
    room = (
        sheet((-1.0, -1.0, 0.0), (2.0, 0, 0), (0, 1.0 + WALL_Y, 0), (120, 100, 80), 0.025),
        sheet((-1.0, WALL_Y, 0.0), (2.0, 0, 0), (0, 0, 1.8), (200, 200, 190), 0.02),
    )
    away = WALL_Y - 0.02 - HIGH[1]
    cartons, smears = [], []
    for x in at_x:
        cartons.append(solid_box(np.add(LOW, (x, 0, 0)), np.add(HIGH, (x, 0, 0)), color))
        left, right = x + LOW[0] - 0.1, x + HIGH[0]
        smears.append(sheet((left, HIGH[1] + away, 0.0), (0.1, -away, 0), (0, 0, 0.25), (170, 170, 165)))
        smears.append(sheet((right, HIGH[1], 0.0), (0.1, away, 0), (0, 0, 0.25), (170, 170, 165)))
    surface = surface_from(merged(*room, *cartons, *smears))
    truth = merged(*room, *cartons)
    paint = truth.colors.copy()
    stripes = (
        striped & (truth.vertices[:, 1] > WALL_Y - 1e-3) & (np.floor(truth.vertices[:, 0] / 0.2) % 2 == 0)
    )
    paint[stripes] = (90, 150, 120)
    middle = np.array([0.0, 0.36, 0.15])
    places = [(x, -1.0, z) for z in (0.5, 0.8) for x in (-0.6, -0.3, 0.0, 0.3, 0.6)]
    poses = np.stack([looking_at(middle + place, middle) for place in places])
    camera = Camera(240, 180, 220.0, 220.0, 120.0, 90.0)
    return surface, *filmed(truth, paint, surface, poses, camera)


def cleaned(color, striped=True, at_x=(0.0,), on_furniture=False):
    """Return the shell, the thing's vertices before and after, who owns what, and what of it is smear."""
    surface, posed, depth = carton_before_wall(color, striped, at_x)
    shell = Shell.of(surface, NO_PROGRESS)
    points = shell.graph.points
    thing = Thing(np.flatnonzero((shell.owner == 0) & (points[:, 2] > 0.02)))
    if on_furniture:
        thing.rests_on = Thing(np.flatnonzero(points[:, 2] < 1e-3))
    before, owner = thing.vertices, shell.owner.copy()
    without_smears(shell, [thing], owner, sightings(surface, posed, depth), InstancesConfig(), NO_PROGRESS)
    smear = before[points[before, 1] > HIGH[1] + 0.02]
    return shell, before, thing.vertices, owner, smear


def test_smears_go_to_the_wall():
    shell, before, after, owner, smear = cleaned((180, 40, 40))
    assert len(smear) > 200
    assert np.isin(smear, after).mean() < 0.25
    front = np.setdiff1d(before, before[shell.graph.points[before, 1] > HIGH[1] - 0.01])
    assert np.isin(front, after).mean() > 0.98
    wall = next(base.id for base in shell.base if base.label == "wall")
    assert (owner[np.setdiff1d(before, after)] == wall).all()


def test_what_has_the_color_of_the_wall_is_not_taken_apart():
    shell, before, after, _, smear = cleaned((200, 200, 190), striped=False)
    assert any(base.label == "wall" for base in shell.base)
    assert len(smear) > 200
    np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize(
    ("half_m", "on_furniture", "freed"),
    [(0.35, True, True), (0.35, False, False), (0.45, True, False)],
    ids=["1.06 m on furniture", "1.06 m on the floor", "1.26 m on furniture"],
)
def test_smears_of_a_long_group_go_to_the_wall_if_it_lies_on_furniture(half_m, on_furniture, freed):
    """What stands on the floor and is as long is furniture itself, and may have the wall's color."""
    _, before, after, _, smear = cleaned((180, 40, 40), at_x=(-half_m, half_m), on_furniture=on_furniture)
    assert len(smear) > 400
    if freed:
        assert np.isin(smear, after).mean() < 0.35
        assert np.isin(np.setdiff1d(before, smear), after).mean() > 0.8
    else:
        np.testing.assert_array_equal(before, after)


def hung_box(color, seen, carries=False):
    """Return a box that hangs on a striped wall in the surface, and in the film only if it is `seen`; who owns it."""
    wall = sheet((-1.0, WALL_Y, 0.0), (2.0, 0, 0), (0, 0, 1.8), (200, 200, 190), 0.02)
    floor = sheet((-1.0, -1.0, 0.0), (2.0, 0, 0), (0, 1.0 + WALL_Y, 0), (120, 100, 80), 0.025)
    box = solid_box((-0.1, WALL_Y - 0.06, 0.5), (0.1, WALL_Y - 0.01, 0.7), color)
    surface, truth = surface_from(merged(floor, wall, box)), merged(floor, wall, *([box] if seen else []))
    paint = truth.colors.copy()
    on_wall = truth.vertices[:, 1] > WALL_Y - 1e-3
    paint[on_wall & (np.floor(truth.vertices[:, 0] / 0.2) % 2 == 0)] = (90, 150, 120)
    middle = np.array([0.0, WALL_Y, 0.6])
    places = [(x, -1.3, z) for z in (-0.1, 0.2) for x in (-0.5, -0.25, 0.0, 0.25, 0.5)]
    poses = np.stack([looking_at(middle + place, middle) for place in places])
    posed, depth = filmed(truth, paint, surface, poses, Camera(240, 180, 220.0, 220.0, 120.0, 90.0))
    shell = Shell.of(surface, NO_PROGRESS)
    points, owner = shell.graph.points, shell.owner.copy()
    hung = np.flatnonzero((points[:, 1] < WALL_Y - 0.005) & (points[:, 2] > 0.4))
    owner[hung] = 0
    things = [Thing(hung, attached=True)]
    if carries:
        things.append(Thing(hung[:10], rests_on=things[0]))
    left = without_wall_bumps(shell, things, owner, sightings(surface, posed, depth))
    return shell, hung, owner, left


def test_bump_that_looks_like_the_wall_is_the_walls():
    shell, hung, owner, left = hung_box((150, 150, 150), seen=False)
    wall = next(base.id for base in shell.base if base.label == "wall")
    assert len(hung) > 100
    assert not left
    assert (owner[hung] == wall).all()


def test_hung_thing_of_its_own_color_stays():
    _, hung, owner, left = hung_box((180, 40, 40), seen=True)
    assert [len(thing.vertices) for thing in left] == [len(hung)]
    assert (owner[hung] == 0).all()


def test_bump_that_carries_something_stays():
    _, hung, owner, left = hung_box((150, 150, 150), seen=False, carries=True)
    assert len(left) == 2
    assert (owner[hung] == 0).all()
