"""Generated rooms: what they claim to be true must be true, because all other tests measure against it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from registry.geometry import invert_rigid, rigid, transform_points
from synthetic.camera_paths import handheld_path, pan_path, phone_camera
from synthetic.capture import make_test_capture, truth_as_json, write_ground_truth
from synthetic.film import prepare
from synthetic.room import NORTH_M, build_room
from synthetic.shapes import COARSE, box, lathe, signed_volume

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def room(small_capture):
    return small_capture.room


@pytest.fixture(scope="module")
def meshes(room):
    return {e.name: e.mesh() for e in room.entities}


def world_points(capture, row):
    """World coordinates (h, w, 3) of every pixel, from true depth and camera."""
    c, z = capture.posed.camera, capture.depth.depth[row].astype(float)
    v, u = np.mgrid[: c.height, : c.width] + 0.5
    local = np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z], -1)
    return transform_points(capture.posed.world_from_camera[row], local.reshape(-1, 3)).reshape(*z.shape, 3)


def test_every_mesh_is_a_closed_solid(meshes):
    for name, mesh in meshes.items():
        assert mesh.is_volume, name
        assert mesh.volume > 0, name


def test_box_and_lathe_enclose_their_volume():
    assert signed_volume(box((0.2, 0.3, 0.4), "x", 0.05)) == pytest.approx(0.024)
    can = lathe([(np.array([[0, 0], [0.1, 0], [0.1, 0.5], [0, 0.5]]), "x")], COARSE, segments=256)
    assert signed_volume(can) == pytest.approx(np.pi * 0.01 * 0.5, rel=1e-3)


def test_things_touch_their_support_exactly(room, meshes):
    by_id = {e.id: e for e in room.entities}
    surfaces = {"floor": 0.0, "table": meshes["table"].bounds[1, 2], "shelf": meshes["shelf"].bounds[1, 2]}
    surfaces["book"] = meshes["book"].bounds[1, 2]
    for thing in room.objects:
        parent = by_id[thing.parent].name
        if thing.relation == "supported_by":
            assert meshes[thing.name].bounds[0, 2] == pytest.approx(surfaces[parent], abs=1e-6), (
                thing.name
            )  # meshes are unions in float32
        else:
            assert thing.relation == "attached_to"
            assert parent == "wall_north"
            assert meshes[thing.name].bounds[1, 1] == pytest.approx(NORTH_M, abs=1e-6)


def test_a_thing_of_an_open_part_has_a_mesh_too():
    table = build_room(0, step_m=COARSE, density=0.05).entity("table")
    assert table.mesh().is_volume
    open_part = table.solids[0][1:]  # without one of the patches that close it
    mesh = replace(table, solids=(open_part, *table.solids[1:])).mesh()
    assert not mesh.is_volume
    assert np.allclose(mesh.bounds, table.mesh().bounds, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_no_two_things_overlap_and_table_things_keep_a_gap(seed):
    import trimesh

    room = build_room(seed, step_m=COARSE, density=0.05)
    meshes = {e.name: e.mesh() for e in room.objects}
    for number, a in enumerate(room.objects):
        for b in room.objects[number + 1 :]:
            common = trimesh.boolean.intersection([meshes[a.name], meshes[b.name]], engine="manifold")
            assert abs(common.volume) < 1e-9, (a.name, b.name)
    table = room.entity("table")
    on_table = [meshes[e.name].vertices[:, :2] for e in room.objects if e.parent == table.id]
    for number, a in enumerate(on_table):
        assert np.all(np.abs(a) < (0.55, 0.33)), "must not stick out over the edge"
        for b in on_table[number + 1 :]:
            assert np.linalg.norm(a[:, None] - b[None], axis=-1).min() > 0.03


@pytest.mark.parametrize(
    ("name", "size"), [("mug", (0.05, 0.05, 0.06)), ("bowl", (0.05, 0.05, 0.04)), ("crate", (0.3, 0.2, 0.2))]
)
def test_hollow_things_hold_something(room, meshes, name, size):
    import trimesh

    thing = room.entity(name)
    inside = trimesh.creation.box(size, transform=rigid(translation=np.array([0, 0, 0.016 + size[2] / 2])))
    inside.apply_transform(thing.world_from_object)
    common = trimesh.boolean.intersection([meshes[name], inside], engine="manifold")
    assert abs(common.volume) < 1e-9


def test_graspable_things_fit_a_parallel_gripper(room):
    assert sum(min(e.size[:2]) < 0.08 and not e.fixed for e in room.objects) >= 3


def test_depth_and_ids_agree_with_the_true_geometry(small_capture, room):
    seen = set()
    for row in range(len(small_capture.posed.images)):
        points, ids = world_points(small_capture, row), small_capture.id_maps[row]
        assert np.array_equal(ids > 0, small_capture.depth.depth[row] > 0)
        seen |= set(np.unique(ids).tolist())
        for name, axis, value in (("floor", 2, 0.0), ("wall_north", 1, NORTH_M)):
            here = points[ids == room.entity(name).id]
            assert np.abs(here[:, axis] - value).max() < 1e-4
        can = room.entity("can")
        local = transform_points(invert_rigid(can.world_from_object), points[ids == can.id])
        side = np.linalg.norm(local[:, :2], axis=1)
        top = np.abs(local[:, 2] - can.size[2])
        assert np.minimum(np.abs(side - can.size[0] / 2), top).max() < 5e-4
    assert seen - {0} == {e.id for e in room.entities}, "every thing is in view"


def test_images_agree_with_depth_and_cameras(small_capture):
    """Warp a frame into its neighbour through depth and cameras: the pictures must match where both see."""
    import cv2

    posed, camera = small_capture.posed, small_capture.posed.camera
    points = world_points(small_capture, 4).reshape(-1, 3)
    local = transform_points(invert_rigid(posed.world_from_camera[5]), points)
    u = (camera.fx * local[:, 0] / local[:, 2] + camera.cx - 0.5).astype(np.float32).reshape(240, 320)
    v = (camera.fy * local[:, 1] / local[:, 2] + camera.cy - 0.5).astype(np.float32).reshape(240, 320)
    warped = cv2.remap(posed.images[5], u, v, cv2.INTER_LINEAR).astype(float)
    depth_there = cv2.remap(small_capture.depth.depth[5], u, v, cv2.INTER_NEAREST).ravel()
    both = (np.abs(depth_there - local[:, 2]) < 0.02).reshape(240, 320)
    assert both.mean() > 0.5
    own = posed.images[4].astype(float)
    gain = own[both].mean() / warped[both].mean()  # exposure drifts
    aligned = np.abs(own - gain * warped)[both].mean()
    unaligned = np.abs(own - gain * posed.images[5])[both].mean()
    assert aligned < 8
    assert aligned < 0.45 * unaligned


def test_capture_holds_out_every_tenth_frame(small_capture):
    posed = small_capture.posed
    assert len(posed.images) == posed.chosen_frames == 12
    assert np.all(posed.indices % 10 != 0)
    assert np.all(posed.held_out_indices % 10 == 0)
    assert (
        len(posed.held_out_images)
        == len(posed.held_out_world_from_camera)
        == len(small_capture.held_out_depth)
        > 0
    )


def test_sparse_points_project_where_they_are_seen(small_capture):
    posed, camera = small_capture.posed, small_capture.posed.camera
    assert len(posed.points) > 500
    counts = np.bincount(posed.observations[:, 1], minlength=len(posed.points))
    assert np.median(counts) >= 4
    for row in (0, 6):
        number = posed.observations[posed.observations[:, 0] == row, 1]
        local = transform_points(invert_rigid(posed.world_from_camera[row]), posed.points[number])
        u, v = (
            local[:, 0] / local[:, 2] * camera.fx + camera.cx,
            local[:, 1] / local[:, 2] * camera.fy + camera.cy,
        )
        assert np.all((local[:, 2] > 0) & (u >= 0) & (v >= 0) & (u <= camera.width) & (v <= camera.height))


def test_sfm_space_is_a_similarity_of_world_space(small_capture):
    turn = rigid(np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]]), np.array([3.0, -2, 1]))
    turn[:3, :3] *= 0.37
    posed, depth = small_capture.in_sfm_space(turn)
    one, two = posed.world_from_camera[2], small_capture.posed.world_from_camera[2]
    assert np.allclose(one[:3, :3] @ one[:3, :3].T, np.eye(3))
    # A point seen at a pixel must come out at the moved place.
    local = np.array([[0.1, -0.05, 1.0]])
    expected = transform_points(turn, transform_points(two, 2.0 * local))
    assert np.allclose(transform_points(one, 0.37 * 2.0 * local), expected)
    assert np.allclose(depth.depth, 0.37 * small_capture.depth.depth)


def test_same_seed_gives_the_same_bits_and_another_seed_another_room():
    a, b, c = (make_test_capture(3, 80, 60, seed, ["table", "mug"], density=0.2) for seed in (4, 4, 5))
    assert np.array_equal(a.posed.images, b.posed.images)
    assert np.array_equal(a.depth.depth, b.depth.depth)
    assert not np.array_equal(a.posed.images, c.posed.images)


def test_wanted_objects_bring_what_they_stand_on():
    room = build_room(objects=["tin"], step_m=COARSE, density=0.05)
    assert {e.name for e in room.objects} == {"table", "book", "tin"}
    with pytest.raises(ValueError, match="sofa"):
        build_room(objects=["sofa"])


def test_paths_are_upright_and_pan_has_no_parallax():
    path = handheld_path(60)
    assert np.all(path[:, 2, 1] < -0.5), "the camera's +y points down"
    assert np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1).max() < 0.2
    assert np.ptp(pan_path(30)[:, :3, 3], axis=0).max() == 0


def test_written_ground_truth_reads_back(tmp_path):
    import cv2
    import trimesh

    room = build_room(objects=["table", "can"], step_m=0.2, density=0.1)
    camera, path = phone_camera(160, 120), handheld_path(11)
    film_set = prepare(room, shadow_px=64)
    write_ground_truth(tmp_path, room, film_set, camera, path, 12.0)
    truth = json.loads((tmp_path / "scene.json").read_text())
    assert len(truth["frames"]) == 11
    assert {e["name"]: e["parent"] for e in truth["entities"]}["can"] == "table"
    assert all(e["visible_pixels"] > 0 for e in truth["entities"] if not e["base"])
    can = trimesh.load(tmp_path / "meshes" / "can.ply", force="mesh")
    assert np.allclose(can.bounds, room.entity("can").mesh().bounds, atol=1e-5)
    depth = cv2.imread(str(tmp_path / "depth" / "00010.png"), cv2.IMREAD_UNCHANGED)
    ids = cv2.imread(str(tmp_path / "instances" / "00010.png"), cv2.IMREAD_UNCHANGED)
    assert depth.shape == ids.shape == (120, 160)
    assert 500 < np.median(depth[ids == room.entity("can").id]) < 3000


def test_shipped_truth_describes_the_shipped_room(demo_video):
    truth = json.loads(demo_video.with_name("demo_room_truth.json").read_text())
    room = build_room(0, step_m=COARSE, density=0.05)
    path = handheld_path(len(truth["frames"]))
    assert demo_video.stat().st_size < 4e6
    expected = truth_as_json(room, phone_camera(640, 480), path, 12.0)
    assert truth["intrinsics"] == expected["intrinsics"]
    assert truth["entities"] == expected["entities"]
    for a, b in zip(truth["frames"], expected["frames"]):
        assert np.allclose(a["world_from_camera"], b["world_from_camera"], atol=1e-5)
