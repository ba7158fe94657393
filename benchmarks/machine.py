"""Where and with which code figures were made: the machine, the commit, a digest of the sources."""

import hashlib
import os
import platform
import shutil
import subprocess
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parent.parent
_MEASURED = ("reconstruction", "registry")  # what a reconstruction and its evaluation run,
_NOT_MEASURED = (
    "reconstruction/measure/report",
    "synthetic",
    "reconstruction/doctor/",
)  # without these


def describe_machine() -> dict:
    """Describe this machine: CPU model, cores that this process may use, memory, GPU or none."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "cpu": _cpu_model(),
        "cores": cores,
        "memory_gb": round(psutil.virtual_memory().total / 2**30, 1),
        "gpu": _gpu(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def machine_line(machine: dict) -> str:
    """Say it in one line."""
    gpu = machine.get("gpu")
    return (
        f"{machine.get('cpu', 'unknown CPU')}, {machine.get('cores', '?')} cores, "
        f"{machine.get('memory_gb', 0):.0f} GB memory, {gpu if gpu else 'no GPU'}"
    )


def describe_code() -> dict:
    """Describe the code: commit, whether files differ from it, and a digest of the sources that matter for figures."""
    commit = _git("rev-parse", "--short=10", "HEAD")
    changed = _git("status", "--porcelain", "--", *_MEASURED)
    return {"commit": commit or "unknown", "dirty": bool(changed), "sources": _source_digest()}


def _source_digest() -> str:
    digest = hashlib.sha256()
    for package in _MEASURED:
        for file in sorted((ROOT / package).rglob("*.py")):
            name = file.relative_to(ROOT).as_posix()
            if not name.startswith(_NOT_MEASURED):
                digest.update(name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else ""


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.processor() or platform.machine()


def _gpu() -> str | None:
    if shutil.which("nvidia-smi") is None:
        return None
    done = subprocess.run(
        ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"], capture_output=True, text=True
    )
    names = [line.strip() for line in done.stdout.splitlines() if line.strip()]
    return ", ".join(names) if done.returncode == 0 and names else None
