"""What works on this machine, what is missing, and how to get it.

Everything that may crash or hang (drivers, compiled wheels) is tried in other processes with a time limit,
all at the same time, so that the whole takes seconds.
"""

import contextlib
import importlib.metadata
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from registry import SceneRegistry, SimReconError, default_registry_root

_TIME_LIMIT_S = 60.0
_MIN_MEMORY_GB, _MIN_DISK_GB = 6.0, 3.0

# Distribution name -> what to import; all of them are in pyproject's dependencies.
_REQUIRED = {
    "av": "av",
    "coacd": "coacd",
    "fast-simplification": "fast_simplification",
    "gymnasium": "gymnasium",
    "imageio": "imageio",
    "mani_skill": "mani_skill",
    "manifold3d": "manifold3d",
    "numba": "numba",
    "numpy": "numpy",
    "pillow": "PIL",
    "psutil": "psutil",
    "pycolmap": "pycolmap",
    "pydantic": "pydantic",
    "pyyaml": "yaml",
    "requests": "requests",
    "sapien": "sapien",
    "scikit-image": "skimage",
    "scipy": "scipy",
    "stable_baselines3": "stable_baselines3",
    "torch": "torch",
    "tqdm": "tqdm",
    "trimesh": "trimesh",
    "xatlas": "xatlas",
}
_OPENCV_WHEELS = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)

_PHYSICS_CODE = """
import numpy as np, sapien
scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
scene.set_timestep(1 / 240)
scene.add_ground(0, render=False)
builder = scene.create_actor_builder()
builder.add_box_collision(half_size=[0.05, 0.05, 0.05])
box = builder.build(name="box")
box.set_pose(sapien.Pose([0, 0, 0.3]))
for _ in range(240):
    scene.step()
height = float(box.pose.p[2])
assert abs(height - 0.05) < 0.002, f"a box fell to {height:.3f} m instead of 0.050 m"
print(f"SAPIEN {sapien.__version__}; a box fell on the ground and lies still")
"""

_RENDER_CODE = """
import numpy as np, sapien, sapien.render
device, name = sapien.Device("cpu"), "the CPU"
try:
    if sapien.Device("cuda").can_render():
        device, name = sapien.Device("cuda"), "the GPU"
except RuntimeError:
    pass
scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(device)])
scene.set_ambient_light([1, 1, 1])
builder = scene.create_actor_builder()
builder.add_box_visual(half_size=[0.5, 0.5, 0.5], material=[0.9, 0.1, 0.1])
builder.build_static(name="box").set_pose(sapien.Pose([3, 0, 0]))
camera = scene.add_camera("camera", 64, 64, 1.0, 0.01, 10)
scene.update_render()
camera.take_picture()
picture = camera.get_picture("Color")
red, corner = picture[32, 32, :3], picture[2, 2, :3]
seen = [round(float(x), 2) for x in red]
assert red[0] > 1.5 * red[1] and np.abs(red - corner).max() > 0.2, f"a red box came out with color {seen}"
print(f"SAPIEN renders on {name}")
"""

_DECODE_CODE = """
import io, sys, av, numpy as np
decoders = [name for name in ("h264", "hevc", "vp9", "av1") if name in av.codecs_available]
missing = [name for name in ("h264", "hevc") if name not in decoders]
assert not missing, f"PyAV has no decoder for {', '.join(missing)}"
file = io.BytesIO()
with av.open(file, "w", format="mp4") as out:
    stream = out.add_stream("libx264" if "libx264" in av.codecs_available else "mpeg4", rate=30)
    stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
    for value in range(0, 240, 24):
        frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), value, np.uint8), format="rgb24")
        for packet in stream.encode(frame):
            out.mux(packet)
    for packet in stream.encode():
        out.mux(packet)
file.seek(0)
with av.open(file) as video:
    count = sum(1 for _ in video.decode(video=0))
assert count == 10, f"{count} of 10 frames came back from a video written and read by PyAV"
print(f"PyAV {av.__version__}; decodes {', '.join(decoders)}; wrote and read a video of 10 frames")
"""

_CUDA_CODE = """
import importlib.util
# Before torch, whose import takes seconds.
assert importlib.util.find_spec("gsplat"), "gsplat is not installed"
import torch
assert torch.cuda.is_available(), f"torch {torch.__version__} sees no CUDA device"
import gsplat
name = torch.cuda.get_device_name(0)
print(f"gsplat {getattr(gsplat, '__version__', '?')} on {name}")
"""

_LEARNED_CODE = """
import dataclasses, json, sys
sys.path.insert(0, {root!r})
from reconstruction.doctor_learned import learned_checks
print(json.dumps([dataclasses.asdict(check) for check in learned_checks()]))
"""


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    ok: bool
    detail: str  # what was found
    fix: str  # "" or what to do where it is not ok
    required: bool  # without it nothing, or not the main job, works


def run_checks() -> list[Check]:
    """Look at everything; takes a few seconds. Exit code 4 is for a required one that is not ok."""
    tried = {
        "video decoding": _start(_DECODE_CODE),
        "physics": _start(_PHYSICS_CODE),
        "rendering": _start(_RENDER_CODE),
        "CUDA (optional)": _start(_CUDA_CODE),
    }
    learned = _start(_LEARNED_CODE.format(root=str(Path(__file__).parents[1])))
    checks = [
        _python(),
        *_packages(),
        _exports(),
        _opencv(),
        _numba_cache(),
        _machine(),
        _disk(),
        _registry(),
    ]
    reinstall = f"{sys.executable} -m pip install --force-reinstall "
    fixes = {
        "video decoding": (reinstall + "av", True),
        "physics": (reinstall + "sapien", True),
        "rendering": (_rendering_fix(), False),
        "CUDA (optional)": (
            "for the GPU backends only: install a CUDA build of torch, then simrecon[gpu]",
            False,
        ),
    }
    checks += [_finish(name, process, *fixes[name]) for name, process in tried.items()]
    return checks + _learned(learned)


def format_checks(checks: list[Check]) -> str:
    """Return the checks as a table for people, and what to do below it."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        mark = "ok     " if check.ok else "MISSING" if check.required else "absent "
        lines.append(f"{mark}  {check.name.ljust(width)}  {check.detail}")
        if not check.ok and check.fix:
            lines.append(f"{'':7}  {'':{width}}  -> {check.fix}")
    broken = [check.name for check in checks if check.required and not check.ok]
    without = [check.name for check in checks if not check.required and not check.ok]
    lines.append("")
    if broken:
        lines.append(f"SimRecon cannot work here yet: {', '.join(broken)}.")
    elif without:
        lines.append(f"SimRecon works here, without: {', '.join(without)}.")
    else:
        lines.append("Everything works here.")
    return "\n".join(lines)


def _python() -> Check:
    version = platform.python_version()
    return Check(
        "Python",
        sys.version_info >= (3, 10),
        f"{version}, {platform.system()} {platform.machine()}, {sys.executable}",
        "SimRecon needs Python 3.10 or newer: make a virtual environment with one",
        True,
    )


def _packages() -> list[Check]:
    """Look at installed distributions without importing them: that alone would take many seconds."""
    found, missing, low = [], [], []
    for name in _REQUIRED:
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
            continue
        found.append(f"{name} {version}")
        low += _too_old(name, version)
    main = ("mani_skill", "torch", "numba", "pycolmap")
    shown = ", ".join(text for text in found if text.split()[0] in main)
    checks = [
        Check(
            "packages",
            not missing and not low,
            f"{len(found)} of {len(_REQUIRED)} ({shown} …)"
            + (f"; missing: {', '.join(missing)}" if missing else "")
            + (f"; too old: {', '.join(low)}" if low else ""),
            f"{sys.executable} -m pip install --upgrade {' '.join([*missing, *(x.split()[0] for x in low)])}",
            True,
        )
    ]
    return checks


def _exports() -> Check:
    """Look for what reads the exports; only USD cannot be written without."""
    found = []
    for name in ("mujoco", "usd-core"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found.append(f"{name} {importlib.metadata.version(name)}")
    detail = ", ".join(found) or "neither mujoco nor usd-core is installed"
    fix = f"{sys.executable} -m pip install 'simrecon[exports]', to export USD and to load MJCF"
    return Check("exports (optional)", len(found) == 2, detail, fix, False)


def _too_old(name: str, version: str) -> list[str]:
    """Compare with the lower bound that our own metadata declares, where we are installed with one."""
    try:
        declared = importlib.metadata.requires("simrecon") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    for requirement in declared:
        match = re.match(r"([A-Za-z0-9_.-]+)(?:\[[^\]]*\])?>=([0-9.]+)\s*$", requirement)
        if match is None or _normal(match.group(1)) != _normal(name):
            continue
        if _numbers(version) < _numbers(match.group(2)):
            return [f"{name} {version} (needs {match.group(2)})"]
    return []


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(x) for x in re.findall(r"\d+", version.split("+")[0])[:3])


def _opencv() -> Check:
    """Exactly one wheel may own the folder `cv2`; two overwrite each other's files."""
    owners, damaged = [], []
    for name in _OPENCV_WHEELS:
        try:
            files = importlib.metadata.files(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        owners.append(f"{name} {importlib.metadata.version(name)}")
        libraries = [file for file in files if file.match("cv2/cv2*.so") or file.match("cv2/cv2*.pyd")]
        if not all(_same_size(file) for file in libraries):
            damaged.append(name)
    fix = (
        f"{sys.executable} -m pip uninstall -y {' '.join(_OPENCV_WHEELS)}; "
        f"{sys.executable} -m pip install --no-deps opencv-python-headless"
    )
    if not owners:
        return Check("OpenCV", False, "not installed", fix, True)
    if damaged:
        detail = (
            f"{' and '.join(owners)} overwrote each other's files (those of {', '.join(damaged)} are gone)"
        )
        # Which of them won does not matter as long as they are of one version and import.
        versions = {owner.split()[1] for owner in owners}
        return Check("OpenCV", len(versions) == 1 and _imports_cv2(), detail, fix, True)
    works = _imports_cv2()
    return Check("OpenCV", works, " and ".join(owners) + ("" if works else "; cannot be imported"), fix, True)


def _same_size(file: importlib.metadata.PackagePath) -> bool:
    try:
        return file.size is None or os.path.getsize(file.locate()) == file.size
    except OSError:
        return False


def _imports_cv2() -> bool:
    code = "import cv2; cv2.imdecode, cv2.SIFT_create, cv2.aruco"
    return _run(code)[0] == 0


def _numba_cache() -> Check:
    """Kernels are compiled once and kept; without a writable place every process pays for it again."""
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    # Numba itself tries __pycache__ beside the code first, then a folder of the user.
    usual = [Path(__file__).parent / "__pycache__", Path.home() / ".cache" / "numba"]
    places = [Path(wanted)] if wanted else usual
    for place in places:
        if _writable(place):
            return Check("Numba cache", True, f"{place} can be written", "", False)
    return Check(
        "Numba cache",
        False,
        f"{' and '.join(map(str, places))} cannot be written: each process compiles its kernels anew",
        "set NUMBA_CACHE_DIR to a folder that can be written",
        False,
    )


def _machine() -> Check:
    try:
        import psutil

        memory = psutil.virtual_memory()
        total, free = memory.total / 2**30, memory.available / 2**30
        text = f"{os.cpu_count()} CPU cores, {total:.1f} GB of memory ({free:.1f} GB free)"
        return Check(
            "memory",
            free >= _MIN_MEMORY_GB,
            text,
            f"less than {_MIN_MEMORY_GB:g} GB: use --preset fast",
            False,
        )
    except ImportError:
        return Check("memory", False, "psutil is missing", f"{sys.executable} -m pip install psutil", False)


def _disk() -> Check:
    root = _existing(default_registry_root())
    free = shutil.disk_usage(root).free / 2**30
    fix = "free some space, or point SIMRECON_HOME to another disk"
    return Check("disk", free >= _MIN_DISK_GB, f"{free:.0f} GB free at {root}", fix, False)


def _registry() -> Check:
    root = default_registry_root()
    fix = f"make {root} writable, or set SIMRECON_HOME to a folder that is"
    if not _writable(root):
        return Check("registry", False, f"{root} cannot be written", fix, True)
    try:
        count = len(SceneRegistry(root).list())
    except SimReconError as error:
        return Check("registry", False, str(error), "see the message on the left", True)
    return Check("registry", True, f"{root} can be written; {count} scenes", "", True)


def _rendering_fix() -> str:
    script = Path(__file__).parents[1] / "tools" / "setup_system.sh"
    if platform.system() != "Linux":
        return "pictures need a Vulkan driver (on macOS: MoltenVK, which SAPIEN brings)"
    if script.is_file():
        return f"bash {script}   (installs Mesa >= 24.3, or says what to do)"
    return "install a Vulkan driver: Mesa >= 24.3 (mesa-vulkan-drivers and libvulkan1), or that of the GPU"


def _learned(process: subprocess.Popen) -> list[Check]:
    """Return what another process found: it imports packages that may be the broken ones."""
    code, out, err = _wait(process)
    if code == 0:
        return [Check(**found) for found in json.loads(out.strip().splitlines()[-1])]
    reason = err.strip().splitlines()[-1] if err.strip() else f"exit code {code}"
    fix = "repair what is missing above first"
    return [Check("learned models (optional)", False, f"could not be looked for: {reason}", fix, False)]


def _existing(path: Path) -> Path:
    path = path.expanduser().absolute()
    return path if path.exists() else _existing(path.parent)


def _writable(path: Path) -> bool:
    """Tell whether files can be written in a folder, or in the nearest that exists above it."""
    folder = _existing(path)
    if not folder.is_dir():
        return False
    try:
        # Really write: permissions alone say nothing of read-only mounts and full disks.
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".simrecon-doctor-") as file:
            file.write(b"x" * 4096)
            file.flush()
        return True
    except OSError:
        return False


def _start(code: str) -> subprocess.Popen:
    # A folder of its own, so that nothing in the working folder is imported instead.
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tempfile.gettempdir(),
    )


def _run(code: str) -> tuple[int | None, str, str]:
    return _wait(_start(code))


def _wait(process: subprocess.Popen) -> tuple[int | None, str, str]:
    try:
        out, err = process.communicate(timeout=_TIME_LIMIT_S)
        return process.returncode, out, err
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        return None, out, err


def _finish(name: str, process: subprocess.Popen, fix: str, required: bool) -> Check:
    code, out, err = _wait(process)
    if code == 0:
        return Check(name, True, out.strip().splitlines()[-1] if out.strip() else "works", "", required)
    if code is None:
        return Check(name, False, f"no answer within {_TIME_LIMIT_S:g} s", fix, required)
    if code < 0:
        return Check(name, False, f"the process crashed (signal {-code})", fix, required)
    reason = err.strip().splitlines()[-1] if err.strip() else f"exit code {code}"
    reason = re.sub(r"^(\w+\.)*(\w*Error|\w*Exception): ", "", reason)
    return Check(name, False, reason, fix, required)
