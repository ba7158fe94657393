#!/usr/bin/env bash
# Make .venv with everything that SimRecon needs, and the system packages for rendering. Safe and quick to run again.
#   PYTHON=python3.12 tools/setup.sh     choose the interpreter
#   VENV=/path/to/venv tools/setup.sh    choose the environment
set -euo pipefail
cd "$(dirname "$0")/.."
VENV=${VENV:-.venv}

as_root() { # Run as root where that needs no password; otherwise say what to type and fail.
  if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then sudo "$@"; else
    echo "setup: this needs root, please run:  sudo $*" >&2
    return 1
  fi
}

find_python() {
  for candidate in ${PYTHON:-python3 python3.12 python3.11 python3.10 python3.13}; do
    if command -v "$candidate" >/dev/null &&
      "$candidate" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
      echo "$candidate"
      return
    fi
  done
  echo "setup: no Python 3.10 to 3.13 found (looked for ${PYTHON:-python3, python3.10 ... 3.13}). On Debian and Ubuntu: sudo apt-get install python3 python3-venv" >&2
  return 1
}

python=$(find_python)
stamp=$VENV/.ready-$(cat pyproject.toml constraints.txt tools/setup.sh | sha256sum | cut -c1-16)

if [ ! -e "$stamp" ]; then
  if [ ! -x "$VENV/bin/python" ]; then
    echo "setup: making $VENV with $("$python" --version)"
    if ! "$python" -m venv "$VENV" 2>/dev/null; then
      rm -rf "$VENV"
      as_root apt-get install -y -qq "$(basename "$(readlink -f "$(command -v "$python")")")-venv" || as_root apt-get install -y -qq python3-venv
      "$python" -m venv "$VENV"
    fi
  fi
  echo "setup: installing packages (about 2 GB on disk; minutes on the first run)"
  "$VENV/bin/python" -m pip install -q --upgrade "pip>=23"
  # The pinned torch comes first: with it in place no other package asks for the CUDA build.
  "$VENV/bin/python" -m pip install -q -c constraints.txt torch
  "$VENV/bin/python" -m pip install -q -c constraints.txt -e ".[dev]"
  # sapien asks for opencv-python; its cv2 and the headless one are the same folder. Keep the headless one alone:
  # it needs no display libraries.
  if "$VENV/bin/python" -m pip show -q opencv-python 2>/dev/null; then
    "$VENV/bin/python" -m pip uninstall -q -y opencv-python opencv-python-headless
    "$VENV/bin/python" -m pip install -q -c constraints.txt --no-deps opencv-python-headless
  fi
  rm -f "$VENV"/.ready-*
  touch "$stamp"
fi

tools/setup_system.sh

# The kernels of all stages: a minute or two once, instead of during the first reconstruction.
"$VENV/bin/python" -m reconstruction.cli doctor --warm || echo "setup: the other kernels compile on their first use" >&2
