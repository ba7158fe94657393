"""Export a scene bundle to MJCF, URDF, USD or GLB. See docs/exports.md."""

from reconstruction.exports.write import FORMATS, ExportResult, export_scene

__all__ = ["FORMATS", "ExportResult", "export_scene"]
