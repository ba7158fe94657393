"""Write the scene bundle of a run (`docs/bundle_format.md`) and publish it in the registry."""

import dataclasses
import json
import platform
import subprocess
import time
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from reconstruction.assembly import base_slabs
from reconstruction.assets.gltf import write_glb, write_obj
from reconstruction.assets.physics.load import physics_backend
from reconstruction.cache import canonical_json
from reconstruction.core.profiling import Usage, UsageMeter
from reconstruction.core.types import (
    AssembledScene,
    AssetSet,
    BaseAsset,
    ConvexPart,
    ObjectAsset,
    PlacedObject,
    PosedFrames,
    StructureAsset,
    WorldFrame,
)
from reconstruction.costs import OTHER, PUBLISH
from reconstruction.gaussians import write_ply
from reconstruction.instances import backends as instance_backends
from reconstruction.instances.gaussian_ids import gaussian_instances
from reconstruction.publish.instance_views import write_views
from reconstruction.publish.phrases import Described, phrases
from reconstruction.publish.preview import render_preview
from reconstruction.scene_graph import backend_name
from reconstruction.scene_graph.publishing import graph_of_bundle
from registry import SceneRecord, SceneRegistry, seal_bundle
from registry.db import utc_text
from registry.errors import EnvironmentMissing, SimReconError
from registry.labels import STRUCTURE
from registry.plain_text import plain_strings
from registry.primitives import primitive_of
from registry.report_card import failures

if TYPE_CHECKING:
    from reconstruction.runner import Run

SCHEMA = "simrecon.scene/1"
_WORLD_FIELDS = ("gravity_method", "gravity_sigma_deg", "floor_observed", "yaw_snapped")
_RECORDED_PACKAGES = (
    "simrecon", "numpy", "pycolmap", "numba", "sapien", "mani-skill", "coacd", "trimesh", "torch",
)  # fmt: skip


def publish_scene(run: "Run", registry: SceneRegistry, scene_id: str, *, require_stable: bool) -> SceneRecord:
    """Write the bundle of a finished run into the work folder, then publish it atomically.

    Raises:
        SimReconError: `require_stable` is set and the physics report has failures.
        EnvironmentMissing: the registry cannot be written.
    """
    report = run.results["assembly"].physics_report
    faults = failures(report)
    if require_stable and faults:
        raise SimReconError(
            f"{scene_id}: not published, because it is not stable: {'; '.join(faults)}. Drop or fix these objects with "
            "--overrides, or leave out --require-stable."
        )
    staging = run.store.scratch("publish")
    try:
        with UsageMeter() as meter:
            scene = write_bundle(run, scene_id, staging)
        _add_costs(scene["report"], run, meter.usage)
        seal_bundle(staging, plain_strings(scene))
        return registry.publish(staging, scene_id)
    except OSError as error:
        raise EnvironmentMissing(
            f"{scene_id}: cannot write its bundle to {registry.root}: {error.strerror or error}. "
            "The registry is unchanged and finished stages are kept; free some space and run the same command again."
        ) from error
    finally:
        run.store.discard(staging)


def write_bundle(run: "Run", scene_id: str, folder: Path) -> dict:
    """Write all files of the bundle except scene.json; return the content of scene.json."""
    assets: AssetSet = run.results["assets"]
    world: WorldFrame = run.results["world"]
    posed, _ = run.in_world()
    assembled = run.results["assembly"]
    placed = {item.id: item for item in assembled.placed}
    attached = {edge.child for edge in assembled.graph.edges if edge.relation == "attached_to"}
    scene = {
        "schema": SCHEMA,
        "id": scene_id,
        "source": {**dataclasses.asdict(posed.source), "file": Path(posed.source.file).name},
        "scale": dataclasses.asdict(world.scale),
        "world": {name: getattr(world, name) for name in _WORLD_FIELDS},
        "cameras": _cameras(posed),
        "base": _every_base(assets, assembled, folder),
        "objects": [
            object_entry(item, placed[item.id], item.id in attached, folder) for item in assets.objects
        ],
        "graph": graph_of_bundle(assembled.graph.edges, run.results["scene_graph"], folder),
        "gaussians": _gaussians(run, folder),
        "report": _report(run),
    }
    if assets.backdrop is not None:
        write_glb(assets.backdrop.visual, folder / "backdrop.glb")
        scene["backdrop"] = {
            "mesh": "backdrop.glb",
            "observed_fraction": float(assets.backdrop.observed_fraction),
        }
    ids = [o["id"] for o in scene["objects"]]
    scene["instances"], anchors = write_views(
        run.results["instances"], ids, run.results["frames"], posed, run.lens(), folder
    )
    names = _names(assets, assembled)
    for item in scene["objects"]:
        item["name"] = names[item["id"]]
        if item["id"] in anchors:
            item["anchor"] = anchors[item["id"]]
    picture = render_preview(assets, assembled, posed)
    cv2.imwrite(str(folder / "preview.png"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    return scene


def _names(assets: AssetSet, assembled: AssembledScene) -> dict[int, str]:
    """Return a unique noun phrase per object id."""
    parents = {edge.child: edge.parent for edge in assembled.graph.edges}
    poses = {item.id: item.world_from_object for item in assembled.placed}
    described = [
        Described.of(o.id, o.label, o.visual, np.asarray(poses[o.id]), parents[o.id]) for o in assets.objects
    ]
    return phrases(described, assets.static_labels)


def _cameras(posed: PosedFrames) -> dict:
    camera = posed.camera
    indices = np.concatenate([posed.indices, posed.held_out_indices])
    times = np.concatenate([posed.times_s, posed.held_out_times_s])
    poses = np.concatenate([posed.world_from_camera, posed.held_out_world_from_camera.reshape(-1, 4, 4)])
    held_out = np.arange(len(indices)) >= len(posed.indices)
    frames = [
        {
            "index": int(indices[i]),
            "time_s": float(times[i]),
            "world_from_camera": poses[i].tolist(),
            "held_out": bool(held_out[i]),
        }
        for i in np.argsort(indices, kind="stable")
    ]
    return {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": camera.intrinsics.tolist(),
        "frames": frames,
    }


def _gaussians(run: "Run", folder: Path) -> dict:
    gaussians = run.results["gaussians"].in_world(run.results["world"])
    found, kept = run.results["instances"], run.results["assets"]
    published = [*kept.static_labels, *(item.id for item in kept.objects)]
    labels = np.where(np.isin(found.vertex_instance, published), found.vertex_instance, 0)
    instances = gaussian_instances(gaussians.means, run.results["surface"].vertices, labels)
    write_ply(gaussians, folder / "gaussians.ply", instances)
    return {"file": "gaussians.ply", "count": len(gaussians)}


def _every_base(assets: AssetSet, assembled: AssembledScene, folder: Path) -> list[dict]:
    """Write floor, walls, ceiling and structure; return their entries of `base`."""
    entries = []
    for item in assets.base:
        plane = {"plane": [float(x) for x in item.plane], "observed": item.observed}
        entries.append(_base(item, item.label, base_slabs(item), folder) | plane)
    if assets.structure is not None:
        entry = _base(assets.structure, STRUCTURE, assembled.structure, folder)
        entries.append(entry | {"observed": True})
    return entries


def _base(item: BaseAsset | StructureAsset, label: str, parts: tuple[ConvexPart, ...], folder: Path) -> dict:
    (folder / "base").mkdir(exist_ok=True)
    mesh = f"base/{item.id:03d}_{label}.glb"
    write_glb(item.visual, folder / mesh)
    collision = []
    for number, part in enumerate(parts):
        collision.append(f"base/{item.id:03d}_collision_{number:03d}.obj")
        write_obj(part, folder / collision[-1])
    return {
        "id": item.id,
        "label": label,
        "mesh": mesh,
        "observed_fraction": float(item.observed_fraction),
        "collision": collision,
    }


def object_entry(item: ObjectAsset, placed: PlacedObject, attached: bool, folder: Path) -> dict:
    """Write the meshes of an object below a folder, and return its entry of `objects`."""
    home = Path("objects") / f"{item.id:03d}"
    (folder / home).mkdir(parents=True)
    write_glb(item.visual, folder / home / "visual.glb")
    collision, primitives = [], []
    for number, part in enumerate(item.collision if placed.collision is None else placed.collision):
        collision.append(str(home / f"collision_{number:03d}.obj"))
        write_obj(part, folder / collision[-1])
        primitive = primitive_of(part.vertices)
        primitives.append(None if primitive is None else primitive.as_json())
    extents = np.ptp(item.visual.vertices, axis=0)
    physics = item.physics
    return {
        "id": item.id,
        "label": item.label,
        "label_confidence": float(item.label_confidence),
        "world_from_object": placed.world_from_object.tolist(),
        "scale": [float(x) for x in extents],
        "visual": str(home / "visual.glb"),
        "collision": collision,
        "collision_primitives": primitives,
        "material": physics.material,
        "density_kg_m3": float(physics.density_kg_m3),
        "mass_kg": float(physics.mass_kg),
        "center_of_mass": [float(x) for x in physics.center_of_mass],
        "inertia": [[float(x) for x in row] for row in physics.inertia],
        "friction": float(physics.friction),
        "restitution": float(physics.restitution),
        "ranges": {name: list(span) for name, span in dataclasses.asdict(physics.ranges).items()},
        "dynamic": bool(placed.dynamic),
        "relation_fixed": attached,
        "provenance": dataclasses.asdict(item.provenance),
        "views": [int(x) for x in item.views],
        "assembly": {
            "moved_m": float(placed.moved_m),
            "turned_deg": float(placed.turned_deg),
            "repair": placed.repair,
            "stable": bool(placed.stable),
        },
    }


def _add_costs(report: dict, run: "Run", publishing: Usage) -> None:
    """Add the cost outside of the stages, so that the timings of an uncached run sum to its wall time."""
    in_stages = sum(run.usage[name].wall_s for name in run.computed if name in run.usage)
    elapsed = time.perf_counter() - run.started
    report["timings_s"] |= {
        PUBLISH: round(publishing.wall_s, 3),
        OTHER: round(max(0.0, elapsed - in_stages - publishing.wall_s), 3),
    }
    report["peak_memory_mb"] = round(max(report["peak_memory_mb"], publishing.peak_memory_mb), 1)
    volatile = report["volatile"]
    volatile["cpu_s"][PUBLISH] = round(publishing.cpu_s, 3)
    volatile["stage_peak_memory_mb"][PUBLISH] = round(publishing.peak_memory_mb, 1)
    volatile["cached"] = [name for name in run.usage if name not in run.computed]


def _report(run: "Run") -> dict:
    posed: PosedFrames = run.results["poses"]
    return {
        "physics": run.results["assembly"].physics_report,
        "timings_s": {name: round(usage.wall_s, 3) for name, usage in run.usage.items()},
        "peak_memory_mb": round(max(usage.peak_memory_mb for usage in run.usage.values()), 1),
        "volatile": {
            "cpu_s": {name: round(usage.cpu_s, 3) for name, usage in run.usage.items()},
            "stage_peak_memory_mb": {n: round(usage.peak_memory_mb, 1) for n, usage in run.usage.items()},
            "created_utc": utc_text(),
            "machine": f"{platform.machine()} {platform.system()}",
            "versions": _versions(),
            "commit": _commit(),
            # With these `simrecon evaluate` and `report` find the stage results in the work folder.
            "work": {"input_digest": run.input_digest, "stage_keys": dict(run.keys)},
        },
        "backends": backends_of(run),
        "config": json.loads(canonical_json(run.config)),
        "overrides": run.overrides.entries,
        "notes": run.notes,
        "registration": {
            "keyframes": posed.chosen_frames,
            "registered": len(posed.images),
            "reprojection_error_px": float(posed.reprojection_error_px),
        },
    }


def backends_of(run: "Run") -> dict[str, str]:
    """Return the backend of each stage; `ground-truth` for stages that were replaced by the truth."""
    backends = {
        "poses": "pycolmap",
        "depth": "plane-sweep",
        "gaussians": run.config.gaussians.backend,
        **instance_backends(run.config.instances),
        "assets": completion_of(run.config.assets.generator),
        "physics": physics_backend(run.config.assets),
        "relations": backend_name(run.config.scene_graph),
    }
    if "views" in run.keys:
        backends["views"] = run.config.avo.strategy
    if run.oracle is not None:
        if "instances" in run.oracle.stages:
            del backends["masks"], backends["labels"]
        backends |= dict.fromkeys(run.oracle.stages, "ground-truth")
    plugins = [str(plugin) for plugin in run.config.plugins()]
    if plugins:
        backends["plugins"] = ", ".join(plugins)
    return backends


def completion_of(generator: str) -> str:
    """Describe the completion of shapes by the name of the generator."""
    return "embedded" if generator == "none" else f"{generator}, embedded where it is rejected"


def _versions() -> dict[str, str]:
    found = {}
    for name in _RECORDED_PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _commit() -> str:
    """Return the git commit of a source checkout, "" for an installed wheel."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return ""
    done = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    )
    return done.stdout.strip() if done.returncode == 0 else ""
