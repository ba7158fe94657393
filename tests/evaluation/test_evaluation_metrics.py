"""The metrics: the truth scores perfectly, and each known fault changes the expected metrics by known amounts."""

import numpy as np
import pytest
from truth_bundle import FIXED, KINDS, Change, Truth, write_truth

from reconstruction.measure import evaluate_scene
from reconstruction.measure.matching import box_iou, graph_f1, match
from registry.errors import UsageError
from registry.geometry import rigid

pytestmark = pytest.mark.stage

GEOMETRY = ("cd_cm", "f_5cm", "nc")
OBJECTS = (
    "object_recall_25", "object_recall_50", "object_precision_25", "object_precision_50", "object_cd_cm",
    "object_f_1cm",
)  # fmt: skip
CAMERAS = ("ate_cm", "scale_error", "tilt_deg", "rotation_median_deg")
PHYSICS = (
    "stable_rate", "stable_rate_10cm_0.1rad", "stable_rate_5cm_drop_5deg", "spawn_penetration_mm", "floating_rate",
)  # fmt: skip
GRAPH = ("graph_f1", "graph_f1_matched")
PICTURES = ("psnr_db", "ssim", "coverage")
ALL = GEOMETRY + OBJECTS + CAMERAS + PHYSICS + GRAPH + PICTURES
# Reading a mesh back from a file of float32 moves points by a fraction of a micrometre.
TOLERANCE = {
    "cd_cm": 2e-3,
    "object_cd_cm": 2e-3,
    "ate_cm": 1e-3,
    "psnr_db": 3.0,
    "spawn_penetration_mm": 0.05,
}


@pytest.fixture(scope="session")
def truth(tmp_path_factory) -> Truth:
    """The room's ground-truth folder, of few frames."""
    return write_truth(tmp_path_factory.mktemp("truth"), frames=11)


def unchanged(evaluation, perfect, names) -> None:
    for name in names:
        wanted, found = perfect.metrics[name], evaluation.metrics[name]
        if name == "psnr_db":  # beyond 60 dB only single pixels on edges differ
            wanted, found = min(wanted, 60), min(found, 60)
        assert found == pytest.approx(wanted, abs=TOLERANCE.get(name, 2e-3)), name


def except_for(*names: str) -> tuple[str, ...]:
    return tuple(name for name in ALL if name not in names)


def shifted(x=0.0, y=0.0, z=0.0) -> np.ndarray:
    return rigid(translation=np.array([x, y, z]))


def rotation(axis: int, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[i, i] = out[j, j] = c
    out[i, j], out[j, i] = -s, s
    return out


def score_of(evaluation, name: str) -> dict:
    return next(o for o in evaluation.objects if o["name"] == name)


def movable(evaluation) -> int:
    return evaluation.metrics["dynamic_objects"]


def test_the_truth_against_itself_is_perfect(perfect):
    expected = {
        "object_recall_25": 1, "object_recall_50": 1, "object_precision_25": 1, "object_precision_50": 1,
        "cd_cm": 0, "f_5cm": 100, "nc": 100, "object_cd_cm": 0, "object_f_1cm": 100, "graph_f1": 1,
        "graph_f1_matched": 1, "ate_cm": 0, "scale_error": 0, "tilt_deg": 0, "rotation_median_deg": 0,
        "stable_rate": 1, "stable_rate_10cm_0.1rad": 1, "stable_rate_5cm_drop_5deg": 1, "floating_rate": 0,
        "spawn_penetration_mm": 0, "ssim": 1, "time_s": 3.5, "peak_memory_mb": 700,
    }  # fmt: skip
    for name, value in expected.items():
        assert perfect.metrics[name] == pytest.approx(value, abs=TOLERANCE.get(name, 1e-3)), name
    assert perfect.metrics["psnr_db"] > 45
    assert 0.7 < perfect.metrics["coverage"] <= 1
    assert len(perfect.objects) == len(KINDS)
    assert movable(perfect) == len(KINDS) - len(FIXED)


def test_another_world_only_shows_in_the_scale(evaluate, perfect):
    """Alignment removes a similarity between the worlds; physics is simulated in the bundle's metres."""
    change = Change(
        estimated_from_true=np.diag([1.25, 1.25, 1.25, 1.0]) @ rigid(rotation(2, 40), [0.3, -1.2, 0.0])
    )
    found = evaluate(change)
    assert found.metrics["scale_error"] == pytest.approx(abs(1 / 1.25 - 1), abs=1e-5)
    unchanged(found, perfect, except_for("scale_error"))


def test_a_tilted_world_shows_in_the_tilt(evaluate, perfect):
    found = evaluate(Change(estimated_from_true=rigid(rotation(0, 3.0))))
    assert found.metrics["tilt_deg"] == pytest.approx(3.0, abs=1e-3)
    unchanged(found, perfect, GEOMETRY + OBJECTS + GRAPH + PICTURES + ("ate_cm", "scale_error"))


def test_camera_centers_off_by_noise(evaluate, truth):
    noise = np.random.default_rng(0).normal(0, 0.01, (len(truth.poses), 3))
    found = evaluate(Change(camera_error=lambda i, pose: shifted(*noise[i]) @ pose))
    # A similarity takes up seven of the 3n degrees of freedom of the noise.
    n = len(truth.poses)
    assert found.metrics["ate_cm"] == pytest.approx(np.sqrt(3 - 7 / n), rel=0.25)
    assert found.metrics["rotation_median_deg"] < 5


def test_cameras_turned_in_place(evaluate, perfect):
    found = evaluate(Change(camera_error=lambda i, pose: pose @ rigid(rotation(2, 0.7))))
    assert found.metrics["rotation_median_deg"] == pytest.approx(0.7, abs=1e-3)
    unchanged(found, perfect, GEOMETRY + OBJECTS + GRAPH + PHYSICS + ("ate_cm", "scale_error", "tilt_deg"))
    assert found.metrics["psnr_db"] < perfect.metrics["psnr_db"] - 5


def test_one_object_shifted(evaluate, perfect, truth):
    """The carton is shifted by 3 cm: only its box, surface and the renderings change."""
    found = evaluate(Change(moved={"carton": shifted(x=0.03)}))
    mesh = truth.entity("carton").mesh()
    low, high = mesh.bounds
    width = (high - low)[0]
    moved = score_of(found, "carton")
    assert moved["box_iou"] == pytest.approx((width - 0.03) / (width + 0.03), abs=1e-3)
    assert moved["center_error_cm"] == pytest.approx(3.0, abs=1e-2)
    assert 0.5 < moved["cd_cm"] < 3.0
    others = [o for o in found.objects if o["name"] != "carton"]
    assert all(o["box_iou"] == pytest.approx(1, abs=1e-4) and o["f_1cm"] > 99.9 for o in others)
    assert found.metrics["object_cd_cm"] == pytest.approx(moved["cd_cm"] / len(KINDS), abs=1e-3)
    assert found.metrics["psnr_db"] < perfect.metrics["psnr_db"]
    unchanged(found, perfect, CAMERAS + PHYSICS + GRAPH + ("object_recall_25", "object_precision_25"))


def test_a_thin_thing_off_its_wall_is_missed(evaluate, perfect):
    """4 cm from the wall the picture's thin box does not overlap the true one."""
    found = evaluate(Change(moved={"picture": shifted(y=-0.04)}))
    assert score_of(found, "picture")["match"] is None
    assert found.metrics["object_recall_25"] == pytest.approx(1 - 1 / len(KINDS))
    assert [item["label"] for item in found.extra] == ["picture"]
    assert found.metrics["cd_cm"] > perfect.metrics["cd_cm"] + 0.01
    unchanged(found, perfect, CAMERAS)


def test_chamfer_of_a_plane_moved_off_itself(evaluate, perfect):
    """4 mm from the wall each point of the picture's front and back is at most 4 mm from the truth."""
    found = evaluate(Change(moved={"picture": shifted(y=-0.004)}))
    assert score_of(found, "picture")["center_error_cm"] == pytest.approx(0.4, abs=1e-2)
    assert 0.25 < score_of(found, "picture")["cd_cm"] < 0.401 + 0.25  # 50,000 points lie millimetres apart
    unchanged(found, perfect, CAMERAS + GRAPH + ("object_recall_25",))


def test_one_object_too_large(evaluate, perfect, truth):
    low, high = truth.entity("can").mesh().bounds
    foot = np.array([*(0.5 * (low + high))[:2], low[2]])
    found = evaluate(Change(reshaped={"can": lambda points: foot + 1.2 * (points - foot)}))
    assert score_of(found, "can")["box_iou"] == pytest.approx(1 / 1.2**3, abs=2e-3)
    unchanged(found, perfect, CAMERAS + PHYSICS + GRAPH + ("object_recall_50", "object_precision_50"))


def test_one_object_missing(evaluate, perfect, truth):
    found = evaluate(Change(missing=("tin",)))
    n = len(KINDS)
    assert found.metrics["object_recall_25"] == pytest.approx((n - 1) / n)
    assert found.metrics["object_recall_50"] == pytest.approx((n - 1) / n)
    low, high = truth.entity("tin").mesh().bounds
    assert score_of(found, "tin")["cd_cm"] == pytest.approx(100 * np.linalg.norm(high - low), rel=1e-4)
    assert found.metrics["object_cd_cm"] == pytest.approx(score_of(found, "tin")["cd_cm"] / n, abs=1e-3)
    assert found.metrics["object_f_1cm"] == pytest.approx(100 * (n - 1) / n, abs=1e-2)
    assert found.metrics["matched_object_cd_cm"] == pytest.approx(0, abs=1e-3)
    assert found.metrics["graph_f1"] == pytest.approx(2 * (n - 1) / (2 * n - 1))
    unchanged(
        found, perfect, CAMERAS + PHYSICS + ("object_precision_25", "object_precision_50", "graph_f1_matched")
    )


def test_a_missing_support_makes_relations_wrong(evaluate, truth):
    """Without the book the edge of the tin on it is wrong, although the tin is found."""
    found = evaluate(Change(missing=("book",), parent={"tin": "table"}))
    assert found.metrics["graph_f1_matched"] < 1
    assert score_of(found, "tin")["relation_right"] is False
    assert score_of(found, "can")["relation_right"] is True


def test_one_object_floating(evaluate, perfect):
    found = evaluate(Change(moved={"can": shifted(z=0.04)}))
    n = movable(perfect)
    assert found.metrics["floating_rate"] == pytest.approx(1 / n)
    assert found.metrics["stable_rate"] == pytest.approx((n - 1) / n)  # it falls 4 cm ...
    assert found.metrics["stable_rate_10cm_0.1rad"] == 1  # ... which the looser thresholds allow
    assert found.metrics["stable_rate_5cm_drop_5deg"] == 1
    assert score_of(found, "can")["center_error_cm"] == pytest.approx(4.0, abs=1e-2)
    unchanged(found, perfect, CAMERAS + GRAPH + ("spawn_penetration_mm", "object_recall_25"))


def test_one_object_inside_its_support(evaluate, perfect):
    found = evaluate(Change(moved={"carton": shifted(z=-0.006)}))
    assert found.metrics["spawn_penetration_mm"] == pytest.approx(6.0, abs=0.3)
    unchanged(found, perfect, CAMERAS + GRAPH + ("floating_rate", "object_recall_50"))


def test_one_object_tipping_over(evaluate, perfect, truth):
    """A leaning carton falls: unstable at every threshold."""
    low, high = truth.entity("carton").mesh().bounds
    edge = np.array([high[0], 0.5 * (low + high)[1], low[2]])
    lean = shifted(*edge) @ rigid(rotation(1, 50.0)) @ shifted(*-edge)
    found = evaluate(Change(moved={"carton": shifted(z=0.001) @ lean}))
    n = movable(perfect)
    for name in ("stable_rate", "stable_rate_10cm_0.1rad", "stable_rate_5cm_drop_5deg"):
        assert found.metrics[name] <= (n - 1) / n + 1e-9, name


def test_one_parent_swapped(evaluate, perfect):
    found = evaluate(Change(parent={"tin": "table"}))
    n = len(KINDS)
    assert found.metrics["graph_f1"] == pytest.approx((n - 1) / n)
    assert found.metrics["graph_f1_matched"] == pytest.approx((n - 1) / n)
    unchanged(found, perfect, except_for("graph_f1", "graph_f1_matched"))


def test_brighter_textures(evaluate, perfect):
    found = evaluate(Change(brighter=10))
    assert found.metrics["psnr_db"] == pytest.approx(20 * np.log10(255 / 10), abs=0.05)
    assert found.metrics["ssim"] < perfect.metrics["ssim"]
    unchanged(found, perfect, except_for("psnr_db", "ssim"))


def test_a_missing_wall_lowers_coverage_only_where_it_was(evaluate, perfect):
    found = evaluate(Change(missing=("wall_north", "picture")))
    assert found.metrics["coverage"] < perfect.metrics["coverage"] - 0.1
    assert found.metrics["psnr_db"] > 33  # over the pixels that are covered
    assert found.metrics["f_5cm"] < 99
    assert found.stages["rendering"]["frames"] == 2


def test_nothing_found_scores_nothing(evaluate):
    found = evaluate(Change(missing=KINDS))
    assert found.metrics["object_recall_25"] == 0
    assert found.metrics["object_precision_25"] == 0
    assert found.metrics["object_f_1cm"] == 0
    assert found.metrics["graph_f1"] == 0
    assert found.metrics["matched_object_cd_cm"] is None


def test_without_truth_only_what_needs_none(truth, tmp_path):
    from truth_bundle import write_bundle

    found = evaluate_scene(write_bundle(truth, tmp_path / "bundle"), None, video=truth.frames)
    assert found.metrics["stable_rate"] == 1
    assert found.metrics["psnr_db"] > 45
    assert "cd_cm" not in found.metrics
    assert any("no ground truth" in reason for reason in found.left_out.values())


def test_truth_of_another_video_is_refused(truth, tmp_path):
    from truth_bundle import write_bundle

    bundle = write_bundle(truth, tmp_path / "bundle")
    for frame in bundle.scene["cameras"]["frames"]:
        frame["index"] += 1000
    with pytest.raises(UsageError, match="same video"):
        evaluate_scene(bundle, truth.folder, video=truth.frames)


def test_box_iou_by_hand():
    a = np.array([[[0, 0, 0], [2, 2, 2]]])
    b = np.array([[[1, 0, 0], [3, 2, 2]], [[5, 5, 5], [6, 6, 6]], [[0, 0, 0], [2, 2, 2]]])
    assert box_iou(a, b)[0] == pytest.approx([4 / 12, 0, 1])


def test_matching_is_one_to_one_and_keeps_to_the_bound():
    iou = np.array([[0.9, 0.8], [0.85, 0.1], [0.2, 0.2]])
    assert sorted(match(iou, 0.25)) == [(0, 1), (1, 0)]  # greedy would give 0.9 and leave the second alone
    assert match(iou, 0.95) == []
    assert match(np.zeros((0, 3)), 0.25) == []


def test_graph_f1_counts_edges_of_both_sides():
    true = {(1, "supported_by", 0), (2, "supported_by", 1), (3, "attached_to", 0)}
    found = {(1, "supported_by", 0), (2, "attached_to", 1), (4, "supported_by", 0), (3, "attached_to", 0)}
    assert graph_f1(found, true) == pytest.approx(2 * 2 / 7)
