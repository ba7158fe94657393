"""The page without a browser: picking, selection, text, layers, and what is known about surfaces."""

import json
import struct

import numpy as np
import pytest
import trimesh
from hostile_text import WITH_CONTROLS
from made_scenes import BOOK, BOX, CYLINDER, KNOB, PICTURE, TABLE
from PIL import Image

from reconstruction.core.types import Camera, DepthMaps
from registry.geometry import rigid, transform_points
from registry.glb import read_glb_json
from studio.as_filmed import GAIN, as_filmed, compensate, inverse_tone_map, to_linear, to_srgb, tone_map
from studio.coverage import CLASSES, classify
from studio.gaussians import read_gaussians
from studio.inspector import object_html
from studio.layers import COLLISION, COVERAGE, GAUSSIANS, OVERLAYS, TEXTURES, Appearance
from studio.layers.appearance import hull_corners
from studio.layers.ruler import scale_text
from studio.picking import Geometry, first_hit
from studio.scene_view import StudioPage
from studio.selection import Selection
from studio.start_view import start_view
from studio.text import bare, plain, plain_markdown


@pytest.fixture(scope="module")
def page(made_registry):
    page = StudioPage(made_registry, "room")
    yield page
    page.close()


def test_a_ray_hits_a_sphere_where_it_should():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    mesh = Geometry(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    rng = np.random.default_rng(3)
    for _ in range(20):
        origin = rng.normal(size=3)
        origin *= 2 / np.linalg.norm(origin)
        target = 0.3 * rng.uniform(-1, 1, 3)
        direction = (target - origin) / np.linalg.norm(target - origin)
        middle = -origin @ direction
        truth = middle - np.sqrt(0.25 - (origin @ origin - middle**2))
        distance, normal = first_hit(mesh, origin, direction)
        assert distance == pytest.approx(truth, abs=3e-3)
        assert normal @ direction < 0
        assert first_hit(mesh, origin, -direction) is None


def test_a_ray_finds_the_nearest_object_at_its_present_pose(page):
    top = page.pose_of(TABLE)[:3, 3] + [0.0, 0.25, 2.0]
    hit = page.pickable.cast(top, np.array([0.0, 0.0, -1.0]))
    assert hit.owner == TABLE
    assert hit.point[2] == pytest.approx(0.6, abs=1e-6)
    assert hit.normal == pytest.approx([0, 0, 1])
    moved = page.pose_of(BOX)
    moved[:3, 3] = [top[0], top[1], 0.8]
    before = page.pose_of(BOX)
    page.set_pose(BOX, moved)
    assert page.pickable.cast(top, np.array([0.0, 0.0, -1.0])).owner == BOX
    page.set_pose(BOX, before)
    assert page.pickable.cast(top, np.array([0.0, 0.0, -1.0])).owner == TABLE
    assert page.pickable.cast(top, np.array([0.0, 0.0, -1.0]), frozenset([TABLE])).owner == 1
    assert page.pickable.cast(np.array([0, 0, 50.0]), np.array([0, 0, 1.0])) is None


def test_selection_keeps_order_and_reports_changes_only():
    selection, seen = Selection(), []
    end = selection.on_change(seen.append)
    selection.on_change(lambda ids: 1 / 0)  # a broken listener does not stop the others
    selection.set([5, 3, 5])
    selection.set((5, 3))
    selection.toggle(7)
    selection.toggle(5)
    assert seen == [(5, 3), (5, 3, 7), (3, 7)]
    assert selection.last == 7
    end()
    selection.set(())
    assert len(seen) == 3


@pytest.mark.parametrize("escape", [plain, plain_markdown])
def test_hostile_text_has_no_markup_left(escape):
    out = escape(WITH_CONTROLS)
    assert "<" not in out
    assert ">" not in out
    assert not any(ord(c) < 32 or c == "\u202e" for c in out)
    assert "\\u202e" in bare(WITH_CONTROLS)
    assert len(bare("x" * 1000)) <= 401
    assert plain("plain words, 3") == "plain words, 3"


def test_markdown_text_has_no_punctuation_that_means_something():
    assert not set("*`_[]{}#") & set(
        plain_markdown("*a* `b` _c_ [d](e) {f}").replace("&#", "").replace(";", "")
    )


def test_the_panel_shows_hostile_text_as_text(made_registry):
    page = StudioPage(made_registry, "hostile")
    try:
        html = object_html(page, BOOK)
    finally:
        page.close()
    assert "<img" not in html
    assert "&lt;img src=x" in html


def test_the_viewers_tone_mapping_is_undone():
    """Colors that the filmic curve reaches come back within quantization; gray is shown as gray."""
    rng = np.random.default_rng(1)
    gray = rng.integers(0, 250, (64, 64, 1))
    image = np.clip(gray + rng.integers(-30, 30, (64, 64, 3)), 0, 250).astype(np.uint8)
    shown = 255 * to_srgb(tone_map(GAIN * to_linear(compensate(image) / 255)))
    error = np.abs(shown - image)
    assert error.mean() < 1.5
    assert np.percentile(error, 99) < 5
    linear = rng.uniform(0.02, 0.6, (200, 1)) * rng.uniform(0.7, 1.0, (200, 3))
    assert tone_map(inverse_tone_map(linear)) == pytest.approx(linear, abs=1e-6)
    assert inverse_tone_map(np.zeros(3)) == pytest.approx(0, abs=2e-3)


def test_files_for_the_viewer_keep_their_shape_and_carry_no_light(tmp_path):
    uv = np.random.default_rng(0).uniform(0, 1, (8, 2))
    box = trimesh.creation.box((1, 2, 3))
    picture = Image.fromarray(np.full((16, 16, 3), 120, np.uint8))
    box.visual = trimesh.visual.TextureVisuals(
        uv, trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    )
    out = as_filmed(box.export(file_type="glb"))
    path = tmp_path / "out.glb"
    path.write_bytes(out)
    document, _ = read_glb_json(path, "out.glb")
    assert all("KHR_materials_unlit" in m["extensions"] for m in document["materials"])
    again = trimesh.load(path, force="mesh", process=False)
    assert again.bounds == pytest.approx(box.bounds)
    assert again.visual.uv == pytest.approx(uv, abs=1e-6)
    stored = np.asarray(again.visual.material.baseColorTexture.convert("RGB"))
    factor = document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"]
    shown = 255 * to_srgb(tone_map(np.array(factor[:3]) * to_linear(stored / 255)))
    assert shown == pytest.approx(120, abs=3)


def test_plain_colors_are_shown_as_they_are():
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[140, 100, 60, 255])
    box.visual = trimesh.visual.TextureVisuals(material=material)
    out = as_filmed(box.export(file_type="glb"))
    length = struct.unpack_from("<I", out, 12)[0]
    factor = json.loads(out[20 : 20 + length])["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"]
    assert tone_map(np.array(factor[:3])) == pytest.approx(np.array([140, 100, 60]) / 255, abs=1e-6)


def test_hulls_face_outward():
    rng = np.random.default_rng(0)
    corners = hull_corners(rng.normal(size=(40, 3)))
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3))
    assert mesh.is_watertight
    assert mesh.volume > 0


def test_classes_of_vertices_follow_the_depth_that_saw_them():
    """A camera above a plane: measured on the left, completed on the right, nothing known in a strip between."""
    camera = Camera(80, 60, 60.0, 60.0, 40.0, 30.0)
    looking_down = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0]))
    depth = np.ones((1, 60, 80), np.float32)
    confidence = np.full((1, 60, 80), 2, np.uint8)
    confidence[:, :, 50:] = 1
    depth[:, :, 35:45] = confidence[:, :, 35:45] = 0
    maps = DepthMaps(camera, depth, confidence)
    x = np.array([-0.4, 0.0, 0.4, -0.4, -0.4, -9.0])
    points = np.column_stack([x, np.zeros(6), [0, 0, 0, 0.1, 0, 0]])
    normals = np.tile([0.0, 0.0, 1.0], (6, 1))
    normals[4] = [0, 0, -1.0]
    found = classify(points, normals, maps, looking_down[None])
    # Seen; no depth; completed; 10 cm off the depth; faces away; outside of the picture.
    assert [CLASSES[k] for k in found] == ["seen", "guessed", "completed", "guessed", "guessed", "guessed"]


def test_gaussians_lie_flat_on_their_surfaces(made_registry):
    cloud = read_gaussians(made_registry.load("room"))
    floor = cloud.owners == 1
    up = np.linalg.eigh(cloud.covariances[floor].astype(np.float64))[1][:, :, 0]
    top = np.abs(cloud.centers[floor][:, 2]) < 1e-4
    assert np.abs(up[top][:, 2]).min() > 0.99
    assert np.abs(cloud.colors - [0.1, 0.2, 0.9]).max() < 1e-3
    assert cloud.opacities.min() > 0.95
    assert set(np.unique(cloud.owners)) == {1, 2, 3, TABLE, BOX, CYLINDER, BOOK, KNOB, PICTURE}


def test_the_first_view_has_the_objects_before_it(made_registry):
    bundle = made_registry.load("room")
    view = start_view(bundle)
    forward = view.look_at - view.position
    for item in bundle.objects:
        assert forward @ (item.world_from_object[:3, 3] - view.position) > 0
    camera = bundle.cameras.world_from_camera[0][:3, 3]
    assert np.linalg.norm(view.position - camera) < 0.6


def test_every_layer_is_made_once_when_first_shown_and_again_for_a_new_revision(page):
    for kind in OVERLAYS:
        layer, made = kind(page), []
        build = layer.build
        layer.build = lambda build=build, made=made: made.append(1) or build()
        assert not made
        layer.set(True)
        layer.set(False)
        layer.set(True)
        assert made == [1]
        page.reload()
        layer.rebuild()
        assert made == [1, 1], kind
        layer.remove()


def test_surfaces_in_every_form_replace_the_textures(page):
    appearance = Appearance(page)
    for mode in (GAUSSIANS, COVERAGE, COLLISION):
        appearance.set(mode, True)
        assert appearance.legend()
        assert not any(handle.visible for handle in page.object_handles().values())
        names = [n for n in page.server.scene._handle_from_node_name if "/collision" in n or "/coverage" in n]
        assert bool(names) == (mode != GAUSSIANS)
    appearance.set(TEXTURES, False)
    assert all(handle.visible for handle in page.object_handles().values())
    assert not any(handle.visible for handle in page.room_handles())
    assert page.unpickable == {1, 2, 3}
    appearance.set(TEXTURES, True)
    assert page.unpickable == frozenset()


def test_a_scene_without_a_stage_cache_says_that_its_coverage_is_that_of_whole_objects(page):
    appearance = Appearance(page)
    appearance.set(COVERAGE, True)
    assert "stage cache of this scene is gone" in appearance.legend()
    assert appearance.shares_of(TABLE) is None
    appearance.set(TEXTURES, True)


def test_poses_are_those_of_the_frame_nodes(page):
    pose = rigid(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([1.0, 2.0, 3.0]))
    before, moved = page.pose_of(KNOB), []
    end = page.on_move(moved.append)
    page.set_pose(KNOB, pose)
    end()
    node = page.server.scene.get_handle_by_name(f"/objects/{KNOB}")
    assert node.position == pytest.approx([1, 2, 3])
    assert np.abs(node.wxyz) == pytest.approx(np.sqrt([0.5, 0, 0, 0.5]))
    assert moved == [KNOB]
    page.set_pose(KNOB, before)
    assert transform_points(page.pose_of(KNOB), np.zeros((1, 3))) == pytest.approx(before[None, :3, 3])


@pytest.mark.parametrize(
    ("scale", "text"),
    [
        ({"method": "marker", "uncertainty": 0.004}, "1 m ± 4 mm (marker)"),
        ({"method": "camera-height-prior", "uncertainty": 0.15}, "1 m ± 15 cm (camera-height-prior)"),
        ({"method": "unknown", "uncertainty": None}, "1 m, uncertainty unknown (unknown)"),
    ],
)
def test_the_ruler_says_how_sure_it_is(scale, text):
    assert scale_text(scale) == text


def test_frames_project_points_as_the_camera_does(page):
    frames = page.frames
    assert frames.indices == (0,)
    pose = frames.world_from_camera(0)
    assert frames.pixel(0, pose[:3, 3] + 2 * pose[:3, 2]) == pytest.approx((320, 240))
    assert frames.pixel(0, pose[:3, 3] + 2 * pose[:3, 2] + 0.5 * pose[:3, 0]) == pytest.approx((450, 240))
    assert frames.pixel(0, pose[:3, 3] - pose[:3, 2]) is None
    assert frames.photograph(0) is None
    assert frames.shown_to(99) is None
