"""The pins of constraints.txt agree with what the project and its packages ask for, so that `make setup` resolves."""

from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

tomllib = pytest.importorskip("tomllib")  # Python 3.11

pytestmark = pytest.mark.unit

ROOT = Path(__file__).parents[1]


def pins():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    requirements = [Requirement(line) for line in lines]
    active = [pin for pin in requirements if pin.marker is None or pin.marker.evaluate()]
    return {canonicalize_name(pin.name): next(iter(pin.specifier)).version for pin in active}


def project_requirements():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = list(project["dependencies"])
    pending = ["dev"]
    while pending:
        for line in extras[pending.pop()]:
            requirement = Requirement(line)
            if requirement.name == "simrecon":
                pending += requirement.extras
            else:
                lines.append(line)
    return [Requirement(line) for line in lines]


def active_requirements():
    """Return (who asks, requirement) for the project and everything that its requirements pull in."""
    pending = [("simrecon", requirement) for requirement in project_requirements()]
    seen, found = set(), []
    while pending:
        who, requirement = pending.pop()
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        found.append((who, requirement))
        for extra in {"", *requirement.extras}:
            key = (canonicalize_name(requirement.name), extra)
            if key in seen:
                continue
            seen.add(key)
            try:
                asked = metadata.requires(requirement.name) or []
            except metadata.PackageNotFoundError:
                continue  # opencv-python: set-up keeps the headless build alone
            for line in asked:
                inner = Requirement(line)
                if inner.marker is None or inner.marker.evaluate({"extra": extra}):
                    inner.marker = None
                    pending.append((key[0], inner))
    return found


def test_every_pin_satisfies_every_package_that_asks_for_it():
    pinned = pins()
    conflicts = [
        f"{who} asks for {requirement}, constraints.txt pins {pinned[name]}"
        for who, requirement in active_requirements()
        if (name := canonicalize_name(requirement.name)) in pinned
        and not requirement.specifier.contains(pinned[name], prereleases=True)
    ]
    assert not conflicts


def test_every_package_that_is_installed_for_the_project_is_pinned():
    pinned = pins()
    missing = {
        canonicalize_name(requirement.name)
        for _, requirement in active_requirements()
        # CUDA's packages come with other builds of torch; `make setup` keeps them out.
        if not requirement.name.startswith(("nvidia-cu", "nvidia-nc", "nvidia-nv", "cuda-", "triton"))
    } - pinned.keys()
    assert not missing, "run tools/update_constraints.sh"
