"""The world frame of generated rooms: gravity, yaw, floor and metres are found whatever the sfm space is."""

from dataclasses import replace

import numpy as np
import pytest
from notes import Notes

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, VideoSource, WorldFrame
from reconstruction.world import WorldConfig, find_world, rescale_for_object
from registry.errors import InputError, UsageError
from registry.geometry import matrix_from_quat, rigid, split_similarity

pytestmark = pytest.mark.stage

CAMERA = Camera(240, 180, 200.0, 200.0, 120.0, 90.0)
BOX_FACES = np.array(
    [
        *([0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4]),
        *([1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]),
    ]
)


def box(low: tuple, high: tuple, yaw_deg: float = 0.0, tilt_deg: float = 0.0) -> np.ndarray:
    """Return the corners (8, 3) of a box, turned about its centre."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    corners = np.array([[x, y, z] for z in (z0, z1) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))])
    yaw, tilt = np.radians(yaw_deg) / 2, np.radians(tilt_deg) / 2
    turn = matrix_from_quat([np.cos(yaw), 0, 0, np.sin(yaw)]) @ matrix_from_quat(
        [np.cos(tilt), np.sin(tilt), 0, 0]
    )
    centre = corners.mean(axis=0)
    return ((corners - centre) @ turn.T + centre).astype(np.float64)


def table(x: float, y: float, top: float = 0.74) -> list[np.ndarray]:
    legs = [(x + i, y + j) for i in (-0.55, 0.5) for j in (-0.35, 0.3)]
    return [box((x - 0.6, y - 0.4, top - 0.04), (x + 0.6, y + 0.4, top))] + [
        box((i, j, 0), (i + 0.05, j + 0.05, top - 0.04)) for i, j in legs
    ]


FLOOR = box((-2.5, -2.5, -0.1), (2.5, 2.5, 0))
WALLS = [box((-2.5, 1.9, 0), (2.5, 2.0, 2.5)), box((-2.1, -2.5, 0), (-2.0, 2.5, 2.5))]
THINGS = [
    box((-0.3, -0.2, 0.74), (-0.1, 0.1, 0.9), yaw_deg=20),
    box((0.1, 0.0, 0.74), (0.4, 0.2, 0.78), yaw_deg=-35),
    box((0.9, 0.9, 0.0), (1.4, 1.3, 0.5), yaw_deg=15),
]
ROOM = [FLOOR, *WALLS, *table(0, 0), *THINGS]


def look(eye: tuple, target: tuple, roll_deg: float = 0.0) -> np.ndarray:
    """Return world_from_camera of a camera that looks from `eye` at `target`."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    half = np.radians(roll_deg) / 2
    return rigid(rotation @ matrix_from_quat([np.cos(half), 0, 0, np.sin(half)]), np.array(eye))


def walk(seed: int, count: int = 14, height: float = 1.4, target: tuple = (0, 0, 0.7), radius: float = 1.9):
    """Return cameras (n, 4, 4) on an arc around a target, with hand-held roll and aim."""
    rng = np.random.default_rng(seed)
    poses = []
    for angle in np.linspace(-2.2, 0.3, count):
        eye = (
            target[0] + radius * np.cos(angle),
            target[1] + radius * np.sin(angle),
            height + rng.normal(0, 0.04),
        )
        poses.append(look(eye, np.add(target, rng.normal(0, 0.08, 3)), rng.normal(1.5, 2.5)))
    return np.stack(poses)


def film(boxes: list[np.ndarray], poses: np.ndarray) -> tuple[PosedFrames, DepthMaps]:
    """Return the true depth maps of boxes and their cameras, in world space."""
    vertices = np.concatenate(boxes)
    faces = np.concatenate([BOX_FACES + 8 * i for i in range(len(boxes))])
    depth = np.stack([rasterize_mesh(vertices, faces, CAMERA, pose).depth for pose in poses])
    n, size = len(poses), (CAMERA.height, CAMERA.width, 3)
    posed = PosedFrames(
        source=VideoSource("room", "0" * 64, 2 * CAMERA.width, 2 * CAMERA.height, 30.0, 10 * n, n / 3),
        camera=CAMERA,
        images=np.full((n, *size), 128, np.uint8),
        indices=10 * np.arange(n, dtype=np.int32) + 1,
        times_s=np.arange(n) / 3,
        world_from_camera=poses,
        sharpness=np.ones(n, np.float32),
        held_out_images=np.full((1, *size), 128, np.uint8),
        held_out_indices=np.array([0], np.int32),
        held_out_times_s=np.zeros(1),
        held_out_world_from_camera=poses[:1],
        points=np.zeros((0, 3)),
        point_colors=np.zeros((0, 3), np.uint8),
        point_errors_px=np.zeros(0, np.float32),
        observations=np.zeros((0, 2), np.int32),
        chosen_frames=n,
        ordered=True,
        reprojection_error_px=0.3,
    )
    return posed, DepthMaps(CAMERA, depth, np.where(depth > 0, 2, 0).astype(np.uint8))


def disturb(posed: PosedFrames, depth: DepthMaps, seed: int, noise: float = 0.01, holes: float = 0.4):
    """Move the capture into a random sfm space and spoil its depth; also return the true world_from_sfm."""
    rng = np.random.default_rng(seed)
    tilt, about, spin = np.radians(rng.uniform(0, 40)), rng.uniform(0, 2 * np.pi), rng.uniform(0, np.pi)
    axis = np.array([np.cos(about), np.sin(about), 0]) * np.sin(tilt / 2)
    rotation = matrix_from_quat([np.cos(tilt / 2), *axis]) @ matrix_from_quat(
        [np.cos(spin), 0, 0, np.sin(spin)]
    )
    scale, shift = 10 ** rng.uniform(-1, 1), rng.normal(size=3) * 5

    def move(poses: np.ndarray) -> np.ndarray:
        return np.stack([rigid(rotation @ p[:3, :3], scale * rotation @ p[:3, 3] + shift) for p in poses])

    z = depth.depth * scale * (1 + noise * rng.standard_normal(depth.depth.shape))
    z *= rng.choice([1.0, 0.6, 1.7], size=z.shape, p=[0.99, 0.005, 0.005])
    z[rng.random(z.shape) < holes] = 0
    sfm = replace(
        posed,
        world_from_camera=move(posed.world_from_camera),
        held_out_world_from_camera=move(posed.held_out_world_from_camera),
    )
    spoiled = DepthMaps(depth.camera, z.astype(np.float32), np.where(z > 0, 2, 0).astype(np.uint8))
    return sfm, spoiled, np.linalg.inv(rigid(scale * rotation, shift))


def errors(world: WorldFrame, true: np.ndarray) -> dict[str, float]:
    """Compare with the true world_from_sfm."""
    scale, rotation, _ = split_similarity(world.world_from_sfm)
    true_scale, true_rotation, _ = split_similarity(true)
    turn = rotation @ true_rotation.T
    found_from_true = world.world_from_sfm @ np.linalg.inv(true)
    return {
        "gravity_deg": float(np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1)))),
        "yaw_deg": float((np.degrees(np.arctan2(turn[1, 0], turn[0, 0])) + 45) % 90 - 45),
        "floor_m": float(found_from_true[2, 3] / scale * true_scale),
        "scale": scale / true_scale,
    }


@pytest.fixture(scope="module")
def room():
    return film(ROOM, walk(0))


@pytest.mark.parametrize("seed", range(6))
def test_a_spoiled_room_in_any_sfm_space_is_set_upright(room, seed):
    posed, depth, true = disturb(*room, seed)
    world = find_world(posed, depth, WorldConfig())
    found = errors(world, true)
    assert found["gravity_deg"] < 0.3
    assert abs(found["yaw_deg"]) < 1.0
    assert abs(found["floor_m"]) < 0.01
    assert world.floor_observed
    assert world.yaw_snapped
    assert world.scale.method == "camera-height-prior"
    assert abs(np.log(found["scale"])) < 2 * world.scale.uncertainty
    assert found["gravity_deg"] < 2 * world.gravity_sigma_deg


def test_the_world_does_not_depend_on_the_sfm_space(room):
    worlds = []
    for seed in (1, 2):
        posed, depth, true = disturb(*room, seed, noise=0, holes=0)
        world = find_world(posed, depth, WorldConfig())
        worlds.append(world.world_from_sfm @ np.linalg.inv(true))
    np.testing.assert_allclose(worlds[0], worlds[1], atol=0.05)


def test_the_cameras_look_along_plus_y(room):
    posed, depth, _ = disturb(*room, 3)
    moved = find_world(posed, depth, WorldConfig()).apply_to(posed)
    forward = moved.world_from_camera[:, :3, 2].mean(axis=0)
    assert forward[1] > abs(forward[0])


def test_equal_inputs_give_equal_bits(room):
    posed, depth, _ = disturb(*room, 4)
    first, second = (find_world(posed, depth, WorldConfig()) for _ in range(2))
    np.testing.assert_array_equal(first.world_from_sfm, second.world_from_sfm)
    assert first.scale == second.scale


def test_steep_looks_do_not_turn_the_room(room):
    poses = walk(5, height=1.9, radius=0.9, target=(0, 0, 0.5))
    posed, depth, true = disturb(*film(ROOM, poses), 5)
    world = find_world(posed, depth, WorldConfig())
    assert errors(world, true)["gravity_deg"] < 0.5
    assert abs(errors(world, true)["floor_m"]) < 0.02


def rolled(poses: np.ndarray, roll_deg: float, seed: int) -> np.ndarray:
    """Return cameras all held askew, about their own axis."""
    out, rng = poses.copy(), np.random.default_rng(seed)
    for pose in out:
        half = np.radians(roll_deg + rng.normal(0, 3)) / 2
        pose[:3, :3] = pose[:3, :3] @ matrix_from_quat([np.cos(half), 0, 0, np.sin(half)])
    return out


@pytest.mark.parametrize("roll_deg", [-22.0, 10.0])
def test_a_camera_held_askew_all_the_time_does_not_tilt_the_room(roll_deg):
    posed, depth, true = disturb(*film(ROOM, rolled(walk(2), roll_deg, 2)), 2)
    assert errors(find_world(posed, depth, WorldConfig()), true)["gravity_deg"] < 0.5


def test_a_slanted_roof_does_not_tilt_the_world():
    roof = box((-2.4, -1.5, 2.0), (2.4, 1.9, 2.1), tilt_deg=25)
    posed, depth, true = disturb(*film([*ROOM, roof], walk(3, height=1.2, target=(0, 0.5, 1.3))), 3)
    world = find_world(posed, depth, WorldConfig())
    assert errors(world, true)["gravity_deg"] < 0.5
    assert abs(errors(world, true)["floor_m"]) < 0.01


def test_slanted_things_do_not_tilt_the_world():
    slanted = [
        box((0.6, -1.2, 0.1), (1.6, -0.2, 0.15), tilt_deg=12),
        box((-1.5, 0.4, 0.3), (-0.7, 1.2, 0.35), tilt_deg=9),
    ]
    posed, depth, true = disturb(*film([*ROOM, *slanted], walk(6)), 6)
    assert errors(find_world(posed, depth, WorldConfig()), true)["gravity_deg"] < 0.5


def test_without_walls_furniture_and_floor_are_enough():
    posed, depth, true = disturb(*film([FLOOR, *table(0, 0), *THINGS], walk(7)), 7)
    world = find_world(posed, depth, WorldConfig())
    assert errors(world, true)["gravity_deg"] < 0.5
    assert abs(errors(world, true)["floor_m"]) < 0.01


def test_mirror_images_below_a_glossy_floor_do_not_lower_it():
    posed, depth = film(ROOM, walk(8))
    mirrored = film([b * [1, 1, -1] for b in ROOM[1:]], walk(8))[1].depth
    rng = np.random.default_rng(8)
    patches = rng.random((len(mirrored), 18, 24)) < 0.15
    patches = patches.repeat(10, axis=1).repeat(10, axis=2)
    spoiled = np.where(patches & (mirrored > depth.depth), mirrored, depth.depth)
    posed, depth, true = disturb(posed, replace(depth, depth=spoiled), 8)
    world = find_world(posed, depth, WorldConfig())
    assert world.floor_observed
    assert abs(errors(world, true)["floor_m"]) < 0.02


def test_a_level_patch_of_noise_far_below_is_no_floor():
    """Where a camera only turns, depth may be many rooms away; there a patch covers more area than the floor."""
    posed, depth = film(ROOM, walk(8))
    rays = depth.camera.pixel_rays() @ np.swapaxes(posed.world_from_camera[:, None, :3, :3], -1, -2)
    far = (posed.world_from_camera[:, 2, 3, None, None] + 40) / -np.minimum(rays[..., 2], -1e-3)
    spoiled = depth.depth.copy()
    patch = np.s_[:, 120:, 180:]
    spoiled[patch] = np.where(rays[patch][..., 2] < -0.1, far[patch], spoiled[patch])
    posed, depth, true = disturb(posed, replace(depth, depth=spoiled.astype(np.float32)), 8)
    world = find_world(posed, depth, WorldConfig())
    assert world.floor_observed
    assert abs(errors(world, true)["floor_m"]) < 0.02


def test_a_table_top_is_no_floor():
    # The floor itself gives no depth (it is blank); the legs and a low box beside the table do.
    boxes = [*table(0, 0), *THINGS, box((0.75, -0.6, 0.1), (1.1, -0.2, 0.45))]
    posed, depth, true = disturb(*film(boxes, walk(9)), 9)
    notes = Notes()
    world = find_world(posed, depth, WorldConfig(), progress=notes)
    assert not world.floor_observed
    assert any("no floor is in view" in note for note in notes.notes)
    assert abs(errors(world, true)["floor_m"]) < 0.15
    assert world.scale.uncertainty > 0.2
    assert abs(np.log(errors(world, true)["scale"])) < 2 * world.scale.uncertainty


def test_a_wall_alone_gets_an_assumed_floor_below_everything():
    wall = box((-2, 1.9, 0.5), (2, 2.0, 2.5))
    trophies = [box((-0.3, 1.7, 1.2), (0.1, 1.9, 1.6)), box((0.6, 1.85, 1.3), (0.9, 1.9, 1.7))]
    poses = np.stack(
        [look((x, 0.6, 1.5 + 0.1 * x), (0, 1.9, 1.4), roll_deg=1.0) for x in np.linspace(-0.6, 0.6, 12)]
    )
    posed, depth, true = disturb(*film([wall, *trophies], poses), 10)
    notes = Notes()
    world = find_world(posed, depth, WorldConfig(), progress=notes)
    assert not world.floor_observed
    assert errors(world, true)["gravity_deg"] < 2.5  # the cameras' roll decides
    assert errors(world, true)["gravity_deg"] < 2.5 * world.gravity_sigma_deg
    assert any("no floor is in view" in note for note in notes.notes)
    points = (
        np.stack([[x, 1.9, 0.55, 1] for x in (-0.5, 0.5)]) @ (world.world_from_sfm @ np.linalg.inv(true)).T
    )
    assert (points[:, 2] > 0).all()
    heights = world.apply_to(posed).world_from_camera[:, 2, 3]
    assert 0.8 < np.median(heights) < 2.5


@pytest.mark.parametrize("elevation_deg", [-65, -58, -45])
def test_a_table_from_above_is_level(elevation_deg):
    top, rise = 0.74, np.tan(np.radians(-elevation_deg))
    eyes = [(x, -0.6, top + 0.6 * rise) for x in np.linspace(-0.25, 0.25, 12)]
    poses = np.stack([look(eye, (eye[0], 0, top), roll_deg=0.5) for eye in eyes])
    things = [box((-0.3, -0.2, top), (-0.1, 0.1, 0.9)), box((0.1, 0.0, top), (0.4, 0.2, 0.78), yaw_deg=-35)]
    posed, depth, true = disturb(*film([box((-1.2, -0.8, 0.7), (1.2, 0.8, top)), *things], poses), 12)
    assert errors(find_world(posed, depth, WorldConfig()), true)["gravity_deg"] < 1.5


@pytest.mark.parametrize("elevation_deg", [-10, 5, 15])
def test_a_wall_from_below_is_upright(elevation_deg):
    eyes = [(x, 0.6, 1.5 - 1.3 * np.tan(np.radians(elevation_deg))) for x in np.linspace(-0.4, 0.4, 12)]
    poses = np.stack([look(eye, (eye[0], 1.9, 1.5), roll_deg=0.5) for eye in eyes])
    things = [box((-0.3, 1.7, 1.2), (0.1, 1.9, 1.6)), box((0.6, 1.85, 1.3), (0.9, 1.9, 1.7))]
    posed, depth, true = disturb(*film([box((-2, 1.9, 0), (2, 2.0, 3)), *things], poses), 13)
    assert errors(find_world(posed, depth, WorldConfig()), true)["gravity_deg"] < 3


def test_empty_depth_is_an_input_error(room):
    posed, depth = room
    empty = replace(depth, depth=np.zeros_like(depth.depth), confidence=np.zeros_like(depth.confidence))
    with pytest.raises(InputError, match="almost empty"):
        find_world(posed, empty, WorldConfig())


# ---- Metres.


def test_camera_height_of_the_user_sets_the_scale(room):
    posed, depth, true = disturb(*room, 11)
    height = float(np.median(room[0].world_from_camera[:, 2, 3]))
    world = find_world(posed, depth, WorldConfig(scale=f"camera-height={height:.4f}"))
    assert world.scale.method == "user-camera-height"
    assert errors(world, true)["scale"] == pytest.approx(1, abs=0.01)


def test_metric_poses_keep_their_metres_until_the_user_knows_better(room):
    posed, depth = room
    posed = replace(posed, metric=True)
    world = find_world(posed, depth, WorldConfig())
    assert world.scale.method == "imported-poses"
    assert errors(world, np.eye(4))["scale"] == pytest.approx(1, abs=1e-9)
    assert 0.01 < world.scale.uncertainty < 0.1
    assert (
        find_world(posed, depth, WorldConfig(scale="camera-height=2.8")).scale.method == "user-camera-height"
    )


def _pixel(posed: PosedFrames, row: int, point: np.ndarray) -> np.ndarray:
    camera = np.linalg.inv(posed.world_from_camera[row]) @ [*point, 1]
    xy = camera[:2] / camera[2] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
    return 2 * xy  # the source video is twice as large


@pytest.mark.parametrize("frame", [31, 0])
def test_a_distance_between_two_pixels_sets_the_scale(room, frame):
    row = frame // 10
    ends = np.array([[-0.5, -0.3, 0.74], [0.5, -0.3, 0.74]])
    (x1, y1), (x2, y2) = (_pixel(room[0], row, p) for p in ends)
    text = f"distance:{frame},{x1:.2f},{y1:.2f},{x2:.2f},{y2:.2f}=1.0"
    posed, depth, true = disturb(*room, 12)
    world = find_world(posed, depth, WorldConfig(scale=text))
    assert world.scale.method == "user-distance"
    assert errors(world, true)["scale"] == pytest.approx(1, abs=2 * world.scale.uncertainty)
    assert world.scale.uncertainty < 0.05


def test_a_distance_in_a_frame_without_camera_names_those_that_have_one(room):
    with pytest.raises(UsageError, match=r"frame 37 has no camera.*nearest ones that have are 21, 31, 41"):
        find_world(*room, WorldConfig(scale="distance:37,10,10,50,50=1"))
    with pytest.raises(UsageError, match="outside the video, which is 480 x 360"):
        find_world(*room, WorldConfig(scale="distance:31,10,10,500,50=1"))


def test_an_object_height_is_provisional_first_and_exact_then(room):
    posed, depth, true = disturb(*room, 13)
    notes = Notes()
    first = find_world(posed, depth, WorldConfig(scale="object:3.height=0.74"), progress=notes)
    assert first.scale.method == "camera-height-prior"
    assert any("provisional" in note for note in notes.notes)
    measured = 0.74 * errors(first, true)["scale"]
    config = WorldConfig(scale="object:3.height=0.74", object_measured_height_m=measured)
    second = find_world(posed, depth, config)
    assert second.scale.method == "user-object"
    assert errors(second, true)["scale"] == pytest.approx(1, abs=1e-6)
    assert abs(errors(second, true)["floor_m"]) < 0.01
    with pytest.raises(UsageError, match="measured height"):
        rescale_for_object(first, 0.0, 0.74)


def test_rescaling_keeps_the_floor_and_the_directions(room):
    world = find_world(*room, WorldConfig())
    twice = rescale_for_object(world, 0.5, 1.0)
    np.testing.assert_allclose(twice.world_from_sfm[:3], 2 * world.world_from_sfm[:3])
    np.testing.assert_allclose(twice.world_from_sfm[3], [0, 0, 0, 1])
