"""Imports stay light and point inward: reconstruction -> registry <- simrecon_envs."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

from reconstruction.code_digest import imported_modules
from reconstruction.pipeline import STAGES

pytestmark = pytest.mark.stage

ROOT = Path(__file__).resolve().parent.parent
HEAVY = ("torch", "sapien", "mani_skill", "numba", "pycolmap", "trimesh", "cv2", "scipy", "coacd", "skimage")


def _loaded_after(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint('\\n'.join(m for m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


@pytest.mark.parametrize(
    ("statement", "forbidden"),
    [
        ("import registry", (*HEAVY, "reconstruction", "simrecon_envs", "gymnasium")),
        ("import simrecon_envs", (*HEAVY, "reconstruction")),
        ("import reconstruction", (*HEAVY, "simrecon_envs")),
        ("import reconstruction.cli; reconstruction.cli.build_parser()", (*HEAVY, "simrecon_envs")),
    ],
)
def test_import_loads_nothing_heavy(statement, forbidden):
    assert not _loaded_after(statement) & set(forbidden)


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("registry", {"reconstruction", "simrecon_envs", "studio"}),
        ("simrecon_envs", {"reconstruction", "studio"}),
        ("reconstruction", {"simrecon_envs", "studio"}),
    ],
)
def test_no_file_imports_against_the_direction(package, forbidden):
    for file in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            wrong = {name for name in names if name.split(".")[0] in forbidden}
            assert not wrong, f"{file.relative_to(ROOT)} imports {wrong}"


def test_no_modules_import_each_other_in_a_circle():
    command = [sys.executable, "tools/structure.py", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    said = json.loads(done.stdout)
    assert said["circle"] == []
    assert done.returncode == 0
    assert sum(package["files"] for package in said["packages"]) > 500


def test_a_stage_imports_no_later_stage():
    packages = [stage.package for stage in STAGES]
    for row, package in enumerate(packages):
        folder = ROOT.joinpath(*package.split("."))
        files = list(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]
        for file in files:
            for name in imported_modules(file, ("reconstruction",)):
                later = [p for p in packages[row + 1 :] if name == p or name.startswith(f"{p}.")]
                assert not later, f"{file.relative_to(ROOT)} imports {name}"
                assert not name.startswith(("reconstruction.runner", "reconstruction.pipeline")), file
