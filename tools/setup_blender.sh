#!/usr/bin/env bash
# Installs Blender as a Python module for the tests that open the GLB export in it (pytest -m slow -k blender).
#
#   tools/setup_blender.sh            into .blender, or the folder that SIMRECON_BLENDER names
#
# It is an environment of its own: Blender's wheel wants NumPy 1, everything else here is tested with NumPy 2. About
# 370 MB from PyPI, for Python 3.11 only: PYTHON names another one than `python3.11`. Nothing else needs it.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf 'setup_blender: %s\n' "$*"; }

folder=${SIMRECON_BLENDER:-.blender}
python=${PYTHON:-python3.11}
command -v "$python" >/dev/null || {
    say "there is no $python here; Blender's wheel is for Python 3.11: name one with PYTHON=..."
    exit 1
}
"$python" -m venv "$folder"
"$folder/bin/python" -m pip install --quiet "bpy==5.0.1" "numpy==1.26.4"
"$folder/bin/python" -c 'import bpy; print("setup_blender: Blender", bpy.app.version_string, "is installed")'
