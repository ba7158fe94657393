"""Environments that draw 2D Gaussians: the rasterizer, moved things, the robot before them, options."""

from pathlib import Path

import numpy as np
import pytest
import sapien
from made_scenes import BOOK, BOX, KNOB, TABLE, publish_with_gaussians

import simrecon_envs
from reconstruction.core.types import Camera
from reconstruction.gaussians.model import from_packed
from reconstruction.gaussians.rasterizer import RasterSettings, rasterize
from registry import SceneRegistry, UsageError
from simrecon_envs.errors import SceneAssetsMissing
from simrecon_envs.scene_builder import bodies_of
from simrecon_envs.splats.compositing import NOTHING
from simrecon_envs.splats.kernels import DEPTH_SUM, LIGHT
from simrecon_envs.splats.rasterizer import Drawn, Rasterizer
from simrecon_envs.splats.scene import SplatScene, read_splats
from simrecon_envs.splats.shadows import darken, shadow_map
from simrecon_envs.tasks.facts import scene_facts

SIZE = {"width": 96, "height": 72}
LARGE = {"width": 320, "height": 240}
LENS = np.array([100.0, 100.0, 48.0, 36.0])


@pytest.fixture(scope="module")
def splats_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a registry with `room`, whose surfaces are covered with Gaussians of other colors than its meshes."""
    root = tmp_path_factory.mktemp("splats")
    publish_with_gaussians(SceneRegistry(root, create=True), "room", tmp_path_factory.mktemp("room"))
    return root


def _packed(count: int, seed: int = 0) -> np.ndarray:
    """Return random Gaussians (n, 13) before a camera at the origin that looks along +z."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1, -1, 1.0], [1, 1, 4.0], size=(count, 3))
    return np.concatenate(
        [
            means,
            rng.normal(size=(count, 4)),
            rng.uniform(-4.5, -1.5, size=(count, 2)),
            rng.normal(1.0, 2.0, size=(count, 1)),
            rng.normal(size=(count, 3)),
        ],
        axis=1,
    ).astype(np.float32)


def _scene(packed: np.ndarray, bodies: np.ndarray | None = None) -> SplatScene:
    from simrecon_envs.splats.scene import packed_scene

    names = ("x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "opacity")
    names += ("f_dc_0", "f_dc_1", "f_dc_2")
    found = {name: packed[:, column] for column, name in enumerate(names)}
    found["instance_id"] = np.zeros(len(packed), int) if bodies is None else bodies
    return packed_scene(found, {1: 1}, (1,), np.array([np.eye(4), np.eye(4)]))


def _draw(scene: SplatScene, moves: np.ndarray | None = None, **options) -> Drawn:
    shape = (SIZE["height"], SIZE["width"])
    moves = np.repeat(np.eye(4)[None], 2, axis=0) if moves is None else moves
    limits, owners = options.pop("limits", np.full(shape, NOTHING)), np.full(shape, -1, np.int32)
    owners = options.pop("owners", owners)
    drawn = Rasterizer(scene).draw(moves[:, :3], LENS, limits.astype(np.float32), owners, **options)
    return Drawn(drawn.planes.copy(), drawn.front.copy(), drawn.splats.copy())


@pytest.mark.parametrize("seed", [0, 1])
def test_image_is_that_of_the_rasterizer_that_fits_gaussians(seed: int) -> None:
    packed = _packed(1500, seed)
    drawn = _draw(_scene(packed))
    camera = Camera(width=SIZE["width"], height=SIZE["height"], fx=100.0, fy=100.0, cx=48.0, cy=36.0)
    settings = RasterSettings(transmittance_stop=1 / 255)
    parameters = from_packed(packed).packed()
    features = rasterize(parameters, camera, np.eye(4), settings).features
    assert features[..., :3].std() > 0.1
    difference = np.abs(np.moveaxis(drawn.planes[:3], 0, -1) - features[..., :3])
    # Splats at equal depth within 0.006 % may change places.
    assert np.percentile(difference, 99) < 2e-3
    assert difference.max() < 0.1
    np.testing.assert_allclose(1 - drawn.planes[LIGHT], features[..., 7], atol=5e-3)
    depth, expected = drawn.planes[DEPTH_SUM], features[..., 3]
    assert np.percentile(np.abs(depth - expected), 99) < 0.01


def test_image_does_not_depend_on_the_number_of_threads() -> None:
    scene = _scene(_packed(800))
    one, two = _draw(scene, threads=1), _draw(scene, threads=2)
    np.testing.assert_array_equal(one.planes, two.planes)
    np.testing.assert_array_equal(one.front, two.front)


def test_moving_a_body_is_moving_its_gaussians() -> None:
    packed, move = _packed(600), np.eye(4)
    owned = (np.arange(600) % 3 == 0).astype(int)
    move[:3, 3] = (0.2, -0.1, 0.3)
    moved = packed.copy()
    moved[owned == 1, :3] += move[:3, 3].astype(np.float32)
    one = _draw(_scene(packed, owned), np.array([np.eye(4), move]))
    other = _draw(_scene(moved, owned))
    assert np.percentile(np.abs(one.planes - other.planes), 99.5) < 2e-3


def test_behind_the_limit_only_the_pixels_own_body_counts() -> None:
    packed = _packed(600)
    packed[:, 2] = np.where(np.arange(600) % 2, 1.5, 3.0)
    packed[:, 3:7] = (1, 0, 0, 0)  # facing the camera
    scene = _scene(packed, np.arange(600) % 2 == 0)
    limits = np.full((SIZE["height"], SIZE["width"]), 2.0)
    front = _draw(_scene(packed[1::2]))
    np.testing.assert_allclose(_draw(scene, limits=limits).planes, front.planes, atol=1e-5)
    own = _draw(scene, limits=limits, owners=np.ones(limits.shape, np.int32))
    np.testing.assert_allclose(own.planes, _draw(scene).planes, atol=1e-6)


def test_gaussians_belong_to_the_body_that_carries_their_thing(splats_root: Path) -> None:
    bundle = SceneRegistry(splats_root).load("room")
    bodies = bodies_of(bundle)
    scene = read_splats(bundle, bodies, scene_facts(bundle, "none").solids)
    row = {key: number for number, key in enumerate(scene.keys, 1)}
    assert KNOB not in row  # it is attached to the book
    for key, item in ((BOX, BOX), (BOOK, BOOK)):
        centers = scene.rows[scene.bodies == row[key], :3]
        center = next(o for o in bundle.objects if o.id == item).world_from_object[:3, 3]
        assert len(centers) > 20
        assert np.linalg.norm(centers[:, :2] - center[:2], axis=1).max() < 0.2
    knob = next(o for o in bundle.objects if o.id == KNOB).world_from_object[:3, 3]
    book = scene.rows[scene.bodies == row[BOOK], :3]
    assert (np.linalg.norm(book - knob, axis=1) < 0.03).sum() > 5


def test_gaussians_hidden_below_a_movable_thing_are_left_out(splats_root: Path) -> None:
    bundle = SceneRegistry(splats_root).load("room")
    scene = read_splats(bundle, bodies_of(bundle), scene_facts(bundle, "none").solids)
    box = next(o for o in bundle.objects if o.id == BOX).world_from_object[:3, 3]
    table = scene.rows[scene.bodies == 1 + scene.keys.index(TABLE), :3]
    top = table[np.abs(table[:, 2] - box[2]) < 0.004]
    assert len(top) > 100
    inside = (np.abs(top[:, :2] - box[:2]) < 0.02).all(axis=1)
    assert not inside.any()


@pytest.mark.parametrize(("gap_m", "darkest"), [(0.0, 0.4), (0.06, 0.85), (0.3, 1.0)])
def test_a_contact_shadow_is_below_its_caster_and_fades_with_height(gap_m: float, darkest: float) -> None:
    grid = np.stack(np.meshgrid(np.arange(-0.1, 0.1, 0.005), np.arange(-0.1, 0.1, 0.005)), axis=-1).reshape(
        -1, 2
    )
    points = np.column_stack([grid, np.full(len(grid), gap_m)])
    tall = np.concatenate([points, points + np.array([0, 0, 0.5])])  # only its foot counts
    shadows = shadow_map(tall)
    world_from_camera = np.diag([1.0, -1.0, -1.0, 1.0])  # 2 m above the floor, looking down
    world_from_camera[2, 3] = 2.0
    colors, depth = np.ones((80, 80, 3), np.float32), np.full((80, 80), 2000, np.int16)
    lens = np.array([100.0, 100.0, 40.0, 40.0])
    darken(
        colors, depth, np.ones((80, 80), bool), world_from_camera, lens,
        shadows.origin, shadows.cover, shadows.lowest,
    )  # fmt: skip
    assert colors[40, 40, 0] == pytest.approx(darkest, abs=0.01)
    assert np.all(np.diff(colors[40, 40:, 0]) >= -1e-3)  # lighter outwards
    assert (colors[:, 50:] == 1).all()  # 20 cm from the middle


@pytest.mark.render
def test_a_moved_thing_shades_what_it_stands_on(splats_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env, _ = _one_camera(splats_root, renderer="splats")
    base = env.unwrapped
    actor = base.builder.objects[BOX].actor._objs[0]
    actor.set_pose(sapien.Pose(actor.pose.p + np.float32([-0.08, 0.0, 0.0]), actor.pose.q))

    def image() -> np.ndarray:
        return base._get_obs_sensor_data()["capture_0"]["rgb"][0].numpy().astype(int)

    shaded = image()
    monkeypatch.setattr("simrecon_envs.splats.cameras.shadow_map", lambda points: None)
    plain = image()
    assert (shaded <= plain).all()
    assert (plain - shaded).max() > 20
    assert 20 < ((plain - shaded).max(axis=-1) > 3).sum() < 0.05 * plain[..., 0].size
    env.close()


def _one_camera(root: Path, **options) -> tuple:
    options = {"task": "none", "robot_uids": "none", "cameras": "capture:1", **options}
    env = simrecon_envs.make(
        "room", registry=root, obs_mode="rgb+depth+segmentation", sensor_configs=LARGE, **options
    )
    obs, _ = env.reset(seed=0)
    return env, {name: image[0].numpy() for name, image in obs["sensor_data"]["capture_0"].items()}


@pytest.mark.render
def test_pictures_show_gaussians_and_moved_things_take_theirs_along(splats_root: Path) -> None:
    env, before = _one_camera(splats_root, renderer="splats")
    base = env.unwrapped
    actor = base.builder.objects[BOX].actor._objs[0]
    key = actor.per_scene_id
    _, mesh = _one_camera(splats_root)
    # Gaussians are blue, meshes are not; depth and ids are of the same surfaces.
    assert (before["rgb"][..., 2].astype(int) - before["rgb"][..., 0]).mean() > 60
    assert (mesh["rgb"][..., 2].astype(int) - mesh["rgb"][..., 0]).mean() < 20
    there = before["segmentation"][..., 0] == key
    its = mesh["segmentation"][..., 0] == key
    assert (there & its).sum() > 0.9 * its.sum() > 40
    assert there.sum() < 1.8 * its.sum()  # Gaussians blur outlines
    both = (before["depth"] > 0) & (mesh["depth"] > 0)
    assert np.median(np.abs(before["depth"].astype(int) - mesh["depth"])[both]) < 15
    pose = actor.pose
    actor.set_pose(sapien.Pose(pose.p + np.float32([0.1, -0.1, 0.25]), pose.q))
    after = {name: x[0].numpy() for name, x in base._get_obs_sensor_data()["capture_0"].items()}
    here = after["segmentation"][..., 0] == key
    assert here.sum() > 20
    assert not (here & there).any()
    # The top that the box uncovered is the mesh's, with no hole.
    assert (after["depth"][there] > 0).all()
    actor.set_pose(pose)
    back = base._get_obs_sensor_data()["capture_0"]
    assert np.abs(back["rgb"][0].numpy().astype(int) - before["rgb"]).max() <= 1
    env.close()


@pytest.mark.render
def test_the_robot_hides_gaussians_behind_it_and_not_those_before_it(splats_root: Path) -> None:
    options = {"task": "reach", "robot_uids": "panda", "cameras": "overview"}
    env = simrecon_envs.make(
        "room",
        registry=splats_root,
        obs_mode="rgb+segmentation",
        sensor_configs=SIZE,
        renderer="splats",
        **options,
    )
    obs, _ = env.reset(seed=0)
    base = env.unwrapped
    links = [link._objs[0].entity.per_scene_id for link in base.agent.robot.links]
    image = {name: x[0].numpy() for name, x in obs["sensor_data"]["overview"].items()}
    robot = np.isin(image["segmentation"][..., 0], links)
    assert robot.sum() > 50
    from scipy.ndimage import binary_erosion

    inner = image["rgb"][binary_erosion(robot)].astype(int)
    assert np.median(inner[:, 2] - inner[:, 0]) < 30  # not blue
    env.close()


@pytest.mark.render
def test_looks_are_randomized_on_the_final_picture(splats_root: Path) -> None:
    env, plain = _one_camera(splats_root, renderer="splats")
    env.close()
    for looks in ({"lights": 0.5}, {"textures": 0.5}, {"image_noise": 8.0}):
        env, drawn = _one_camera(splats_root, renderer="splats", randomize=looks)
        assert np.abs(drawn["rgb"].astype(int) - plain["rgb"]).mean() > 0.3, looks
        env.close()


@pytest.mark.render
def test_point_clouds_and_videos_are_of_the_same_picture(splats_root: Path) -> None:
    env = simrecon_envs.make(
        "room", registry=splats_root, obs_mode="pointcloud", sensor_configs=SIZE, renderer="splats",
        task="none", robot_uids="none", cameras="capture:1", render_mode="rgb_array",
    )  # fmt: skip
    obs, _ = env.reset(seed=0)
    cloud = obs["pointcloud"]
    shown = cloud["xyzw"][0, :, 3] > 0
    colors = cloud["rgb"][0][shown].numpy().astype(int)
    assert (colors[:, 2] - colors[:, 0]).mean() > 60
    low = cloud["xyzw"][0, shown, 2].numpy()
    assert np.percentile(low, 1) > -0.1  # metres, world: nothing below the floor
    video = env.render()[0].numpy().astype(int)
    assert (video[..., 2] - video[..., 0]).mean() > 20
    env.close()


def test_errors_say_what_is_missing(scenes_root: Path, splats_root: Path, tmp_path: Path) -> None:
    with pytest.raises(SceneAssetsMissing, match=r"gaussians\.ply.*simrecon reconstruct.*renderer='mesh'"):
        simrecon_envs.make("room", registry=scenes_root, renderer="splats")
    with pytest.raises(UsageError, match=r"renderer 'splat': expected one of mesh, splats"):
        simrecon_envs.make("room", registry=splats_root, renderer="splat")
    with pytest.raises(UsageError, match="sensor_data"):
        simrecon_envs.make("room", registry=splats_root, renderer="splats", obs_mode="sensor_data")
