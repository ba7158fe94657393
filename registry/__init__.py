# pyright: strict
"""Registry of scenes: scene bundles in folders and a SQLite index of them. NumPy and the standard library only."""

from registry.bundle import (
    BundleBase,
    BundleCameras,
    BundleEdge,
    BundleObject,
    SceneBundle,
    content_revision,
    seal_bundle,
)
from registry.errors import (
    BundleError,
    EnvironmentMissing,
    InputError,
    SceneBusy,
    SceneNotFound,
    SimReconError,
    UsageError,
)
from registry.opening import open_registry
from registry.roots import default_registry_root, registry_folder
from registry.schema import SCHEMA, check_scene_id, validate_scene
from registry.store import SceneRecord, SceneRegistry, VerifyReport

__all__ = [
    "SCHEMA",
    "BundleBase",
    "BundleCameras",
    "BundleEdge",
    "BundleError",
    "BundleObject",
    "EnvironmentMissing",
    "InputError",
    "SceneBundle",
    "SceneBusy",
    "SceneNotFound",
    "SceneRecord",
    "SceneRegistry",
    "SimReconError",
    "UsageError",
    "VerifyReport",
    "check_scene_id",
    "content_revision",
    "default_registry_root",
    "open_registry",
    "registry_folder",
    "seal_bundle",
    "validate_scene",
]
