"""Anchors mean the same thing in another reconstruction of the same film; clicks go through the lens."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruction.cache import StageStore
from reconstruction.config import PipelineConfig
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import DistortedCamera, ScaleEstimate, WorldFrame
from reconstruction.editing.addresses import Address, parse_address
from reconstruction.editing.anchors import Footage, Pointer
from reconstruction.editing.overrides import Overrides
from reconstruction.gaussians import Gaussians, GaussianScene
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.pipeline import STAGES
from reconstruction.poses.lens import Lens
from reconstruction.publish.instance_views import choose_views
from reconstruction.runner import Run
from reconstruction.surface import SurfaceConfig, fuse_surface
from registry.errors import UsageError

pytestmark = pytest.mark.stage


def cut(posed, depth, voxel_size_m: float) -> Pointer:
    config = SurfaceConfig(voxel_size_m=voxel_size_m)
    surface = fuse_surface(posed, depth, config, progress=NO_PROGRESS)
    found = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    lens = Lens.of(posed)
    return Pointer(found, surface, Footage(posed, depth, lens, surface))


@pytest.fixture(scope="module")
def first(small_capture) -> Pointer:
    return cut(small_capture.posed, small_capture.depth, 0.012)


def clicks(pointer: Pointer) -> dict[int, Address]:
    """Return the anchor that a user is given for each thing."""
    source = pointer.footage.posed.source
    ids = [o.id for o in pointer.found.objects]
    views = choose_views(pointer.found.id_maps, ids, [pointer.footage.lens] * len(pointer.found.id_maps))
    out = {}
    for number, (row, x, y) in views.anchors.items():
        frame = int(pointer.footage.posed.indices[row])
        out[number] = parse_address(
            {"pixel": {"frame": frame, "x": x * source.width, "y": y * source.height}}, ""
        )
    return out


def same_place(pointer: Pointer, a, other: Pointer, b, scale: float) -> bool:
    """Tell whether two things overlap for the most part, by their boxes parallel to the axes."""
    boxes = []
    for p, item, s in ((pointer, a, 1.0), (other, b, scale)):
        points = p.surface.vertices[p.found.vertex_instance == item.id] / s
        boxes.append(np.percentile(points, [2, 98], axis=0))
    shared = np.prod(
        np.maximum(np.minimum(boxes[0][1], boxes[1][1]) - np.maximum(boxes[0][0], boxes[1][0]), 0)
    )
    return shared > 0.3 * max(np.prod(box[1] - box[0]) for box in boxes)


def test_every_thing_has_an_anchor_that_means_it(first):
    anchors = clicks(first)
    assert set(anchors) == {o.id for o in first.found.objects}
    for number, address in anchors.items():
        assert first.thing(address).id == number


def test_clicks_survive_another_spacing_and_another_scale(small_capture, first):
    """Ids are given anew, metres are others; the clicks still mean the same things."""
    voxel_size_m, scale = 0.015, 1.25
    posed, depth = small_capture.in_sfm_space(np.diag([scale, scale, scale, 1.0]))
    again = cut(posed, depth, voxel_size_m * scale)
    kept = 0
    for number, address in clicks(first).items():
        item = next(o for o in first.found.objects if o.id == number)
        if not any(same_place(first, item, again, other, scale) for other in again.found.objects):
            continue  # the other cut does not have this thing
        assert same_place(first, item, again, again.thing(address), scale), item.label
        kept += 1
    assert kept >= 0.7 * len(first.found.objects)


def test_clicks_in_held_out_and_in_skipped_frames(first):
    """A held-out frame has a camera; one that was never posed is between two that were."""
    posed = first.footage.posed
    table = max(first.found.objects, key=lambda o: np.prod(o.extents_m[:2]))
    points = first.surface.vertices[first.found.vertex_instance == table.id]
    held = int(posed.held_out_indices[-1])
    skipped = int(posed.indices[5])
    per_frame = ("images", "indices", "times_s", "world_from_camera", "sharpness")
    without = replace(posed, **{name: np.delete(getattr(posed, name), 5, axis=0) for name in per_frame})
    for frame, pose, footage in (
        (held, posed.held_out_world_from_camera[-1], first.footage),
        (skipped, posed.world_from_camera[5], replace(first.footage, posed=without)),
    ):
        seen = first.footage.seen_vertices(pose)
        mask = np.where(seen >= 0, first.found.vertex_instance[seen], 0) == table.id
        inner = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
        row, column = np.unravel_index(np.argmax(inner), inner.shape)
        address = Address("pixel", frame=frame, pixel=(column + 0.5, row + 0.5))
        pointer = replace(first, footage=footage)
        assert pointer.thing(address).id == table.id
        hit = first.surface.vertices[pointer.vertex(address, table)]
        assert np.linalg.norm(points - hit, axis=1).min() == 0


def test_a_frame_far_from_any_camera_is_refused(first):
    with pytest.raises(UsageError, match=r"no camera is known of frame 500 \(the film has 14\)"):
        first.thing(Address("pixel", frame=500, pixel=(3, 3)))


@pytest.mark.parametrize(
    "value",
    [
        {},
        {"id": 3, "pixel": {"frame": 1, "x": 2, "y": 3}},
        {"id": True},
        {"at": [1, 2]},
        {"at": [0, 0, 0], "near": [0, 0, 0]},
        {"pixel": [1, 2, 3]},
        {"pixel": {"frame": 1.5, "x": 2, "y": 3}},
        {"pixel": {"frame": 1, "x": 2, "y": float("nan")}},
        {"pixel": {"frame": 1, "x": 2, "y": 3, "size": [4]}},
        "mug",
    ],
)
def test_what_is_no_address_is_said(value):
    with pytest.raises(UsageError, match="entry 7"):
        parse_address(value, "entry 7")


def test_clicks_go_through_the_lens(small_capture):
    """The map agrees with OpenCV, for a lens with barrel distortion."""
    camera = small_capture.posed.camera
    matrix, bent = shifted(camera), np.array([-0.12, 0.03, 0.001, 0.0])
    params = np.array([*camera.intrinsics, *bent])
    distorted = DistortedCamera("OPENCV", camera.width, camera.height, params)
    lens = Lens.of(replace(small_capture.posed, distorted=distorted))
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).reshape(-1, 2) + 0.5
    there = lens.straightened(grid)
    rays = camera.unproject(there[:, 0], there[:, 1], np.ones(len(there)))
    again = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, bent)[0][:, 0] + 0.5
    assert np.abs(again - grid).max() < 1e-3
    assert np.linalg.norm(there - grid, axis=1).max() > 4
    assert np.array_equal(Lens.of(small_capture.posed).straightened(grid), grid)


def test_pixels_that_the_lens_cannot_see_are_outside(small_capture):
    camera = small_capture.posed.camera
    strong = np.array([0.6 * camera.fx, camera.cx, camera.cy, -0.8, 0.0])
    lens = Lens(camera, DistortedCamera("RADIAL", camera.width, camera.height, strong))
    assert (lens.straightened(np.array([[0.5, 0.5]])) < 0).all()
    assert np.allclose(lens.straightened(np.array([[camera.cx, camera.cy]])), [[camera.cx, camera.cy]])
    assert lens.as_filmed(np.ones((camera.height, camera.width), np.uint16))[0, 0] == 0


def shifted(camera) -> np.ndarray:
    """Return K for OpenCV, whose pixel centers are at whole numbers."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])


def seeded_store(folder, results: dict, config: PipelineConfig) -> StageStore:
    """Return a store in which the stages before the cut are finished."""
    store = StageStore(folder)
    run = Run(Path("film.mp4"), config, store, input_digest=results["frames"].source.sha256)
    for number, stage in enumerate(STAGES[:6], start=1):
        run.keys[stage.name] = run.key_of(stage, [])
        usage = {"wall_s": 1.0, "cpu_s": 1.0, "peak_memory_mb": 1.0}
        record = {"usage": usage, "notes": []}
        store.save(results[stage.name], number, stage.name, run.keys[stage.name], record)
    return store


def test_another_correction_redoes_nothing_but_itself(small_capture, first, tmp_path):
    """The cut is made once; each set of corrections is applied to it, by clicks in the film."""
    posed, depth = small_capture.in_sfm_space(np.eye(4))
    n = len(posed.images)
    none = np.zeros((0, 3), np.float32)
    gain, bias = np.ones((n, 3), np.float32), np.zeros((n, 3), np.float32)
    disks = Gaussians(
        none, np.zeros((0, 4), np.float32), none[:, :2], none[:, 0], none, gain, bias, posed.world_from_camera
    )
    results = {
        "frames": small_capture.frame_set(),
        "poses": posed,
        "depth": depth,
        "world": WorldFrame(np.eye(4), ScaleEstimate("marker", 0.01, ""), "planes", 0.1, True, True),
        "gaussians": GaussianScene(disks, depth),
        "surface": first.surface,
    }
    config = PipelineConfig()
    store = seeded_store(tmp_path, results, config)
    click = next(iter(clicks(first).values()))
    said = {"pixel": {"frame": click.frame, "x": click.pixel[0], "y": click.pixel[1]}}

    def cut_with(label: str) -> Run:
        corrections = Overrides([{**said, "relabel": label}])
        digest = results["frames"].source.sha256
        run = Run(Path("film.mp4"), config, store, corrections, input_digest=digest)
        run.execute(until="instances")
        assert [o.label for o in run.results["instances"].objects].count(label) == 1
        return run

    run = cut_with("anvil")
    assert run.computed == {"instances"}
    folders = {p: p.stat().st_ctime_ns for p in tmp_path.glob("07_*/manifest.json")}
    assert len(folders) == 2  # the cut as found, and corrected
    again = cut_with("harp")
    kept = [p for p in tmp_path.glob("07_*/manifest.json") if folders.get(p) == p.stat().st_ctime_ns]
    assert len(kept) == 1
    assert again.keys["instances"] != run.keys["instances"]
    assert again.usage["instances"].wall_s > 0
