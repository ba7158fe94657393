"""Mass, materials and collision shapes of analytic solids."""

import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest

from reconstruction.assets.collision import collision_parts
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.physics.mass import mass_properties, physical_attributes, shell_properties
from reconstruction.assets.physics.materials import MATERIALS, MaterialChoice, choose_material
from reconstruction.assets.solid import box_solid, from_manifold, lighten, simplify_manifold, to_manifold


def bowl(outer=0.08, wall=0.006, height=0.06):
    """A cup with a flat floor, standing on z = 0."""
    manifold3d = pytest.importorskip("manifold3d")
    outside = manifold3d.Manifold.cylinder(height, outer, outer, 48)
    inside = manifold3d.Manifold.cylinder(height, outer - wall, outer - wall, 48).translate((0, 0, wall))
    return from_manifold(outside - inside)


def test_mass_of_a_box_is_exact():
    low, high = np.array([0.1, -0.2, 0.0]), np.array([0.3, 0.2, 0.1])
    volume, center, inertia = mass_properties(box_solid(low, high))
    size = high - low
    assert volume == pytest.approx(size.prod())
    np.testing.assert_allclose(center, (low + high) / 2, atol=1e-12)
    np.testing.assert_allclose(inertia, np.diag(size @ size - size**2) * volume / 12, atol=1e-12)


def test_inertia_of_a_shell_is_exact():
    """Compared with dense points on the surface of an asymmetric bowl."""
    solid = bowl()
    area, center, inertia = shell_properties(solid)
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(areas), 200_000, p=areas / areas.sum())
    u, v = rng.random((2, len(chosen), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    away = points - points.mean(axis=0)
    expected = area * (np.mean((away**2).sum(axis=1)) * np.eye(3) - away.T @ away / len(away))
    assert area == pytest.approx(areas.sum())
    np.testing.assert_allclose(center, points.mean(axis=0), atol=3e-4)
    np.testing.assert_allclose(inertia, expected, atol=0.01 * expected.max())


@pytest.mark.parametrize("name", sorted(MATERIALS))
@pytest.mark.parametrize("hollow", [False, True])
@pytest.mark.parametrize("filled", [None, (950.0, 1250.0)])
@pytest.mark.parametrize("sure", [False, True])
def test_physics_is_valid_and_within_its_ranges(name, hollow, filled, sure):
    solid = box_solid(np.array([-0.05, -0.05, 0]), np.array([0.05, 0.05, 0.2]))
    physics = physical_attributes(solid, MaterialChoice(name, hollow, filled, "test", sure))
    assert 0 < physics.mass_kg < 0.002 * max(physics.density_kg_m3, filled[1] if filled else 0) + 1e-9
    assert np.linalg.eigvalsh(physics.inertia).min() > 0
    for key in ("mass_kg", "friction", "restitution"):
        low, high = getattr(physics.ranges, key)
        assert low <= getattr(physics, key) <= high
        assert high > low


def test_a_guess_has_wider_ranges_than_a_label():
    size, brown = np.array([0.1, 0.1, 0.1]), np.array([150.0, 100.0, 60.0])
    solid = box_solid(np.zeros(3), size)
    known = physical_attributes(solid, choose_material("wood block", 0.9, brown, size)).ranges
    guess = physical_attributes(solid, choose_material("unknown", 0.0, brown, size)).ranges
    for key in ("mass_kg", "friction", "restitution"):
        (low, high), (least, most) = getattr(known, key), getattr(guess, key)
        assert least <= low
        assert high <= most
    assert guess.mass_kg[1] > 2 * known.mass_kg[1]


def test_a_package_is_between_empty_and_full():
    """A half-liter can: 13 to 20 g of metal empty (0.2 to 0.3 mm walls), about half a kilo full."""
    manifold3d = pytest.importorskip("manifold3d")
    can = from_manifold(manifold3d.Manifold.cylinder(0.168, 0.033, 0.033, 48))
    physics = physical_attributes(can, choose_material("can", 0.9, np.zeros(3), can.extents))
    low, high = physics.ranges.mass_kg
    assert 0.01 < low < 0.04
    assert 0.5 < physics.mass_kg < 0.6
    assert 0.6 < high < 0.8


def test_the_last_word_of_a_label_decides():
    extents = np.array([0.1, 0.1, 0.2])
    assert choose_material("milk carton", 0.9, np.zeros(3), extents).name == "paper"
    assert choose_material("mug", 0.9, np.zeros(3), extents).name == "ceramic"
    assert choose_material("mug", 0.1, np.full(3, 200.0), extents).name == "unknown"


def test_a_box_collides_as_one_hull_with_its_own_bounds():
    solid = box_solid(np.array([-0.1, -0.2, 0.0]), np.array([0.1, 0.2, 0.05]))
    (part,) = collision_parts(solid, AssetsConfig())
    np.testing.assert_allclose(part.vertices.min(axis=0), [-0.1, -0.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(part.vertices.max(axis=0), [0.1, 0.2, 0.05], atol=1e-6)


def test_a_cup_stays_hollow_and_keeps_its_bounds():
    solid = bowl()
    parts = collision_parts(solid, AssetsConfig())
    every = np.concatenate([p.vertices for p in parts])
    np.testing.assert_allclose(every.min(axis=0), solid.vertices.min(axis=0), atol=0.002)
    np.testing.assert_allclose(every.max(axis=0), solid.vertices.max(axis=0), atol=0.002)
    assert max(len(p.vertices) for p in parts) <= 64
    for part in parts:  # no part reaches the middle of the cavity
        corner = part.vertices[part.faces].astype(float)
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        assert (np.einsum("nk,nk->n", normal, np.array([0, 0, 0.035]) - corner[:, 0]) > 0).any()


def test_collision_is_deterministic():
    a, b = (collision_parts(bowl(), AssetsConfig()) for _ in range(2))
    assert len(a) == len(b)
    for one, other in zip(a, b):
        np.testing.assert_array_equal(one.vertices, other.vertices)


def test_decimation_keeps_the_solid_closed():
    manifold3d = pytest.importorskip("manifold3d")
    ball = from_manifold(manifold3d.Manifold.sphere(0.05, 128))
    light = lighten(ball, 500, 0.001)
    assert len(light.faces) <= 500
    assert to_manifold(light) is not None
    assert light.volume == pytest.approx(ball.volume, rel=0.03)


def test_decimations_on_several_threads_do_not_mix(request):
    manifold3d = pytest.importorskip("manifold3d")
    balls = [from_manifold(manifold3d.Manifold.sphere(1.0 + k, 96)) for k in range(4)] * 4
    alone = [lighten(ball, 300, 0.01).vertices for ball in balls]
    request.addfinalizer(partial(sys.setswitchinterval, sys.getswitchinterval()))
    sys.setswitchinterval(1e-6)
    with ThreadPoolExecutor(4) as pool:
        for one, other in zip(alone, pool.map(lambda ball: lighten(ball, 300, 0.01).vertices, balls)):
            np.testing.assert_array_equal(one, other)


def test_decimation_keeps_parts_thinner_than_its_tolerance():
    manifold3d = pytest.importorskip("manifold3d")
    ball = from_manifold(manifold3d.Manifold.sphere(0.002, 128))
    light = simplify_manifold(ball, 100, 0.01)
    assert light.volume == pytest.approx(ball.volume, rel=0.11)


@pytest.mark.end_to_end
def test_a_ball_dropped_into_a_cup_stays_there():
    sapien = pytest.importorskip("sapien")
    import tempfile
    from pathlib import Path

    from reconstruction.assets.gltf import write_obj

    scene = sapien.physx.PhysxCpuSystem()
    scene.timestep = 1 / 240
    cup = sapien.Entity()
    body = sapien.physx.PhysxRigidStaticComponent()
    material = sapien.physx.PhysxMaterial(0.4, 0.4, 0.1)
    with tempfile.TemporaryDirectory() as folder:
        for number, part in enumerate(collision_parts(bowl(), AssetsConfig())):
            path = Path(folder) / f"{number}.obj"
            write_obj(part, path)
            body.attach(sapien.physx.PhysxCollisionShapeConvexMesh(str(path), np.ones(3), material))
    cup.add_component(body)
    ball = sapien.Entity()
    moving = sapien.physx.PhysxRigidDynamicComponent()
    moving.attach(sapien.physx.PhysxCollisionShapeSphere(0.0125, material))
    ball.add_component(moving)
    ball.set_pose(sapien.Pose([0.01, 0, 0.12]))
    world = sapien.Scene([scene])
    world.add_entity(cup)
    world.add_entity(ball)
    for _ in range(720):
        world.step()
    x, y, z = ball.pose.p
    assert np.hypot(x, y) < 0.08
    assert 0.01 < z < 0.04, "the ball rests on the cup's floor, not on a filled cavity"


def _field_of(boxes, voxel_m=0.01):
    """Return a field that is inside in each of some boxes (low, high)."""
    from types import SimpleNamespace

    axes = [np.arange(-0.05, top, voxel_m) + voxel_m / 2 for top in (1.05, 0.65, 0.55)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    distance = np.full(grid.shape[:3], 1.0)
    for low, high in boxes:
        outside = np.maximum(np.asarray(low) - grid, grid - np.asarray(high)).max(axis=-1)
        distance = np.minimum(distance, outside)
    return SimpleNamespace(distance=distance.astype(np.float32), origin=np.full(3, -0.05), voxel_m=voxel_m)


def test_detached_legs_stay_and_reach_the_top():
    from reconstruction.assets.solid import extract

    top = ((0.0, 0.0, 0.40), (1.0, 0.6, 0.46))
    legs = [((x, y, 0.0), (x + 0.05, y + 0.05, 0.37)) for x in (0.05, 0.9) for y in (0.05, 0.5)]
    crumb = ((0.4, 0.3, 0.50), (0.45, 0.33, 0.52))
    body = extract(_field_of([top, *legs, crumb]))
    assert body.vertices[:, 2].min() == pytest.approx(0.0, abs=0.01)  # the legs stand on the floor ...
    assert body.vertices[:, 2].max() < 0.48  # ... and the crumb on the top is gone
    below = body.vertices[body.vertices[:, 2] < 0.405]
    near_leg = below[(below[:, 0] < 0.11) & (below[:, 1] < 0.11)]
    assert near_leg[:, 2].max() >= 0.395  # no gap of 3 cm below the top


def test_a_detached_rail_with_many_seen_points_is_no_crumb():
    """It has less than a hundredth of the volume, but many of the seen points."""
    from reconstruction.assets.solid import extract

    seat, rail = ((0.0, 0.0, 0.0), (1.0, 0.6, 0.30)), ((0.05, 0.0, 0.44), (0.95, 0.03, 0.49))
    front = np.random.default_rng(0).uniform([0.0, 0.0, 0.0], [1.0, 0.0, 0.3], (900, 3))
    on_rail = np.random.default_rng(1).uniform([0.05, 0.0, 0.44], [0.95, 0.0, 0.49], (30, 3))
    field = _field_of([seat, rail])
    assert extract(field).vertices[:, 2].max() < 0.32
    assert extract(field, front).vertices[:, 2].max() < 0.32
    assert extract(field, np.concatenate([front, on_rail])).vertices[:, 2].max() > 0.47
