"""The figures of a scene as one flat row: a bundle in, a dictionary of numbers and texts out."""

from typing import Any

from reconstruction.costs import cost_rows
from registry import SceneBundle

_OF_OBJECTS = ("objects", "fixed")  # parts of the report card with a row for each object


def scene_figures(bundle: SceneBundle) -> dict[str, Any]:
    """Return every single figure of a bundle's report card, and of its scale, counts, source and costs.

    Names are those of the bundle; a figure inside another is joined by a dot, such as `contacts.support_edges`. A list
    becomes its length, with `n_` before its name; figures of single objects are in `object_figures`.
    """
    scene = bundle.scene
    report = scene["report"]
    objects = scene["objects"]
    found: dict[str, Any] = {
        "n_objects": len(objects),
        "n_dynamic": sum(bool(item["dynamic"]) for item in objects),
        "n_base": len(scene["base"]),
        "mass_kg": sum(float(item["mass_kg"]) for item in objects),
        "observed_fraction": _mean([item["provenance"]["observed_fraction"] for item in objects]),
        "scale_method": scene["scale"]["method"],
        "scale_uncertainty": scene["scale"].get("uncertainty"),
    }
    for name in ("width", "height", "fps", "frame_count", "duration_s", "sha256"):
        found[f"source_{name}"] = scene["source"].get(name)
    physics = report.get("physics", {})
    found |= _flat({key: value for key, value in physics.items() if key not in _OF_OBJECTS})
    rows = cost_rows(report)
    found["time_s"] = sum(row.wall_s for row in rows)
    found["cpu_s"] = sum(row.cpu_s or 0.0 for row in rows) if any(row.cpu_s for row in rows) else None
    found["peak_memory_mb"] = report.get("peak_memory_mb")
    for row in rows:
        found[f"time_{row.name}_s"] = row.wall_s
    found["n_notes"] = len(report.get("notes", ()))
    found["bundle_bytes"] = sum(size for _, size in bundle.files.values())
    return found


def object_figures(bundle: SceneBundle) -> list[dict[str, Any]]:
    """Return a row for each movable object of the report card."""
    labels = {item["id"]: item["label"] for item in bundle.scene["objects"]}
    rows = []
    for item in bundle.scene["report"].get("physics", {}).get("objects", ()):
        figures = {key: value for key, value in item.items() if not isinstance(value, list | dict)}
        rows.append({"id": item.get("id"), "label": labels.get(item.get("id")), **figures})
    return rows


def _flat(values: dict[str, Any], before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{before}{key}.")
        elif isinstance(value, list):
            found[f"{before}n_{key}"] = len(value)
        else:
            found[f"{before}{key}"] = value
    return found


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
