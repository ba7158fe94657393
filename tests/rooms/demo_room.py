"""The shipped video, reconstructed with the preset `fast`: kept on disk, copied for each test that changes it."""

import shutil
import subprocess
import sys
from pathlib import Path

from kept import ROOT, kept_folder

VIDEO = ROOT / "examples" / "data" / "demo_room.mp4"


def fast_demo(folder: Path) -> Path:
    """Return a copy of the home (`registry/`, `work/`) with the scene `demo_room`."""
    return Path(shutil.copytree(kept_folder(_reconstruct), folder / "home"))


def _reconstruct(home: Path) -> None:
    command = [sys.executable, "-m", "reconstruction.cli", "reconstruct", str(VIDEO), "--scene", "demo_room"]
    command += ["--registry", str(home / "registry"), "--preset", "fast", "--quiet"]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
