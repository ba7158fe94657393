"""The backdrop in environments: drawn behind everything, never in contact, no body of the scene."""

from pathlib import Path

import numpy as np
import pytest
from made_scenes import BundleWriter, add_furniture, add_room
from sapien.physx import PhysxRigidBaseComponent

import simrecon_envs
from registry import SceneRegistry

PINK = np.array([253, 80, 248])  # sRGB of the linear color that `add_backdrop` writes


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a registry with `room` that has Gaussians, and a pink box around it as its backdrop."""
    root = tmp_path_factory.mktemp("backdrop")
    writer = BundleWriter(tmp_path_factory.mktemp("room"))
    add_room(writer)
    add_furniture(writer)
    writer.cover_with_gaussians()
    writer.add_backdrop()
    writer.seal("room")
    SceneRegistry(root, create=True).publish(writer.folder, "room")
    return root


def _pink(image: np.ndarray) -> np.ndarray:
    return np.abs(image.astype(int) - PINK).max(axis=-1) < 12


@pytest.mark.render
@pytest.mark.parametrize("renderer", ["mesh", "splats"])
def test_the_backdrop_is_seen_where_nothing_else_is(root: Path, renderer: str) -> None:
    env = simrecon_envs.make("room", registry=root, obs_mode="rgb+depth+segmentation", renderer=renderer)
    obs, _ = env.reset(seed=0)
    inner = env.unwrapped
    behind = inner.builder.backdrop._objs[0]
    body = behind.find_component_by_type(PhysxRigidBaseComponent)
    assert body is None or not body.collision_shapes
    camera = obs["sensor_data"]["base_camera"]
    rgb, ids = camera["rgb"][0].numpy(), camera["segmentation"][0, ..., 0].numpy()
    shown = ids == behind.per_scene_id
    assert shown.mean() > 0.02
    # Gaussians of the room's surfaces reach over their edges.
    assert _pink(rgb)[shown].mean() > (0.99 if renderer == "mesh" else 0.5)
    assert not _pink(rgb)[~shown].any()
    assert (camera["depth"][0, ..., 0].numpy()[shown] > 0).all()
    env.close()
