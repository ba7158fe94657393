"""Checks of the machine: memory, disk, folders that must be writable."""

import os
import platform
import shutil
import tempfile
from pathlib import Path

from reconstruction.doctor.check import Check
from reconstruction.doctor.packages import PIP
from registry import SimReconError, default_registry_root, open_registry

_MIN_MEMORY_GB, _MIN_DISK_GB = 6.0, 3.0
_PROJECT = Path(__file__).parents[2]


def numba_cache_check() -> Check:
    """Check the folder of compiled kernels; without one, every process compiles them again."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    # Numba's own order: __pycache__ beside the code, then a folder of the user.
    usual = [_PROJECT / "reconstruction" / "__pycache__", Path.home() / ".cache" / "numba"]
    places = [Path(named)] if named else usual
    for place in places:
        if _writable(place):
            return Check("Numba cache", True, f"{place} can be written", "", False)
    return Check(
        "Numba cache",
        False,
        f"{' and '.join(map(str, places))} cannot be written: every process compiles its kernels again",
        "set NUMBA_CACHE_DIR to a folder that can be written",
        False,
    )


def memory_check() -> Check:
    """Check the free memory."""
    try:
        import psutil
    except ImportError:
        return Check("memory", False, "psutil is missing", f"{PIP} install psutil", False)
    memory = psutil.virtual_memory()
    total, free = memory.total / 2**30, memory.available / 2**30
    detail = f"{os.cpu_count()} CPU cores, {total:.1f} GB of memory ({free:.1f} GB free)"
    fix = f"less than {_MIN_MEMORY_GB:g} GB: use --preset fast"
    return Check("memory", free >= _MIN_MEMORY_GB, detail, fix, False)


def disk_check() -> Check:
    """Check the free space on the disk of the registry."""
    root = _existing(default_registry_root())
    free = shutil.disk_usage(root).free / 2**30
    fix = "free some space, or set SIMRECON_HOME to a folder on another disk"
    return Check("disk", free >= _MIN_DISK_GB, f"{free:.0f} GB free at {root}", fix, False)


def registry_check() -> Check:
    """Check that the registry can be written and read."""
    root = default_registry_root()
    fix = f"make {root} writable, or set SIMRECON_HOME to a folder that is"
    if not _writable(root):
        return Check("registry", False, f"{root} cannot be written", fix, True)
    try:
        count = len(open_registry(root).list())
    except SimReconError as error:
        return Check("registry", False, str(error), "see the message on the left", True)
    return Check("registry", True, f"{root} can be written; {count} scenes", "", True)


def rendering_fix() -> str:
    """Return how to get a Vulkan driver on this system."""
    script = _PROJECT / "tools" / "setup_system.sh"
    if platform.system() != "Linux":
        return "rendering needs a Vulkan driver (on macOS: MoltenVK, which comes with SAPIEN)"
    if script.is_file():
        return f"bash {script}   (installs Mesa >= 24.3, or says what to do)"
    return "install a Vulkan driver: Mesa >= 24.3 (mesa-vulkan-drivers and libvulkan1), or that of the GPU"


def _existing(path: Path) -> Path:
    """Return the nearest existing folder at or above a path."""
    path = path.expanduser().absolute()
    return path if path.exists() else _existing(path.parent)


def _writable(path: Path) -> bool:
    """Return whether a file can be written in the nearest existing folder at or above a path."""
    folder = _existing(path)
    if not folder.is_dir():
        return False
    try:
        # Permissions tell nothing about read-only mounts and full disks.
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".simrecon-doctor-") as file:
            file.write(b"x" * 4096)
            file.flush()
        return True
    except OSError:
        return False
