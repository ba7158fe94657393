"""The docs name only files, links and commands that exist."""

import re
from pathlib import Path

import pytest

from reconstruction.cli import build_parser
from reconstruction.editing.overrides import Overrides

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_relative_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_paths_of_the_project_exist(page):
    for path in re.findall(
        r"`((?:reconstruction|registry|simrecon_envs|tests|tools|examples|docs)/[\w./*-]+)`", page.read_text()
    ):
        assert list(ROOT.glob(path.rstrip("/"))), f"{page.name} names {path}"


def _verbs() -> dict:
    return next(a for a in build_parser()._actions if a.dest == "verb").choices


def test_every_verb_is_documented_and_has_help():
    text = (ROOT / "README.md").read_text()
    for name, parser in _verbs().items():
        assert name in text, f"README does not mention simrecon {name}"
        assert len(parser.format_help()) > 100
        assert parser.description


def test_make_targets_of_the_docs_exist():
    targets = set(re.findall(r"^(\w[\w-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        named = set(re.findall(r"^(?:    |)(?:make) ([\w-]+)", page.read_text(), re.MULTILINE))
        assert named <= targets, f"{page.name} names {named - targets}"


def test_the_overrides_that_are_shown_are_legal(tmp_path):
    shown = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs" / "overrides.md").read_text(), re.DOTALL)
    (tmp_path / "my_mug.glb").touch()
    assert shown
    for number, text in enumerate(shown):
        path = tmp_path / f"{number}.yaml"
        path.write_text(text)
        assert len(Overrides.load(path).entries) >= 10
    assert Overrides.load(ROOT / "examples" / "data" / "demo_fixes.yaml").entries


def test_the_table_of_materials_is_that_of_the_code():
    from reconstruction.assets.physics.materials import MATERIALS

    page = (ROOT / "docs" / "physics.md").read_text()
    rows = {line.split("|")[1].strip(): line.split("|")[2:6] for line in page.splitlines() if "|" in line}
    for name, material in MATERIALS.items():
        cells = (material.density_kg_m3, material.friction, material.restitution, material.wall_m)
        for cell, spread, unit in zip(rows[name], cells, (1, 1, 1, 1000), strict=True):
            assert (
                cell.strip() == f"{spread.value * unit:g} ({spread.low * unit:g} to {spread.high * unit:g})"
            )
