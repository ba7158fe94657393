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
from registry.schema import SCHEMA, check_scene_id, validate_scene
from registry.store import SceneRecord, SceneRegistry, VerifyReport, default_registry_root

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
    "seal_bundle",
    "validate_scene",
]
