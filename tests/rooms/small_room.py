"""Fixture of several folders of tests: a small generated room, reconstructed and published, with its ground truth."""

import json
import shutil
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from kept import kept_folder

from reconstruction.assembly import AssemblyConfig, assemble
from reconstruction.assets import AssetsConfig, build_assets
from reconstruction.cache import StageStore
from reconstruction.config import PipelineConfig
from reconstruction.core.profiling import Usage
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import ScaleEstimate, WorldFrame
from reconstruction.gaussians import GaussiansConfig, make_gaussians
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.measure.evaluate import evaluate_scene
from reconstruction.measure.report.page import build_page
from reconstruction.measure.stage_results import StageResults
from reconstruction.pipeline import STAGES
from reconstruction.publish import publish_scene
from reconstruction.runner import Run
from reconstruction.scene_graph import SceneGraphConfig, infer_scene_graph
from reconstruction.surface import SurfaceConfig, fuse_surface
from registry import SceneBundle, SceneRegistry
from synthetic.capture import make_test_capture

SCENE = "small_room"
THINGS = ("table", "mug", "box", "picture")
FEW_GAUSSIANS = GaussiansConfig(iterations=60, side_px=256, coarse_side_px=192, max_gaussians=12_000)
SFM_SCALE = 0.5  # sfm units per metre, to test that the report is in metres


@dataclass(frozen=True)
class Reconstructed:
    """A published scene with stage results and ground truth."""

    home: Path
    truth: Path

    @property
    def registry(self) -> Path:
        """The registry's root."""
        return self.home / "registry"

    @cached_property
    def evaluation(self) -> dict:
        """The scene's evaluation, from few samples."""
        return json.loads((self.home / "evaluation.json").read_text())

    def open(self) -> tuple[SceneBundle, StageResults]:
        """Read the bundle and its stage results."""
        bundle = SceneRegistry(self.registry).load(SCENE)
        return bundle, StageResults.find(bundle, self.registry)


@pytest.fixture(scope="session")
def reconstructed(tmp_path_factory) -> Reconstructed:
    """Return a generated room, reconstructed coarsely; tests may write to it."""
    home = shutil.copytree(kept_folder(_reconstruct), tmp_path_factory.mktemp("report") / "home")
    return Reconstructed(home, home / "truth")


def _reconstruct(home: Path) -> None:
    """Reconstruct a generated room coarsely, from true cameras and nearly true depth."""
    capture = make_test_capture(9, 256, 192, objects=THINGS)
    sfm_from_world = np.diag([SFM_SCALE, SFM_SCALE, SFM_SCALE, 1.0])
    noise = 1 + 0.002 * np.random.default_rng(0).standard_normal(capture.depth.depth.shape)
    capture = replace(
        capture, depth=replace(capture.depth, depth=(capture.depth.depth * noise).astype(np.float32))
    )
    posed, depth = capture.in_sfm_space(sfm_from_world)
    world = WorldFrame(
        np.linalg.inv(sfm_from_world),
        ScaleEstimate("marker", 0.02, "a test said so"),
        "cameras",
        0.5,
        True,
        True,
    )
    surface = fuse_surface(
        capture.posed, capture.depth, SurfaceConfig(voxel_size_m=0.016, space_voxel_m=0.04)
    )
    found = find_instances(capture.posed, capture.depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    coarse = AssetsConfig(
        cells_along_longest=32,
        max_voxels=100_000,
        texture_max_px=128,
        texture_frames=4,
        base_texel_m=0.04,
        faces_small=500,
        faces_furniture=800,
        collision_faces=200,
    )
    assets = build_assets(capture.posed, capture.depth, surface, found, coarse)
    graph = infer_scene_graph(assets, SceneGraphConfig())
    results = {
        "frames": capture.frame_set(),
        "poses": posed,
        "depth": depth,
        "world": world,
        "gaussians": make_gaussians(posed, depth, FEW_GAUSSIANS),
        "surface": surface,
        "instances": found,
        "assets": assets,
        "scene_graph": graph,
        "assembly": assemble(assets, graph.plain(), AssemblyConfig()),
    }
    publish(home, results, PipelineConfig(surface=SurfaceConfig(voxel_size_m=0.016)))
    write_truth(capture, home / "truth")
    made = Reconstructed(home, home / "truth")
    bundle, stages = made.open()
    scores = evaluate_scene(
        bundle, made.truth, stages=stages, composition_points=40_000, object_points=10_000
    )
    (home / "evaluation.json").write_text(json.dumps(scores.to_json()))
    (home / "page.html").write_text(build_page(bundle, stages))
    (home / "page_with_truth.html").write_text(build_page(bundle, stages, made.truth, made.evaluation))


def publish(home: Path, results: dict, config: PipelineConfig) -> None:
    """Store stage results as a run does, and publish the scene."""
    digest = results["poses"].source.sha256
    store = StageStore(home / "work" / digest[:16])
    run = Run(Path("video.mp4"), config, store, input_digest=digest, results=results)
    for number, stage in enumerate(STAGES, start=1):
        if stage.name not in results:  # on demand
            continue
        key = f"{number:016x}"
        usage = Usage(wall_s=number * 1.5, cpu_s=number * 2.0, peak_memory_mb=100.0 * number)
        store.save(results[stage.name], number, stage.name, key, {"usage": asdict(usage)})
        run.keys[stage.name], run.usage[stage.name] = key, usage
    run.notes.append("depth: <b>a note</b> & more")
    publish_scene(run, SceneRegistry(home / "registry", create=True), SCENE, require_stable=False)


def write_truth(capture, folder: Path) -> None:
    """Write the ground truth of CONTRACT section 3, without images."""
    (folder / "meshes").mkdir(parents=True)
    names = {entity.id: entity.name for entity in capture.entities}
    entities = []
    for entity in capture.entities:
        entity.mesh().export(folder / "meshes" / f"{entity.name}.ply")
        seen = int((capture.id_maps == entity.id).sum())
        entities.append(
            {
                "id": entity.id,
                "name": entity.name,
                "label": entity.label,
                "base": entity.base,
                "mesh": f"meshes/{entity.name}.ply",
                "relation": entity.relation,
                "parent": names.get(entity.parent),
                "fixed": entity.fixed,
                "visible_pixels": seen,
            }
        )
    p = capture.posed
    poses = {
        **dict(zip(p.indices.tolist(), p.world_from_camera)),
        **dict(zip(p.held_out_indices.tolist(), p.held_out_world_from_camera)),
    }
    c = p.camera
    scene = {
        "width": c.width,
        "height": c.height,
        "intrinsics": {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy},
        "frames": [{"index": i, "world_from_camera": pose.tolist()} for i, pose in sorted(poses.items())],
        "entities": entities,
    }
    (folder / "scene.json").write_text(json.dumps(scene))
