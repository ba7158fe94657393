"""Digests of code: what a stage's result depends on counts, nothing else does."""

import os

import pytest

from reconstruction.code_digest import code_digest, modules_behind, tree_digest
from reconstruction.pipeline import STAGES

pytestmark = pytest.mark.stage

FILES = {
    "__init__.py": "",
    "stage/__init__.py": "from house.stage.work import run\nfrom house import shared\n",
    "stage/work.py": "import numpy\n\n\ndef run():\n    from house.late import more\n    return more()\n",
    "stage/weights/w.safetensors": "one",
    "shared.py": "X = 1\n",
    "late.py": "def more():\n    return 2\n",
    "typed.py": "Y = 1\n",
    "elsewhere.py": "Z = 1\n",
}


@pytest.fixture
def house(tmp_path, monkeypatch):
    """A package of a stage and of modules that it imports, or not."""
    for name, text in FILES.items():
        file = tmp_path / "house" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    from reconstruction import code_digest as module

    module._root_of.cache_clear()
    return tmp_path / "house"


def digest() -> str:
    return code_digest("house.stage", ("house",))


def edit(file, text):
    file.write_text(text)
    stat = file.stat()
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1_000_000))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("shared.py", "X = 2\n"),
        ("late.py", "def more():\n    return 3\n"),  # imported inside a function
        ("stage/work.py", FILES["stage/work.py"].replace("return more()", "return 1 + more()")),
        ("stage/weights/w.safetensors", "two"),
        ("stage/words.txt", "a new file of data"),
    ],
)
def test_what_the_stage_depends_on_changes_its_digest(house, name, text):
    before = digest()
    edit(house / name, text)
    assert digest() != before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("elsewhere.py", "Z = 2\n"),
        ("shared.py", '"""A docstring."""\n\n# a comment\nX = (\n    1\n)\n'),
        ("stage/work.py", FILES["stage/work.py"].replace("def run():", 'def run():\n    """Words."""')),
        (
            "stage/work.py",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from house.typed import Y\n"
            + FILES["stage/work.py"],
        ),
    ],
)
def test_nothing_else_does(house, name, text):
    if "TYPE_CHECKING" in text:  # only what it imports is left out, the name itself is code
        edit(house / name, text)
        before = digest()
        edit(house / "typed.py", "Y = 2\n")
    else:
        before = digest()
        edit(house / name, text)
    assert digest() == before


def test_modules_are_followed_and_other_packages_are_not(house):
    assert modules_behind("house.stage", ("house",)) == [
        "house.late", "house.shared", "house.stage", "house.stage.work",
    ]  # fmt: skip


def test_a_relative_import_is_refused_and_not_left_out(house):
    edit(house / "shared.py", "from . import elsewhere\n")
    with pytest.raises(ValueError, match=r"shared\.py:1: relative imports"):
        digest()


def test_a_missing_package_is_an_error(house):
    with pytest.raises(ModuleNotFoundError, match="no package nowhere"):
        code_digest("nowhere.at_all", ("house",))


def test_leaves_of_the_project_count_for_the_stages_that_use_them():
    behind = {stage.name: modules_behind(stage.package) for stage in STAGES}
    for stage, leaf in (
        ("frames", "reconstruction.frames.keyframes"),
        ("frames", "reconstruction.frames.decoding"),
        ("depth", "reconstruction.depth.sgm"),
        ("assembly", "registry.simulation"),
        ("assembly", "registry.report_card"),
        ("instances", "reconstruction.learned.models"),
        ("assets", "reconstruction.learned.vlm"),
    ):
        assert leaf in behind[stage], (stage, leaf)
    for stage, modules in behind.items():
        assert not [
            m for m in modules if m.startswith(("reconstruction.commands", "reconstruction.measure.report."))
        ], stage
    assert "reconstruction.assets.build" not in behind["surface"]


def test_a_comment_does_not_change_the_digest_of_a_file(tmp_path):
    file = tmp_path / "a.py"
    edit(file, "x = 1\n")
    before = tree_digest(file)
    edit(file, "# why\nx = 1  # because\n")
    assert tree_digest(file) == before
    edit(file, "x = 2\n")
    assert tree_digest(file) != before
