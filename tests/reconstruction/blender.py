"""Where the tests find Blender as a Python module."""

import importlib.util
import os
import sys
from pathlib import Path


def blender_python() -> str | None:
    """Return a Python that has `bpy`: this one, or that of tools/setup_blender.sh; None where there is neither."""
    if importlib.util.find_spec("bpy") is not None:
        return sys.executable
    default = Path(__file__).parents[2] / ".blender"
    python = Path(os.environ.get("SIMRECON_BLENDER", default)) / "bin" / "python"
    return str(python) if python.is_file() else None
