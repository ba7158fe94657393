"""Backends of other packages: the package of docs/extending.md is written to a folder, and the stages use it."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_instances_lifting import THINGS, Room, find, write_masks
from test_masks import check_promises

from reconstruction.assets import AssetsConfig
from reconstruction.assets.generation import load_generator
from reconstruction.assets.physics.load import load_physicist
from reconstruction.config import PipelineConfig
from reconstruction.core.plugins import installed_plugins
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import AssetSet
from reconstruction.depth import DepthConfig
from reconstruction.depth.monocular import load_monocular
from reconstruction.doctor import plugins as doctor_plugins
from reconstruction.doctor.process import finish_checks, start_call
from reconstruction.gaussians.backends import load_backend
from reconstruction.instances import InstancesConfig, find_instances, load_namer
from reconstruction.instances.masks import load_mask_backend
from reconstruction.pipeline import STAGES
from reconstruction.poses.backends import load_pose_backend
from reconstruction.publish.write import backends_of
from reconstruction.runner import Run, StageStore
from reconstruction.scene_graph import SceneGraphConfig
from reconstruction.scene_graph.load import load_relations
from reconstruction.video_to_scene import reconstruct
from reconstruction.views import load_inpainter, load_strategy
from reconstruction.world import WorldConfig, metric_depth
from registry.errors import EnvironmentMissing, UsageError

pytestmark = pytest.mark.stage

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "extending.md").read_text()
SECTION = PAGE.partition("## Add a mask backend from another package\n")[2].partition("\n## ")[0]
NO_ASSETS = AssetSet((), ())
LOADERS = {
    "poses.backend": lambda name: load_pose_backend(name),
    "depth.monocular": lambda name: load_monocular(DepthConfig(monocular=name)),
    "world.metric_depth": lambda name: metric_depth.load_backend(WorldConfig(metric_depth=name)),
    "gaussians.backend": lambda name: load_backend(name),
    "instances.masks": lambda name: load_mask_backend(InstancesConfig(masks=name)),
    "instances.labels": lambda name: load_namer(InstancesConfig(labels=name)),
    "avo.strategy": lambda name: load_strategy(name),
    "avo.inpainting": lambda name: load_inpainter(name),
    "assets.generator": lambda name: load_generator(AssetsConfig(generator=name)),
    "assets.physics": lambda name: load_physicist(AssetsConfig(physics=name)),
    "scene_graph.backend": lambda name: load_relations(
        SceneGraphConfig(backend=name), NO_ASSETS, lambda: None
    ),
}


def block(language: str) -> str:
    """Return the code block of a language in the section of docs/extending.md."""
    (text,) = re.findall(rf"```{language}\n(.*?)```", SECTION, re.DOTALL)
    return text


def install(folder: Path, distribution: str, version: str, groups: dict[str, dict[str, str]]) -> None:
    """Write the metadata of an installed package."""
    info = folder / f"{distribution}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
    lines = [
        line for group, entries in groups.items()
        for line in (f"[{group}]", *(f"{name} = {target}" for name, target in entries.items()))
    ]  # fmt: skip
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def site(tmp_path, monkeypatch) -> Path:
    """Return an empty folder on `sys.path`."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name in ("flatcolors", "other", "broken"):
        sys.modules.pop(name, None)


@pytest.fixture
def flatcolors(site) -> Path:
    """Install the package of the docs as they say; return the folder."""
    (site / "flatcolors.py").write_text(block("python"))
    project = block("toml")
    (group,) = re.findall(r'\[project\.entry-points\."(.*)"\]', project)
    entries = dict(re.findall(r'^(\w+) = "(.*:.*)"$', project, re.MULTILINE))
    name, version = (re.search(rf'^{key} = "(.*)"', project, re.MULTILINE)[1] for key in ("name", "version"))
    install(site, name, version, {group: entries})
    return site


def test_the_backend_of_the_docs_makes_the_masks_of_the_instances_stage(flatcolors, tmp_path):
    assert "--set instances.masks=flat\n" in SECTION
    config = PipelineConfig().with_option("instances.masks=flat").instances
    room = Room()
    numbers = np.arange(9)
    colors = np.stack([numbers // 4, numbers % 4, 0 * numbers], axis=1).astype(np.uint8) * 64 + 10
    posed = replace(
        room.posed, images=np.where(room.parts[..., None] > 0, colors[room.parts], 0).astype(np.uint8)
    )
    ids = check_promises(load_mask_backend(config), posed, room.depth)
    assert len(np.unique(ids)) == len(np.unique(room.parts))
    config = replace(config, snap_radius_px=0, min_object_image_share=0)
    found = find_instances(posed, room.depth, room.surface, config, progress=NO_PROGRESS)
    assert len(found.objects) == len(THINGS)
    same = find(room, write_masks(room, tmp_path / "masks"))
    np.testing.assert_array_equal(found.vertex_instance, same.vertex_instance)


def test_an_unknown_name_is_an_error_that_lists_the_others(flatcolors):
    says = r"instances\.masks=flatt: there is no such backend\. Built in: embedded, folder, .*flat \(flatcolors 1\.0\)"
    with pytest.raises(UsageError, match=says):
        PipelineConfig().with_option("instances.masks=flatt")
    with pytest.raises(UsageError, match=says):
        load_mask_backend(InstancesConfig(masks="flatt"))
    with pytest.raises(UsageError, match=r"Did you mean 'flat'\?"):
        load_mask_backend(InstancesConfig(masks="flatt"))


@pytest.mark.parametrize("option", list(LOADERS))
def test_every_option_with_backends_accepts_those_of_other_packages(site, option):
    (site / "other.py").write_text("def make(*arguments):\n    return arguments\n")
    install(site, "other", "2.1", {f"simrecon.{option}": {"mine": "other:make"}})
    made = LOADERS[option]("mine")
    row = next(line for line in SECTION.splitlines() if line.startswith(f"| `{option}` |"))
    said = row.split("|")[2]
    assert [type(item).__name__ for item in made][:2] == re.findall(r"`(\w+(?:Config|Set))`", said)
    assert len(made) == (0 if said.strip() == "nothing" else said.count(",") + 1)
    config = PipelineConfig().with_option(f"{option}=mine")
    (plugin,) = config.plugins()
    assert str(plugin) == f"{option}=mine of other 2.1"
    with pytest.raises(UsageError, match="no such backend"):
        LOADERS[option]("yours")


def test_the_docs_list_every_option_that_accepts_plugins():
    listed = re.findall(r"^\| `([\w.]+)` \|", SECTION, re.MULTILINE)
    assert listed == list(doctor_plugins.pluggable_options())
    assert set(listed) == set(LOADERS)


def key(option: str, tmp_path: Path) -> str:
    """Return the fingerprint of the instances stage under an option."""
    stage = next(stage for stage in STAGES if stage.name == "instances")
    run = Run(
        tmp_path, PipelineConfig().with_option(option), StageStore(tmp_path / "work"), input_digest="abc"
    )
    run.keys = dict.fromkeys(run.needs_of(stage), "0")
    return run.key_of(stage, [])


def test_the_fingerprint_covers_version_and_code_of_the_package(flatcolors, tmp_path):
    first = key("instances.masks=flat", tmp_path)
    assert key("instances.masks=flat", tmp_path) == first
    assert key("instances.masks=embedded", tmp_path) != first
    metadata = flatcolors / "flatcolors-1.0.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("1.0", "1.1"))
    second = key("instances.masks=flat", tmp_path)
    with (flatcolors / "flatcolors.py").open("a") as file:
        file.write("X = 1\n")
    assert len({first, second, key("instances.masks=flat", tmp_path)}) == 3


def test_two_packages_of_one_name_are_refused(flatcolors):
    install(flatcolors, "other", "2", {"simrecon.instances.masks": {"flat": "other:make"}})
    with pytest.raises(UsageError, match=r"registered by flatcolors 1\.0 and other 2; uninstall all but one"):
        load_mask_backend(InstancesConfig(masks="flat"))


def test_a_package_that_cannot_be_imported_is_said_before_the_first_stage(site, tmp_path):
    (site / "broken.py").write_text("import no_such_package\n")
    install(site, "broken", "0.1", {"simrecon.instances.masks": {"bad": "broken:make"}})
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos" / "one.png"), np.zeros((48, 64, 3), np.uint8))
    config = PipelineConfig().with_option("instances.masks=bad")
    with pytest.raises(EnvironmentMissing, match=r"instances\.masks=bad of broken 0\.1: .*no_such_package"):
        reconstruct(tmp_path / "photos", registry_root=tmp_path / "registry", config=config)
    assert not (tmp_path / "registry").exists()


def test_doctor_lists_plugins_and_what_is_wrong_with_them(flatcolors, monkeypatch):
    groups = {
        "simrecon.instances.mask": {"a": "flatcolors:make_masks"},
        "simrecon.instances.masks": {"sam2": "flatcolors:make_masks", "gone": "flatcolors:no_such_function"},
        "simrecon.tasks": {"things": "flatcolors"},
    }
    install(flatcolors, "other", "2", groups)
    monkeypatch.setenv("PYTHONPATH", str(flatcolors))  # the checks run in another process
    checks = finish_checks("plugins", start_call("reconstruction.doctor.plugins", "plugin_checks"))
    found = {check.name: check for check in checks}
    assert found["instances.masks=flat"].ok
    assert found["instances.masks=flat"].detail == "flatcolors 1.0, flatcolors:make_masks"
    assert found["tasks of things"].ok
    assert "there is no such option" in found["instances.mask=a"].detail
    assert "built in" in found["instances.masks=sam2"].detail
    assert "no_such_function" in found["instances.masks=gone"].detail
    assert len(checks) == len(installed_plugins()) == 5
    assert not any(check.required for check in checks)


def test_the_bundle_names_the_plugins(flatcolors, tmp_path):
    run = Run(
        tmp_path, PipelineConfig().with_option("instances.masks=flat"), StageStore(tmp_path), input_digest="a"
    )
    assert backends_of(run)["masks"] == "flat"
    assert backends_of(run)["plugins"] == "instances.masks=flat of flatcolors 1.0"
    assert "plugins" not in backends_of(replace(run, config=PipelineConfig()))
