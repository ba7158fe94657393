"""Learned depth fills what is unknown: alignment, fusion, refusal, and the loading of real (tiny) models."""

from dataclasses import replace

import numpy as np
import pytest
from notes import Notes
from test_depth import CAMERA, CONFIG, make_posed

from reconstruction.depth import estimate_depth
from reconstruction.depth.config import DepthConfig
from reconstruction.depth.monocular import fill_from_predictions, fit_affine
from reconstruction.depth.scene import DepthScene
from reconstruction.depth.views import plan_views
from registry.errors import EnvironmentMissing, UsageError

pytestmark = pytest.mark.stage

HOLE = (slice(20, 110), slice(60, 180))  # over the wall and the box: no plane fills it


class Oracle:
    """Knows the true inverse depth up to a random scale and shift per image, bends it a little, and is noisy."""

    name = "oracle"

    def __init__(self, images: np.ndarray, truth: np.ndarray) -> None:
        self.images, self.truth = images, truth
        self.rng = np.random.default_rng(5)
        self.spoil = lambda row, inverse: inverse

    def predict(self, images: list[np.ndarray]) -> list[np.ndarray]:
        return [self._one(image) for image in images]

    def _one(self, image: np.ndarray) -> np.ndarray:
        row = next(i for i, known in enumerate(self.images) if np.array_equal(known, image))
        z = self.truth[row]
        bend = 1.0 + 0.03 * np.sin(np.linspace(0, 4, z.shape[1]))
        inverse = np.where(z > 0, 1.0 / np.maximum(z, 1e-9), 0.0) * bend
        inverse *= 1.0 + self.rng.normal(0, 0.005, z.shape)
        inverse = self.spoil(row, inverse)
        scale, shift = self.rng.uniform(0.5, 40.0), self.rng.uniform(-3.0, 3.0)
        return (scale * inverse + shift).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    """Return the frames, true depth, and depth maps that are right outside a hole and empty within."""
    posed, truth = make_posed()
    depth, confidence = truth.astype(np.float32).copy(), np.where(truth > 0, 2, 0).astype(np.uint8)
    depth[:, HOLE[0], HOLE[1]], confidence[:, HOLE[0], HOLE[1]] = 0, 0
    return posed, truth, depth, confidence


def fill(scene, backend, depth=None, confidence=None):
    posed, _, known, sure = scene
    watcher = Notes()
    seen = DepthScene(posed, CAMERA, plan_views(posed, CONFIG), CONFIG, watcher)
    found = fill_from_predictions(
        seen, known if depth is None else depth, sure if confidence is None else confidence, backend
    )
    return *found, watcher.notes


def test_a_hole_is_filled_with_true_depth_of_low_confidence(scene) -> None:
    posed, truth, known, sure = scene
    depth, confidence, notes = fill(scene, Oracle(posed.images, truth))
    fresh = (known == 0) & (depth > 0) & (truth > 0)
    assert fresh[:, HOLE[0], HOLE[1]].mean() > 0.85
    assert (confidence[fresh] == 1).all()
    error = np.abs(depth[fresh] / truth[fresh] - 1)
    assert np.median(error) < 0.02
    assert (error > 0.05).mean() < 0.05
    assert np.array_equal(depth[sure == 2], known[sure == 2])
    assert np.array_equal(confidence == 2, sure == 2)
    assert "0 of 9 frames could not be fitted" in notes[0]


def test_a_prediction_that_does_not_fit_is_left_out_and_counted(scene) -> None:
    posed, truth, known, _ = scene
    backend = Oracle(posed.images, truth)
    noise = np.random.default_rng(0)
    backend.spoil = lambda row, inverse: noise.uniform(0, 1, inverse.shape) if row == 4 else inverse
    depth, _, notes = fill(scene, backend)
    assert np.array_equal(depth[4], known[4])
    assert "1 of 9 frames could not be fitted" in notes[0]


def test_what_other_views_look_through_is_dropped(scene) -> None:
    posed, truth, known, sure = scene
    depth, confidence = known.copy(), sure.copy()
    others = np.arange(len(truth)) != 4
    depth[others], confidence[others] = truth[others], np.where(truth[others] > 0, 2, 0)
    backend = Oracle(posed.images, truth)
    ghost = (slice(40, 80), slice(80, 120))

    def spoil(row: int, inverse: np.ndarray) -> np.ndarray:
        out = inverse.copy()
        if row == 4:
            out[ghost] *= 1.6
        return out

    backend.spoil = spoil
    filled, trust, _ = fill(scene, backend, depth, confidence)
    inside = (slice(46, 74), slice(86, 114))
    assert (filled[4][inside] > 0).mean() < 0.05
    assert (trust[4][inside] == 0).mean() > 0.95
    right = np.abs(filled[4] / np.maximum(truth[4], 1e-9) - 1) < 0.03
    assert right[HOLE[0], 125:180].mean() > 0.8


def test_alignment_withstands_wrong_anchors() -> None:
    rng = np.random.default_rng(2)
    prediction = rng.uniform(1, 9, 1000)
    rho = 0.08 * prediction + 0.15
    rho[:350] = rng.uniform(0.1, 1.0, 350)
    fit = fit_affine(prediction, rho, seed=0)
    assert fit.scale == pytest.approx(0.08, rel=0.02)
    assert fit.shift == pytest.approx(0.15, rel=0.05)
    assert fit_affine(-prediction, rho, seed=0) is None
    assert fit_affine(np.ones(1000), rho, seed=0) is None


def test_the_stage_uses_the_backend_where_nothing_else_reaches() -> None:
    posed, truth = make_posed()
    config = replace(CONFIG, complete=False, prior="none")
    plain = estimate_depth(posed, config)
    watcher = Notes()
    maps = estimate_depth(posed, config, backend=Oracle(posed.images, truth), progress=watcher)
    assert np.array_equal(maps.depth[plain.depth > 0], plain.depth[plain.depth > 0])
    fresh = (plain.depth == 0) & (maps.depth > 0) & (truth > 0)
    assert fresh.sum() > 0.5 * ((plain.depth == 0) & (truth > 0)).sum()
    assert np.median(np.abs(maps.depth[fresh] / truth[fresh] - 1)) < 0.02
    assert any("oracle filled" in note for note in watcher.notes)


# ---- Loading through transformers.


def save_tiny_model(folder, **options) -> str:
    """Write a randomly initialised Depth Anything of 23,000 parameters, with its image processor."""
    torch = pytest.importorskip("torch")
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=16, num_hidden_layers=2, num_attention_heads=2, intermediate_size=32, patch_size=14,
        image_size=56, out_features=["stage1", "stage2"], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[8, 8],
        reassemble_factors=[2, 1], fusion_hidden_size=8, head_hidden_size=8, **options,
    )  # fmt: skip
    model = transformers.DepthAnythingForDepthEstimation(config)
    for parameter in model.parameters():  # as they are initialised, all outputs are next to zero
        torch.nn.init.normal_(parameter, std=0.3)
    model.save_pretrained(folder)
    processor = transformers.DPTImageProcessor(
        size={"height": 56, "width": 56}, keep_aspect_ratio=True, ensure_multiple_of=14
    )
    processor.save_pretrained(folder)
    return str(folder)


def test_a_model_saved_in_a_folder_is_loaded_and_predicts_batches(tmp_path) -> None:
    from reconstruction.depth.monocular import load_monocular

    folder = save_tiny_model(tmp_path)
    backend = load_monocular(DepthConfig(monocular="transformers", monocular_model=folder))
    images = list(np.random.default_rng(0).integers(0, 255, (3, 60, 80, 3), np.uint8))
    together = backend.predict(images)
    assert [m.shape for m in together] == [(60, 80)] * 3
    assert all(m.dtype == np.float32 and np.isfinite(m).all() for m in together)
    alone = backend.predict(images[1:2])[0]
    assert together[1].std() > 1e-3
    assert np.allclose(alone, together[1], rtol=1e-3, atol=1e-5)
    assert not np.allclose(together[0], together[1], rtol=1e-2)


def test_metric_models_are_turned_into_inverse_depth_and_serve_the_scale(tmp_path) -> None:
    from reconstruction.depth.monocular import load_monocular
    from reconstruction.learned.depth_model import DepthModel
    from reconstruction.world.config import WorldConfig
    from reconstruction.world.metric_depth import load_backend

    metric = save_tiny_model(tmp_path / "metric", depth_estimation_type="metric", max_depth=20)
    relative = save_tiny_model(tmp_path / "relative")
    image = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    metres = DepthModel(metric, asked_by="test").predict([image])[0]
    assert metres.min() > 0.0
    assert metres.max() <= 20.0
    inverse = load_monocular(DepthConfig(monocular="transformers", monocular_model=metric)).predict([image])
    assert np.allclose(inverse[0], 1.0 / metres, rtol=1e-5)
    scale = load_backend(WorldConfig(metric_depth="transformers", metric_depth_model=metric))
    assert np.allclose(scale.predict(image, CAMERA.resized(80, 60)), metres)
    with pytest.raises(UsageError, match="without scale"):
        load_backend(WorldConfig(metric_depth="transformers", metric_depth_model=relative))


def test_a_missing_model_names_the_option(tmp_path) -> None:
    pytest.importorskip("transformers")
    from reconstruction.depth.monocular import load_monocular

    with pytest.raises(EnvironmentMissing, match=r"depth\.monocular_model=DIR"):
        load_monocular(DepthConfig(monocular="transformers", monocular_model=str(tmp_path / "nothing")))


def test_nothing_is_loaded_unless_asked_for() -> None:
    from reconstruction.depth.monocular import load_monocular

    assert load_monocular(DepthConfig()) is None
