"""The choice of a film's model among several, on made cameras around a cloud of points."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.poses import PosesConfig, mapping
from reconstruction.poses.best_model import best_model
from reconstruction.poses.diagnose import check_model, explained_share
from reconstruction.poses.features import Features
from reconstruction.poses.first_pair import starts_along_film
from reconstruction.poses.pairs import VerifiedPair
from registry.errors import InputError
from registry.geometry import umeyama

pytestmark = pytest.mark.stage

FRAMES, POINTS = 14, 260
CAMERA = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 500.0, 640, 480)


def cameras() -> np.ndarray:
    """Return camera_from_world (n, 3, 4) along an arc of 70 degrees around the origin."""
    out = []
    for angle in np.radians(np.linspace(-35, 35, FRAMES)):
        turn = Rotation.from_euler("y", angle).as_matrix()
        out.append(np.column_stack([turn, [0.0, 0.05 * np.sin(3 * angle), 4.0]]))
    return np.array(out)


@pytest.fixture(scope="module")
def film() -> tuple[list[Features], list[VerifiedPair]]:
    """Return features with .4 pixels of noise, and pairs of frames up to four apart, without wrong matches."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.2, 1.2, (POINTS, 3))
    features = []
    for pose in cameras():
        local = points @ pose[:, :3].T + pose[:, 3]
        pixels = 500.0 * local[:, :2] / local[:, 2:] + [320, 240] + rng.normal(0, 0.4, (POINTS, 2))
        none = np.zeros(POINTS, np.float32)
        features.append(Features(pixels.astype(np.float32), none, np.zeros((POINTS, 128), np.float32)))
    same = np.tile(np.arange(POINTS, dtype=np.uint32)[:, None], (1, 2))
    pairs = []
    for i in range(FRAMES):
        for j in range(i + 1, min(i + 5, FRAMES)):
            a, b = (features[k].keypoints.astype(np.float64) for k in (i, j))
            geometry = pycolmap.estimate_two_view_geometry(CAMERA, a, CAMERA, b, same)
            pairs.append(VerifiedPair((i, j), np.asarray(geometry.inlier_matches), geometry))
    return features, pairs


@pytest.fixture
def database(film, tmp_path):
    path = tmp_path / "database.db"
    mapping.write_database(path, CAMERA, *film)
    return path


def error(model: pycolmap.Reconstruction) -> float:
    """Return the largest error of a camera's center, as a share of the path's radius."""
    poses = mapping.poses_of(model)
    true = np.array([-pose[:, :3].T @ pose[:, 3] for pose in cameras()])[sorted(poses)]
    found = np.array([poses[row][:3, 3] for row in sorted(poses)])
    fit = umeyama(found, true)
    return float(np.linalg.norm(found @ fit[:3, :3].T + fit[:3, 3] - true, axis=1).max() / 4.0)


def first_models(film, database) -> list[pycolmap.Reconstruction]:
    return mapping.incremental_models(database, *film, CAMERA, PosesConfig(), NO_PROGRESS)


class Notes(list):
    def start(self, *_): ...
    def advance(self, *_): ...

    def note(self, message: str) -> None:
        self.append(message)


def test_a_sure_model_stays_alone(film, database):
    notes = Notes()
    model = best_model(first_models(film, database), *film, CAMERA, FRAMES, PosesConfig(), database, notes)
    assert model is not None
    assert model.num_reg_images() == FRAMES
    assert error(model) < 0.01
    assert explained_share(model, *film) > 0.99
    assert notes == []


def test_a_bent_model_explains_less_and_loses_against_others(film, database):
    models = first_models(film, database)
    bent = models[0]
    for number, image_id in enumerate(sorted(bent.reg_image_ids())):
        frame, turn = bent.image(image_id).frame, Rotation.from_euler("x", 2.5 * number, degrees=True)
        moved = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_quat()), np.zeros(3)) * frame.rig_from_world
        frame.rig_from_world = moved
    assert explained_share(bent, *film) < 0.5
    notes = Notes()
    model = best_model(models, *film, CAMERA, FRAMES, PosesConfig(), database, notes)
    assert model is not None
    assert model.num_reg_images() == FRAMES
    assert error(model) < 0.01
    assert len(notes) == 1
    assert "one with 14 frames" in notes[0]


def test_a_model_of_few_frames_is_replaced(film, database):
    models = first_models(film, database)
    for image_id in sorted(models[0].reg_image_ids())[6:]:
        models[0].deregister_frame(models[0].image(image_id).frame_id)
    model = best_model(models, *film, CAMERA, FRAMES, PosesConfig(), database, Notes())
    assert model is not None
    assert model.num_reg_images() == FRAMES


def test_models_start_all_along_the_film(film):
    features, pairs = film
    starts = starts_along_film(features, pairs, CAMERA, 0)
    assert len(starts) >= 10
    assert [first for first, _ in starts] == sorted({first for first, _ in starts})
    assert starts[0][0] <= 1
    assert starts[-1][1] >= FRAMES - 2
    assert starts_along_film(features, [], CAMERA, 0) == []


def test_without_any_model_there_is_none(film, tmp_path):
    features, _ = film
    database = tmp_path / "empty.db"
    mapping.write_database(database, CAMERA, features, [])
    assert best_model([], features, [], CAMERA, FRAMES, PosesConfig(), database, Notes()) is None


def test_too_few_frames_are_refused_with_those_that_fit_each_other(film, database):
    model = first_models(film, database)[0]
    with pytest.raises(InputError, match=r"14 of 60 frames .* 21 are needed.* Frames 100-126 fit each other"):
        check_model(model, 60, np.arange(100, 220, 2), 0.35)
