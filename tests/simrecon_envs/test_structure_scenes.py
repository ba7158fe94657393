"""Environments whose objects stand on the structure: they rest there, and tasks are about them and it."""

from pathlib import Path

import pytest
from made_scenes import CUBE, STRUCTURE_ID, publish

import simrecon_envs
from registry import SceneRegistry
from simrecon_envs.occupancy import scene_solids
from simrecon_envs.oracle import CONTROL_MODE, Oracle
from simrecon_envs.tasks import list_specs
from simrecon_envs.tasks.facts import SceneFacts


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a registry with `counter`."""
    root = tmp_path_factory.mktemp("registry")
    publish(SceneRegistry(root, create=True), "counter", tmp_path_factory.mktemp("counter"))
    return root


def test_the_structure_is_a_solid_and_has_a_name(root: Path) -> None:
    bundle = SceneRegistry(root).load("counter")
    assert bundle.base[-1].plane is None
    assert STRUCTURE_ID in {solid.owner for solid in scene_solids(bundle)}
    facts = SceneFacts(bundle, "panda")
    assert facts.names["structure"] == STRUCTURE_ID
    names = [spec.name for spec in list_specs(facts) if not spec.problems]
    assert {"pick_cube", "pick_cup"} <= set(names)
    assert len(facts.spots(STRUCTURE_ID, CUBE))


@pytest.mark.parametrize("task", ["pick_cube", "place_cup_on_structure"])
def test_a_script_handles_things_on_the_structure(task: str, root: Path) -> None:
    env = simrecon_envs.make(
        "counter", registry=root, task=task, max_episode_steps=10_000, control_mode=CONTROL_MODE
    )
    info = {"success": False}
    env.reset(seed=1)
    for action in Oracle(env).actions():
        *_, terminated, _, info = env.step(action)
        if bool(terminated):
            break
    env.close()
    assert bool(info["success"])
