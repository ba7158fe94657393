"""Usual sizes as evidence of metres: level surfaces are measured, and the posterior over the scale is honest."""

from dataclasses import replace

import numpy as np
import pytest
from notes import Notes
from test_world import FLOOR, WALLS, disturb, errors, film, table, walk

from reconstruction.world import WorldConfig, find_world
from reconstruction.world.floor import find_floor
from reconstruction.world.posterior import infer_scale
from reconstruction.world.samples import sample_surface
from reconstruction.world.supports import SupportSurface, highest_point, measure_supports

TABLE = SupportSurface(0.74, 1.0, 1.35, 0.78)
SEAT = SupportSurface(0.455, 0.2, 0.46, 0.42)
ODD = SupportSurface(1.75, 0.2, 0.7, 0.4)
CONFIG = WorldConfig(usual_sizes=True)


def infer(eye, supports=(), top=0.0):
    return infer_scale(eye, list(supports), top, camera_height_m=1.4, camera_sigma=0.2)


def scaled(surface: SupportSurface, factor: float) -> SupportSurface:
    lengths = {name: getattr(surface, name) * factor for name in ("height", "long", "short")}
    return replace(surface, area=surface.area * factor**2, **lengths)


def test_without_evidence_the_camera_decides():
    found = infer(2.8)
    assert found.per_unit == pytest.approx(0.5, rel=1e-3)
    assert found.sigma == pytest.approx(0.2, rel=0.02)
    assert found.parts == ()


@pytest.mark.parametrize("eye", [1.05, 1.4, 1.75])
def test_a_table_and_chairs_correct_the_camera(eye):
    found = infer(eye, [TABLE, SEAT])
    assert abs(np.log(found.per_unit)) < 0.05
    assert found.sigma < 0.1
    assert [name for name, _ in found.parts] == ["table or desk", "seat"]


def test_the_posterior_follows_the_unit():
    plain, double = infer(1.3, [TABLE, ODD], 2.3), infer(2.6, [scaled(s, 2) for s in (TABLE, ODD)], 4.6)
    assert double.per_unit == pytest.approx(plain.per_unit / 2, rel=1e-6)
    assert double.sigma == pytest.approx(plain.sigma, rel=1e-6)


def test_what_is_of_no_class_changes_little():
    alone, beside = infer(1.4, [TABLE]), infer(1.4, [TABLE, ODD])
    assert beside.per_unit == pytest.approx(alone.per_unit, rel=0.03)
    assert beside.parts[1][0] == "none of these"


def test_the_highest_point_lies_below_a_ceiling():
    free, under = infer(1.0), infer(1.0, top=2.3)
    assert under.per_unit < 0.9 * free.per_unit
    assert under.ceiling_counts
    assert not infer(1.4, top=1.0).ceiling_counts


def test_level_surfaces_of_a_room_are_measured():
    posed, depth = film([FLOOR, *WALLS, *table(0, 0)], walk(0))
    samples = sample_surface(posed, depth, CONFIG)
    floor = find_floor(samples)
    found = measure_supports(samples, floor.height, 1.4)[0]
    assert found.height == pytest.approx(0.74, abs=0.015)
    assert found.long == pytest.approx(1.2, abs=0.12)
    assert found.short == pytest.approx(0.8, abs=0.12)
    assert found.area == pytest.approx(0.96, rel=0.2)
    assert highest_point(samples, floor.height) <= 2.51


@pytest.mark.parametrize("height", [1.1, 1.75])
def test_a_table_of_usual_height_gives_metres_to_a_film_from_anywhere(height):
    posed, depth, true = disturb(*film([FLOOR, *WALLS, *table(0, 0)], walk(1, height=height)), 1)
    notes = Notes()
    world = find_world(posed, depth, CONFIG, progress=notes)
    assert world.scale.method == "usual-sizes"
    without = abs(np.log(errors(find_world(posed, depth, WorldConfig()), true)["scale"]))
    assert abs(np.log(errors(world, true)["scale"])) < 0.6 * without
    assert any("table or desk" in note for note in notes.notes)
