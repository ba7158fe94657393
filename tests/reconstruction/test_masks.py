"""Every mask backend keeps the same promises; the learned ones are loaded from tiny random models on disk."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import tiny_models

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, VideoSource
from reconstruction.instances import InstancesConfig
from reconstruction.instances.masks import KeyframeMasks, flatten_masks, load_mask_backend, mask2former, sam
from reconstruction.learned.models import ModelRequest, transformers_class
from registry.errors import EnvironmentMissing

pytestmark = pytest.mark.stage

pytest.importorskip("transformers")

HEIGHT, WIDTH, FRAMES = 48, 64, 2
SAVED = {
    "sam2": tiny_models.save_sam2,
    "sam3": tiny_models.save_sam3,
    "mask2former": tiny_models.save_mask2former,
}
LEARNED = ("sam2", "sam3", "sam3 of concepts", "mask2former")


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Tiny models gain nothing from threads, and lose much to them on a busy machine."""
    with tiny_models.one_thread():
        yield


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """One folder a kind of model, saved once."""
    root = tmp_path_factory.mktemp("models")
    return {name: save(root / name) for name, save in SAVED.items()}


@pytest.fixture
def open_filters(monkeypatch):
    """Random weights are sure of nothing: let all their masks through."""
    monkeypatch.setattr(sam, "_POINTS_A_BATCH", 6)
    for module, names in (
        (sam, ("_MIN_IOU", "_MIN_STABILITY", "_MIN_CONCEPT_SCORE")),
        (mask2former, ("_MIN_SCORE",)),
    ):
        for name in names:
            monkeypatch.setattr(module, name, -1.0)


def config_of(name: str, folders: dict[str, str]) -> InstancesConfig:
    kind, _, concepts = name.partition(" of ")
    return InstancesConfig(
        masks=kind,
        masks_model=folders[kind],
        masks_concepts="table, cup" if concepts else "",
        learned_device="cpu",
    )


def capture(images: np.ndarray) -> tuple[PosedFrames, DepthMaps]:
    """Return frames and depth of a camera that moves sideways before a wall."""
    n = len(images)
    camera = Camera(WIDTH, HEIGHT, 60.0, 60.0, WIDTH / 2, HEIGHT / 2)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(n)
    posed = PosedFrames(
        source=VideoSource("v.mp4", "", WIDTH, HEIGHT, 30.0, 20, 1.0), camera=camera, images=images,
        indices=(3 + 4 * np.arange(n)).astype(np.int32), times_s=0.1 * np.arange(n), world_from_camera=poses,
        sharpness=np.ones(n, np.float32), held_out_images=images[:0], held_out_indices=np.zeros(0, np.int32),
        held_out_times_s=np.zeros(0), held_out_world_from_camera=poses[:0], points=np.zeros((0, 3)),
        point_colors=np.zeros((0, 3), np.uint8), point_errors_px=np.zeros(0, np.float32),
        observations=np.zeros((0, 2), np.int32), chosen_frames=n, ordered=True, reprojection_error_px=0.5,
    )  # fmt: skip
    depth = np.full((n, HEIGHT, WIDTH), 2.0, np.float32)
    return posed, DepthMaps(camera, depth, np.full(depth.shape, 2, np.uint8))


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (FRAMES, HEIGHT, WIDTH, 3), np.uint8)


def check_promises(backend, posed: PosedFrames, depth: DepthMaps) -> np.ndarray:
    """Check what every `MaskBackend` promises; returns the ids."""
    masks = backend.frame_masks(posed, depth, progress=NO_PROGRESS)
    n = len(masks.frame_indices)
    assert isinstance(backend.name, str)
    assert backend.name
    assert masks.ids.dtype == np.uint16
    assert masks.ids.shape == (n, masks.camera.height, masks.camera.width)
    assert masks.world_from_camera.shape == (n, 4, 4)
    known = dict(zip(posed.indices.tolist(), posed.world_from_camera))
    known |= dict(zip(posed.held_out_indices.tolist(), posed.held_out_world_from_camera))
    for index, pose in zip(masks.frame_indices.tolist(), masks.world_from_camera):
        assert np.array_equal(pose, known[index])
    again = backend.frame_masks(posed, depth, progress=NO_PROGRESS)
    assert np.array_equal(again.ids, masks.ids)
    return masks.ids


@pytest.mark.usefixtures("open_filters")
@pytest.mark.parametrize("name", LEARNED)
def test_learned_masks_keep_the_promises_of_the_seam(name, folders) -> None:
    backend = load_mask_backend(config_of(name, folders))
    ids = check_promises(backend, *capture(noise()))
    assert ids.any()
    assert not np.array_equal(ids[0], ids[1])  # what is in the image decides
    counts = [len(np.unique(one[one > 0])) for one in ids]
    assert all(one.max() >= count for one, count in zip(ids, counts))
    assert folders[name.split(" of ")[0]] in backend.name


@pytest.mark.parametrize("name", LEARNED)
def test_masks_of_which_a_model_is_not_sure_are_left_out(name, folders, monkeypatch) -> None:
    monkeypatch.setattr(sam, "_MIN_IOU", 1.1)
    monkeypatch.setattr(sam, "_MIN_CONCEPT_SCORE", 1.1)
    monkeypatch.setattr(mask2former, "_MIN_SCORE", 1.1)
    black = np.zeros((1, HEIGHT, WIDTH, 3), np.uint8)
    ids = check_promises(load_mask_backend(config_of(name, folders)), *capture(black))
    assert not ids.any()


def test_masks_of_a_folder_keep_the_promises_of_the_seam(tmp_path) -> None:
    posed, depth = capture(noise())
    for number, index in enumerate(posed.indices.tolist()):
        ids = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint16)
        ids[4:20, 6 : 10 + number] = 300 + number
        cv2.imwrite(str(tmp_path / f"{index:05d}.png"), ids)
    backend = load_mask_backend(InstancesConfig(masks="folder", masks_path=str(tmp_path)))
    ids = check_promises(backend, posed, depth)
    assert sorted(np.unique(ids)) == [0, 300, 301]


def test_the_embedded_cut_needs_no_masks() -> None:
    assert load_mask_backend(InstancesConfig()) is None


@pytest.mark.parametrize("name", list(SAVED))
def test_missing_weights_name_the_option_and_the_download(name, tmp_path) -> None:
    config = InstancesConfig(masks=name, masks_model=str(tmp_path / "none"))
    with pytest.raises(EnvironmentMissing, match=r"hf download .*instances\.masks_model=DIR"):
        load_mask_backend(config)


def test_weights_of_another_kind_of_model_are_refused(folders) -> None:
    config = replace(config_of("sam2", folders), masks_model=folders["mask2former"])
    with pytest.raises(EnvironmentMissing, match=r"another kind of model|cannot be loaded"):
        load_mask_backend(config)


def test_an_old_transformers_is_told_apart_from_a_missing_one() -> None:
    with pytest.raises(EnvironmentMissing, match=r"transformers [\d.]+ has no Sam9Model.*simrecon\[models\]"):
        transformers_class("Sam9Model", "instances.masks")


# ---- What the grid of points is made of.


def test_the_grid_is_the_middle_of_equal_cells() -> None:
    points = sam.point_grid(2)
    assert np.allclose(points, [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])


@pytest.mark.usefixtures("open_filters")
def test_batches_of_points_do_not_change_the_masks(folders, monkeypatch) -> None:
    segmenter = sam.PointGridMasks(ModelRequest(folders["sam2"], "masks", "masks_model"), "Sam2Model", 4)
    image = noise()[0]
    together = segmenter.segment(image)
    monkeypatch.setattr(sam, "_POINTS_A_BATCH", 16)
    assert (segmenter.segment(image) == together).mean() > 0.99


def test_images_are_stretched_and_normalized_as_the_model_file_says(folders) -> None:
    square = sam.SquareImages(ModelRequest(folders["sam2"], "masks", "masks_model"), 64)
    gray = np.full((30, 90, 3), 128, np.uint8)
    values = square(gray)
    assert values.shape == (1, 3, 64, 64)
    expected = (128 / 255 - np.array([0.485, 0.456, 0.406])) / 0.5
    assert np.allclose(values[0, :, 10, 20].numpy(), expected, atol=1e-6)


def test_stability_is_the_overlap_of_two_thresholds() -> None:
    import torch

    sharp, vague = torch.full((4, 4), -5.0), torch.full((4, 4), -0.5)
    sharp[:2], vague[0] = 5.0, 5.0
    assert np.allclose(sam.stability(torch.stack([sharp, vague])).numpy(), [1.0, 0.25])


def test_of_double_boxes_the_most_trusted_stays() -> None:
    masks = np.zeros((4, 20, 20), bool)
    masks[0, 2:12, 2:12] = masks[1, 2:12, 2:13] = True
    masks[2, 4:8, 4:8] = True
    boxes = sam.boxes_of(masks)
    assert boxes.tolist() == [[2, 2, 12, 12], [2, 2, 13, 12], [4, 4, 8, 8], [0, 0, 0, 0]]
    assert sam.without_doubles(boxes, np.array([0.8, 0.9, 0.5, 1.0])).tolist() == [1, 2]


def test_specks_are_left_out_and_small_masks_lie_upon_large_ones() -> None:
    masks = np.zeros((3, 200, 200), bool)
    masks[0], masks[1, 50:80, 50:80], masks[2, 0, 0] = True, True, True
    ids = sam.flatten_large(masks, np.array([0.9, 0.8, 0.99]))
    assert sorted(np.unique(ids)) == [1, 2]
    assert ids[60, 60] == 2
    assert not sam.flatten_large(masks[:0], np.zeros(0)).any()


def test_no_masks_are_an_empty_image() -> None:
    assert flatten_masks(np.zeros((0, 5, 7), bool), np.zeros(0)).shape == (5, 7)


def test_a_segmenter_of_ones_own_serves_every_keyframe() -> None:
    class Halves:
        name = "halves"

        def segment(self, image: np.ndarray) -> np.ndarray:
            ids = np.ones(image.shape[:2], np.uint16)
            ids[:, image.shape[1] // 2 :] = 2
            return ids

    ids = check_promises(KeyframeMasks(Halves()), *capture(noise()))
    assert (ids[:, :, 0] == 1).all()
    assert (ids[:, :, -1] == 2).all()
