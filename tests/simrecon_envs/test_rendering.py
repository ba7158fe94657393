"""Rendering: observation modes, the render camera, glTF axes, videos."""

from pathlib import Path

import av
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from made_scenes import BOX, PICTURE

import simrecon_envs
from simrecon_envs.rollout import record_rollout, render_scene_picture

pytestmark = pytest.mark.render


@pytest.mark.parametrize("robot", ["panda_wristcam", "fetch"])
def test_rgbd_observations_show_the_target(robot: str, scenes_root: Path) -> None:
    env = simrecon_envs.make(
        "room", registry=scenes_root, robot_uids=robot, target=BOX, obs_mode="rgb+depth+segmentation"
    )
    obs, _ = env.reset(seed=0)
    cameras = obs["sensor_data"]
    assert len(cameras) >= 2  # the base camera and those of the robot
    base = cameras["base_camera"]
    assert base["rgb"].shape == (1, 128, 128, 3)
    assert base["rgb"].dtype == torch.uint8
    box = env.unwrapped.builder.objects[BOX].actor._objs[0].per_scene_id
    seen = (base["segmentation"] == box)[0, ..., 0]
    assert seen.sum() > 20
    # The target is red, and its depth is the distance from the camera to it.
    color = base["rgb"][0][seen].float().mean(0)
    assert color[0] > color[1] + 20
    extrinsic = obs["sensor_param"]["base_camera"]["extrinsic_cv"][0]
    center = torch.cat([env.unwrapped.target_position[0], torch.ones(1)])
    depth_m = base["depth"][0, ..., 0][seen].float().median() / 1000
    assert depth_m == pytest.approx(float((extrinsic @ center)[2]), abs=0.05)
    assert "target_pose" not in obs["extra"]
    env.close()


def test_visuals_stand_where_collisions_are(scenes_root: Path) -> None:
    env = simrecon_envs.make("room", registry=scenes_root, render_mode="rgb_array")
    env.reset(seed=0)
    from sapien.render import RenderBodyComponent

    for key in (BOX, PICTURE):
        entity = env.unwrapped.builder.objects[key].actor._objs[0]
        box = entity.find_component_by_type(RenderBodyComponent).compute_global_aabb_tight()
        item = next(o for o in env.unwrapped.bundle.objects if o.id == key)
        expected = item.world_from_object[:3, 3] + np.array([[-0.5, -0.5, 0], [0.5, 0.5, 1]]) * item.scale
        np.testing.assert_allclose(box, expected, atol=1e-3)
    env.close()


def test_render_camera_shows_a_picture_with_content(scenes_root: Path) -> None:
    env = simrecon_envs.make_cpu("room", registry=scenes_root, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (512, 512, 3)
    assert picture.dtype == np.uint8
    assert picture.reshape(-1, 3).std(axis=0).min() > 10
    env.close()


def test_rollout_video_has_every_step_and_the_pick_succeeds(scenes_root: Path, tmp_path: Path) -> None:
    out = tmp_path / "rollout.mp4"
    result = record_rollout("room", out, steps=80, registry=scenes_root, size_px=128)
    assert result["success"]
    assert result["policy"] == "scripted"
    with av.open(str(out)) as video:
        frames = [f.to_ndarray(format="rgb24") for f in video.decode(video=0)]
    assert len(frames) == 81
    assert frames[0].shape == (128, 128, 3)
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 0.5
    assert list(tmp_path.iterdir()) == [out]


def test_scene_picture_of_a_scene_where_nothing_moves(scenes_root: Path, tmp_path: Path) -> None:
    out = render_scene_picture("bare", tmp_path / "bare.png", registry=scenes_root, size_px=128)
    picture = imageio.imread(out)
    assert picture.shape == (128, 128, 3)
    assert picture.std() > 5
