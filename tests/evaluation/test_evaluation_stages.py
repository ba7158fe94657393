"""Figures per stage: a known fault of one artifact changes the figures of its stage only."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruction.core.types import DepthMaps, Plane
from reconstruction.measure import GroundTruth
from reconstruction.measure import stages as figures
from reconstruction.measure.alignment import align
from reconstruction.measure.oracle import Oracle
from reconstruction.measure.planes import planes_figures
from reconstruction.measure.surfaces import sample_seen
from reconstruction.surface import SurfaceConfig, fuse_surface
from registry.errors import UsageError
from registry.geometry import rigid, split_similarity
from synthetic.capture import SyntheticCapture, make_test_capture, write_ground_truth
from synthetic.film import prepare

pytestmark = pytest.mark.stage

KINDS = ["table", "carton", "can", "book"]


@pytest.fixture(scope="module")
def capture() -> SyntheticCapture:
    """A short capture of a small room with true cameras and depth."""
    return make_test_capture(18, 200, 150, seed=2, objects=KINDS, step_m=0.2, density=0.1)


@pytest.fixture(scope="module")
def truth(capture, tmp_path_factory) -> GroundTruth:
    folder = tmp_path_factory.mktemp("truth")
    posed = capture.posed
    count = len(posed.indices) + len(posed.held_out_indices)
    path = np.zeros((count, 4, 4))
    path[posed.indices], path[posed.held_out_indices] = (
        posed.world_from_camera,
        posed.held_out_world_from_camera,
    )
    write_ground_truth(folder, capture.room, prepare(capture.room, shadow_px=64), posed.camera, path, 12.0)
    return GroundTruth.load(folder)


def aligned(posed, truth):
    return align(
        dict(zip(posed.indices.tolist(), posed.world_from_camera)), truth.world_from_camera, truth.up
    )


@pytest.fixture(scope="module")
def surface(capture):
    return fuse_surface(capture.posed, capture.depth, SurfaceConfig())


def test_true_poses_and_depth_are_perfect(capture, truth):
    alignment = aligned(capture.posed, truth)
    poses = figures.poses_figures(capture.posed, alignment, truth)
    assert poses["ate_cm"] < 1e-3
    assert poses["registered_share"] == 1
    assert poses["focal_error_percent"] < 1e-9
    depth = figures.depth_figures(capture.posed, capture.depth, alignment, truth)
    assert depth["median_rel"] < 1e-4
    assert depth["share_over_5_percent"] < 0.02  # the drawn room has finer edges than its meshes
    assert depth["measured_share"] == pytest.approx(depth["known_share"])


def test_depth_errors_come_out_as_they_went_in(capture, truth):
    alignment = aligned(capture.posed, truth)
    true = capture.depth
    scaled = replace(true, depth=true.depth * np.float32(1.02))
    found = figures.depth_figures(capture.posed, scaled, alignment, truth)
    assert found["median_rel"] == pytest.approx(0.02, abs=5e-4)
    wrong = np.random.default_rng(0).random(true.depth.shape) < 0.25
    spoiled = replace(true, depth=np.where(wrong, true.depth * 1.2, true.depth).astype(np.float32))
    found = figures.depth_figures(capture.posed, spoiled, alignment, truth)
    assert found["share_over_5_percent"] == pytest.approx(0.25, abs=0.02)
    half = np.random.default_rng(1).random(true.depth.shape) < 0.5
    sparse = DepthMaps(true.camera, np.where(half, true.depth, 0).astype(np.float32), true.confidence)
    found = figures.depth_figures(capture.posed, sparse, alignment, truth)
    assert found["known_share"] == pytest.approx(0.5, abs=0.02)


def test_depth_error_does_not_depend_on_the_scale_of_the_world(capture, truth):
    sfm_from_world = np.diag([0.4, 0.4, 0.4, 1.0]) @ rigid(translation=np.array([3.0, -1.0, 0.5]))
    posed, depth = capture.in_sfm_space(sfm_from_world)
    found = figures.depth_figures(posed, depth, aligned(posed, truth), truth)
    assert found["median_rel"] < 1e-4


def test_focal_error(capture, truth):
    camera = replace(capture.posed.camera, fx=capture.posed.camera.fx * 1.01)
    posed = replace(capture.posed, camera=camera)
    assert figures.poses_figures(posed, aligned(posed, truth), truth)["focal_error_percent"] == pytest.approx(
        1.0
    )


def test_surface_of_true_depth_is_good_and_a_shifted_one_is_not(capture, truth, surface):
    alignment = aligned(capture.posed, truth)
    meshes = [e.mesh for e in truth.entities]
    from reconstruction.measure.scene import joined

    poses = list(truth.world_from_camera.values())
    seen = sample_seen(*joined(meshes), truth.camera, poses, 200_000)
    good = figures.surface_figures(surface, alignment, truth, seen, 0.05, 200_000)
    assert good["cd_cm"] < 2.0
    assert good["f_5cm"] > 93
    moved = replace(surface, vertices=surface.vertices + np.array([0, 0, 0.1], np.float32))
    bad = figures.surface_figures(moved, alignment, truth, seen, 0.05, 200_000)
    assert bad["cd_cm"] > good["cd_cm"] + 2
    depth = figures.surface_depth_figures(capture.posed, surface, alignment, truth)
    assert depth["median_rel"] < 0.01
    assert depth["frames"] == len(capture.posed.held_out_indices)


def test_planes_are_found_where_they_are_and_missed_where_they_are_not(capture, truth, surface):
    alignment = aligned(capture.posed, truth)
    good = planes_figures(surface, alignment, truth)
    assert good["floor_found_share"] == good["wall_found_share"] == 1
    assert good["found_share"] > 0.7
    assert good["angle_median_deg"] < 1
    assert good["offset_median_mm"] < 5
    raised = tuple(
        replace(
            p,
            surface=Plane(p.surface.plane - [0, 0, 0, 0.05], p.surface.polygon + p.surface.plane[:3] * 0.05),
        )
        for p in surface.planes
    )
    bad = planes_figures(replace(surface, planes=raised), alignment, truth)
    assert bad["found_share"] == 0
    assert "angle_median_deg" not in bad
    half = tuple(p for p in surface.planes if p.label != "support")
    assert planes_figures(replace(surface, planes=half), alignment, truth)["support_found_share"] == 0
    assert planes_figures(surface, alignment, replace(truth, entities=())) is None


def oracle(truth, *stages) -> Oracle:
    return Oracle.load(stages, truth.folder)


def test_oracle_instances_are_perfect_and_merged_ones_are_not(capture, truth, surface):
    alignment = aligned(capture.posed, truth)
    instances = oracle(truth, "instances").instances(capture.posed, capture.depth, surface)
    assert {o.label for o in instances.objects} == {e.label for e in truth.entities if not e.base}
    whole = figures.instance_figures_3d(surface, instances, alignment, truth)
    assert whole["mean_iou"] > 0.95
    assert whole["recall_50"] == 1
    assert whole["precision_50"] == 1
    views = figures.instance_figures_2d(capture.posed, surface, instances, truth)
    assert views["recall_50"] > 0.9
    table, carton = (next(o.id for o in instances.objects if o.label == name) for name in ("table", "carton"))
    merged = np.where(instances.vertex_instance == carton, table, instances.vertex_instance)
    spoiled = replace(
        instances,
        vertex_instance=merged.astype(np.int32),
        objects=tuple(o for o in instances.objects if o.id != carton),
    )
    found = figures.instance_figures_3d(surface, spoiled, alignment, truth)
    assert found["recall_50"] == pytest.approx(whole["recall_50"] - 1 / len(KINDS))
    assert found["mean_iou"] < whole["mean_iou"] - 0.9 / len(KINDS)


def test_oracle_instances_without_a_floor_in_view_keep_walls_and_floor_apart(capture, truth, surface):
    """Without floor vertices a floor is assumed, and the walls keep distinct ids."""
    high = surface.vertices[:, 2] > 0.2
    keep = high[surface.faces].all(axis=1)
    number = np.cumsum(high) - 1
    cut = replace(
        surface,
        vertices=surface.vertices[high],
        faces=number[surface.faces[keep]].astype(np.int32),
        normals=surface.normals[high],
        colors=surface.colors[high],
        weights=surface.weights[high],
    )
    found = oracle(truth, "instances").instances(capture.posed, capture.depth, cut)
    assert found.base[0].label == "floor"
    assert not found.base[0].observed
    for base in found.base[1:]:
        on_it = cut.vertices[found.vertex_instance == base.id]
        assert base.label == "wall"
        assert len(on_it) > 100
        assert np.median(np.abs(on_it @ base.surface.plane[:3] + base.surface.plane[3])) < 0.02
    assert not (found.vertex_instance == found.base[0].id).any()


def test_oracle_depth_and_world_live_in_the_space_of_the_poses(capture, truth):
    scale = 0.37
    sfm_from_world = np.diag([scale, scale, scale, 1.0]) @ rigid(translation=np.array([1.0, 2.0, 3.0]))
    posed, true_depth = capture.in_sfm_space(sfm_from_world)
    found = oracle(truth, "depth").depth(posed, posed.camera)
    both = (found.depth > 0) & (true_depth.depth > 0)
    assert both.mean() > 0.8 * (true_depth.depth > 0).mean()
    assert np.median(np.abs(found.depth[both] / true_depth.depth[both] - 1)) < 1e-3
    world = oracle(truth, "world").world(posed)
    assert split_similarity(world.world_from_sfm)[0] == pytest.approx(1 / scale, rel=1e-4)
    assert np.allclose(world.world_from_sfm @ sfm_from_world, np.eye(4), atol=1e-3)
    assert world.scale.method == "ground-truth"


def test_oracle_refuses_what_it_cannot_do(truth, tmp_path):
    with pytest.raises(UsageError, match="oracles for poses, depth, world, instances"):
        Oracle.load(["surface"], truth.folder)
    with pytest.raises(UsageError, match="--ground-truth"):
        Oracle.load(["depth"], None)
    with pytest.raises(UsageError, match="no such folder"):
        Oracle.load(["depth"], tmp_path / "nothing")


def test_only_the_stage_that_the_truth_replaces_gets_another_fingerprint(truth):
    with_depth = oracle(truth, "depth")
    assert with_depth.of_stage("depth")[0] == with_depth.digest
    assert with_depth.of_stage("poses") == []
