"""A scene bundle for other simulators and tools: MJCF, URDF, USD, GLB. See docs/exports.md."""

from reconstruction.exports.write import FORMATS, ExportResult, export_scene

__all__ = ["FORMATS", "ExportResult", "export_scene"]
