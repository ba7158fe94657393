"""Checks of Python and of installed packages: their metadata is read, they are not imported."""

import contextlib
import importlib.metadata
import platform
import re
import sys
from pathlib import Path

from reconstruction.doctor.check import Check
from reconstruction.doctor.process import start, wait

PIP = f"{sys.executable} -m pip"
# The dependencies in pyproject.toml, except OpenCV.
_REQUIRED = (
    "av", "coacd", "fast-simplification", "gymnasium", "imageio", "jinja2", "mani_skill", "manifold3d", "matplotlib",
    "numba", "numpy", "pillow", "plyfile", "psutil", "pycolmap", "pydantic", "pyyaml", "requests", "safetensors",
    "sapien", "scikit-image", "scipy", "stable_baselines3", "tensorboard", "threadpoolctl", "torch", "tqdm", "trimesh",
    "xatlas",
)  # fmt: skip
_SHOWN = ("mani_skill", "torch", "numba", "pycolmap")
_OPENCV_WHEELS = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)


def python_check() -> Check:
    """Check the version of Python."""
    return Check(
        "Python",
        sys.version_info >= (3, 10),
        f"{platform.python_version()}, {platform.system()} {platform.machine()}, {sys.executable}",
        "SimRecon needs Python 3.10 or newer: make a virtual environment with one",
        True,
    )


def packages_check() -> Check:
    """Check that all required distributions are installed, and new enough."""
    versions = {name: _version(name) for name in _REQUIRED}
    found = {name: version for name, version in versions.items() if version}
    missing = [name for name in _REQUIRED if name not in found]
    low = [text for name, version in found.items() for text in _too_old(name, version)]
    shown = ", ".join(f"{name} {found[name]}" for name in found if name in _SHOWN)
    return Check(
        "packages",
        not missing and not low,
        f"{len(found)} of {len(_REQUIRED)} ({shown} …)"
        + (f"; missing: {', '.join(missing)}" if missing else "")
        + (f"; too old: {', '.join(low)}" if low else ""),
        f"{PIP} install --upgrade {' '.join([*missing, *(text.split()[0] for text in low)])}",
        True,
    )


def exports_check() -> Check:
    """Check the readers of exported scenes; only USD needs its own to be written."""
    found = [f"{name} {version}" for name in ("mujoco", "usd-core") if (version := _version(name))]
    detail = ", ".join(found) or "neither mujoco nor usd-core is installed"
    fix = f"{PIP} install 'simrecon[exports]', to export USD and to load MJCF"
    return Check("exports (optional)", len(found) == 2, detail, fix, False)


def opencv_check() -> Check:
    """Check that cv2 imports, and that several OpenCV wheels, which share the folder `cv2`, have one version."""
    owners, damaged = [], []
    for name in _OPENCV_WHEELS:
        if version := _version(name):
            owners.append(f"{name} {version}")
            files = importlib.metadata.files(name) or []
            libraries = [file for file in files if file.match("cv2/cv2*.so") or file.match("cv2/cv2*.pyd")]
            if not all(_has_its_size(file) for file in libraries):
                damaged.append(name)
    fix = f"{PIP} uninstall -y {' '.join(_OPENCV_WHEELS)}; {PIP} install --no-deps opencv-python-headless"
    if not owners:
        return Check("OpenCV", False, "not installed", fix, True)
    works, detail = _imports_cv2(), " and ".join(owners)
    if damaged:
        detail += f" overwrote each other's files (those of {', '.join(damaged)} are gone)"
        works = works and len({owner.split()[1] for owner in owners}) == 1
    elif not works:
        detail += "; cannot be imported"
    return Check("OpenCV", works, detail, fix, True)


def _version(name: str) -> str:
    """Return the version of a distribution; "" if it is not installed."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(name)
    return ""


def _too_old(name: str, version: str) -> list[str]:
    """Compare a version with the lower bound in the metadata of the installed `simrecon`, if there is one."""
    try:
        declared = importlib.metadata.requires("simrecon") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    for requirement in declared:
        match = re.match(r"([A-Za-z0-9_.-]+)(?:\[[^\]]*\])?>=([0-9.]+)\s*$", requirement)
        if match is None or _normal(match.group(1)) != _normal(name):
            continue
        if numbers(version) < numbers(match.group(2)):
            return [f"{name} {version} (needs {match.group(2)})"]
    return []


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def numbers(version: str) -> tuple[int, ...]:
    """Return the first three numbers of a version, for comparison."""
    return tuple(int(x) for x in re.findall(r"\d+", version.split("+")[0])[:3])


def _has_its_size(file: importlib.metadata.PackagePath) -> bool:
    try:
        return file.size is None or Path(str(file.locate())).stat().st_size == file.size
    except OSError:
        return False


def _imports_cv2() -> bool:
    return wait(start("import cv2; cv2.imdecode, cv2.SIFT_create, cv2.aruco"))[0] == 0
