"""Alignment of patches: keypoints of a model move to where the same surface is seen, and unmatched ones are added."""

import cv2
import numpy as np
import pycolmap
import pytest

from reconstruction.poses.keypoint_refinement import refine_keypoints
from reconstruction.poses.mapping import poses_of

pytestmark = pytest.mark.unit

_SIZE = (200, 260)  # height, width
_FOCAL = 240.0
_NOISE_PX = 0.5


def _poses():
    """Cameras that look at the plane z = 0 from about 2 m, up to 25 degrees aside: world_from_camera."""
    out = []
    for angle in np.radians([-24, -12, 0, 10, 20, 25]):
        turn = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
        pose = np.eye(4)
        pose[:3, :3] = turn
        pose[:3, 3] = turn @ [0, 0, -2 - 0.3 * angle]
        out.append(pose)
    return np.array(out)


def _pictures(poses, tilt):
    """Draw a textured plane through the origin, tilted about y, with a gain and an offset for each frame."""
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (600, 600)).astype(np.float32), (0, 0), 4)
    texture = np.clip((texture - texture.mean()) * 6 + 128, 0, 255)
    axes = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0]])
    plane_from_texture = np.column_stack([axes.T / 200, -axes.sum(0) * 1.5])  # 3 m wide, 200 pixels a metre
    matrix = np.array([[_FOCAL, 0, _SIZE[1] / 2 - 0.5], [0, _FOCAL, _SIZE[0] / 2 - 0.5], [0, 0, 1]])
    images = []
    for pose, gain in zip(poses, (0.7, 0.8, 0.9, 1.0, 0.75, 0.95)):
        m = np.linalg.inv(pose)
        from_texture = matrix @ (m[:3, :3] @ plane_from_texture + np.outer(m[:3, 3], [0, 0, 1]))
        image = cv2.warpPerspective(texture, from_texture, _SIZE[::-1], flags=cv2.INTER_CUBIC) * gain + 5
        images.append(
            np.repeat(np.clip(image + rng.normal(0, 1, _SIZE), 0, 255).astype(np.uint8)[..., None], 3, 2)
        )
    u, v = rng.uniform(-0.35, 0.35, (2, 60))
    return np.array(images), u[:, None] * axes[0] + v[:, None] * axes[1]


def _project(poses, points):
    local = np.einsum("nij,nmj->nmi", np.linalg.inv(poses)[:, :3, :3], points - poses[:, None, :3, 3])
    return _FOCAL * local[..., :2] / local[..., 2:] + np.array(_SIZE[::-1]) / 2


def _model(poses, points, pixels, matched):
    """Return a model whose frame k has observed point i where matched[k, i]."""
    out = pycolmap.Reconstruction()
    out.add_camera_with_trivial_rig(
        pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", _FOCAL, _SIZE[1], _SIZE[0])
    )
    for k, pose in enumerate(np.linalg.inv(poses)):
        image = pycolmap.Image(f"{k}", pixels[k], 1, k + 1)
        out.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    for i, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(k + 1, i) for k in np.flatnonzero(matched[:, i])])
        out.add_point3D(point, track)
    return out


@pytest.fixture(params=[0, 50], ids=["facing", "slanted"])
def scene(request):
    poses = _poses()
    images, points = _pictures(poses, np.radians(request.param))
    pixels = _project(poses, points)
    rng = np.random.default_rng(0)
    matched = rng.random(pixels.shape[:2]) < 0.6
    matched[2:4] = True
    noisy = pixels + rng.normal(0, _NOISE_PX, pixels.shape)
    return poses, images, points, pixels, noisy, matched


def _offsets(model, pixels):
    """Return how far observations are from the truth; the mean of each point's is free."""
    out = []
    for point_id in sorted(model.point3D_ids()):
        seen = [(e.image_id, e.point2D_idx) for e in model.point3D(point_id).track.elements]
        off = np.array([model.image(i).points2D[j].xy - pixels[i - 1, point_id - 1] for i, j in seen])
        out.append(np.linalg.norm(off - off.mean(axis=0), axis=1))
    return np.concatenate(out)


def test_keypoints_move_to_the_same_place_of_the_surface(scene):
    poses, images, points, pixels, noisy, matched = scene
    model = _model(poses, points, noisy, matched)
    refined = refine_keypoints(model, images)
    before, after = _offsets(model, pixels), _offsets(refined, pixels)
    assert np.median(before) > 0.4
    assert np.median(after) < 0.12


def test_frames_that_did_not_match_a_point_are_added(scene):
    poses, images, points, _, noisy, matched = scene
    refined = refine_keypoints(_model(poses, points, noisy, matched), images)
    assert refined.compute_num_observations() > matched.sum() + 0.5 * (~matched).sum()
    for k in range(len(poses)):
        assert len(refined.image(k + 1).points2D) >= len(points)


def test_the_model_stays_as_it_is_and_the_rest_of_it_is_copied(scene):
    poses, images, points, _, noisy, matched = scene
    model = _model(poses, points, noisy, matched)
    refined = refine_keypoints(model, images)
    assert model.compute_num_observations() == matched.sum()
    assert np.allclose(model.image(1).points2D[0].xy, noisy[0, 0])
    assert sorted(refined.point3D_ids()) == sorted(model.point3D_ids())
    assert all(np.allclose(poses_of(refined)[k], poses[k]) for k in range(len(poses)))


def test_blank_frames_leave_keypoints_alone(scene):
    poses, images, points, _, noisy, matched = scene
    refined = refine_keypoints(_model(poses, points, noisy, matched), np.full_like(images, 120))
    assert refined.compute_num_observations() == matched.sum()
    places = np.array([[p.xy for p in refined.image(k + 1).points2D] for k in range(len(poses))])
    assert np.allclose(places, noisy)
