"""Variants: named sets of arguments for `simrecon reconstruct`. To add one, add it to VARIANTS."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.captures import TRUTH_ORDER, Capture, Truth
from registry.errors import UsageError

GROUND_TRUTH = "{ground_truth}"  # stands for the capture's ground-truth folder in a variant's arguments


@dataclass(frozen=True)
class Variant:
    """One way to reconstruct a capture."""

    name: str
    arguments: tuple[str, ...]
    meaning: str
    needs: Truth = "none"  # the least truth that a capture must have for the variant to make sense

    def applies_to(self, capture: Capture) -> bool:
        """Tell whether the capture has the truth that the variant needs."""
        return TRUTH_ORDER.index(capture.truth) >= TRUTH_ORDER.index(self.needs)

    def arguments_for(self, capture: Capture) -> list[str]:
        """Return the arguments with the capture's own paths in them."""
        return [text.replace(GROUND_TRUTH, str(capture.ground_truth)) for text in self.arguments]


def _oracle(name: str, needs: Truth, *stages: str) -> Variant:
    found = f"stage `{stages[0]}` finds" if len(stages) == 1 else f"stages {', '.join(stages)} find"
    arguments = ("--oracle", ",".join(stages), "--ground-truth", GROUND_TRUTH)
    return Variant(f"oracle-{name}", arguments, f"the truth in place of what the {found}", needs)


VARIANTS: tuple[Variant, ...] = (
    Variant("default", (), "the preset `default`"),
    Variant("fast", ("--preset", "fast"), "the preset `fast`"),
    Variant("quality", ("--preset", "quality"), "the preset `quality`"),
    Variant(
        "true-masks",
        ("--set", "instances.masks=folder", "--set", f"instances.masks_path={GROUND_TRUTH}/instances"),
        "the true id images of every tenth frame as masks from a folder: what the lifting makes of perfect masks",
        "scene",
    ),
    _oracle("poses", "cameras", "poses"),
    _oracle("depth", "scene", "depth"),
    _oracle("world", "scene", "world"),
    _oracle("instances", "scene", "instances"),
    _oracle("all", "scene", "poses", "depth", "world", "instances"),
)
_RUN_MARK = "+p"  # between a variant's name and a run's seed; names of variants have no plus
BASELINE = "default"  # what the tables compare the other variants with


def is_oracle(name: str) -> bool:
    """Tell whether a variant of this name is given some of the truth."""
    return name.startswith("oracle-")


def choose_variants(names: Sequence[str], extra: Sequence[str]) -> list[Variant]:
    """Return the named variants, then the ad hoc ones.

    Args:
        names: of VARIANTS.
        extra: `name=arguments` each, for example `sharp=--set depth.side_px=640`.

    Raises:
        UsageError: a name is unknown, malformed or taken.
    """
    known = {variant.name: variant for variant in VARIANTS}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise UsageError(f"--variants {' '.join(unknown)}: not known; there are {', '.join(known)}")
    chosen = {name: known[name] for name in names}
    for text in extra:
        name, equals, arguments = text.partition("=")
        if not equals or not name.replace("-", "").replace("_", "").isalnum():
            raise UsageError(
                f'--variant {text}: expected name="arguments", for example sharp="--set depth.side_px=640"'
            )
        if name in known or name in chosen:
            raise UsageError(f"--variant {name}: this name is taken; choose another")
        words = tuple(shlex.split(arguments))
        needs: Truth = "cameras" if any(GROUND_TRUTH in word for word in words) else "none"
        chosen[name] = Variant(name, words, f"`{arguments.strip()}`", needs)
    return list(chosen.values())


def perturbed_variants(variant: Variant, runs: int) -> list[Variant]:
    """Return a variant and `runs - 1` more whose depth maps differ from its own in the last bits only.

    One that is given the true depth stays alone: nothing is estimated there that could be changed.
    """
    if "--oracle" in variant.arguments:
        given = variant.arguments[variant.arguments.index("--oracle") + 1].split(",")
        if "depth" in given:
            return [variant]
    return [variant] + [
        replace(
            variant,
            name=f"{variant.name}{_RUN_MARK}{seed}",
            arguments=(*variant.arguments, "--set", f"depth.perturb={seed}"),
        )
        for seed in range(1, runs)
    ]


def run_of(name: str) -> tuple[str, int]:
    """Return the variant that a run is of, and the seed of its perturbation (0: none), by the run's name."""
    variant, mark, seed = name.partition(_RUN_MARK)
    return (variant, int(seed)) if mark else (name, 0)


def scene_id(variant: Variant) -> str:
    """Return the id under which the variant's scene is registered."""
    return variant.name.lower().replace("-", "_").replace("+", "__")


def home_of(out: Path, capture: Capture) -> Path:
    """Return the home of a capture's runs: one registry, and one work folder that all variants share."""
    return out / capture.name / "home"
