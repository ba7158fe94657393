"""Times kernels in turns with the reference, prints the ratios, and compares them with the stored ones if asked.

pytest benchmarks/perf [--perf-rounds N] [--perf-compare] [--perf-save]
"""

import json
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.machine import describe_code, describe_machine
from benchmarks.perf.ratios import BASELINE, Ratio, complain, load_stored
from benchmarks.perf.reference import Reference

_RATIOS = pytest.StashKey[dict]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of this folder."""
    group = parser.getgroup("perf")
    group.addoption("--perf-baseline", type=Path, default=BASELINE, metavar="FILE", help="the stored ratios")
    group.addoption("--perf-rounds", type=int, default=21, help="rounds per kernel (default 21)")
    group.addoption(
        "--perf-compare", action="store_true", help="fail where a kernel became slower than stored"
    )
    group.addoption("--perf-save", action="store_true", help="store the ratios")


def pytest_configure(config: pytest.Config) -> None:
    """Make room for the ratios."""
    config.stash[_RATIOS] = {}


@pytest.fixture(scope="session")
def reference() -> Reference:
    """Return the compiled reference. All kernels run on one thread, or ratios would depend on the number of cores."""
    import numba

    numba.set_num_threads(1)
    return Reference()


@pytest.fixture
def measure(benchmark: Any, reference: Reference, request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Return a function that times `kernel(*setup())` in turns with the reference and returns its result.

    The ratio is then compared with the stored one, where that was asked for.
    """
    name = request.node.name.removeprefix("test_")
    config = request.config

    def run(kernel: Callable[..., Any], setup: Callable[[], tuple] = tuple) -> Any:
        for _ in range(2):  # compiles, fills caches
            kernel(*setup())
        taken: list[float] = []

        def before() -> tuple[tuple, dict]:
            arguments = setup()
            taken.append(reference.time_s())
            return arguments, {}

        result = benchmark.pedantic(kernel, setup=before, rounds=config.getoption("--perf-rounds"))
        if benchmark.stats is None:  # --benchmark-disable
            return result
        found = _ratio(np.array(benchmark.stats.stats.data), np.array(taken))
        config.stash[_RATIOS][name] = found
        benchmark.extra_info.update(asdict(found))
        if config.getoption("--perf-compare"):
            complaint = complain(name, found.median, load_stored(config.getoption("--perf-baseline")))
            if complaint:
                pytest.fail(complaint, pytrace=False)
        return result

    return run


def _ratio(kernel_s: np.ndarray, reference_s: np.ndarray) -> Ratio:
    """Compare the times of each round, kernel and reference (n,)."""
    low, median, high = np.percentile(kernel_s / reference_s, [25, 50, 75])
    return Ratio(
        float(median),
        float(low),
        float(high),
        1e3 * float(np.median(kernel_s)),
        1e3 * float(np.median(reference_s)),
    )


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the ratios beside the stored ones; store them where that was asked for."""
    ratios: dict[str, Ratio] = config.stash[_RATIOS]
    if not ratios:
        return
    place = config.getoption("--perf-baseline")
    stored = load_stored(place)
    terminalreporter.section("kernels, in units of the reference (one thread)")
    heads = ("kernel", "ratio", "quartiles", "ms here", "stored", "change")
    terminalreporter.write_line("{:<18}{:>9}{:>18}{:>10}{:>9}{:>9}".format(*heads))
    for name, found in ratios.items():
        before = stored["ratios"].get(name)
        shown = ("-", "-") if before is None else (f"{before:.2f}", f"{found.median / before - 1:+.0%}")
        terminalreporter.write_line(
            f"{name:<18}{found.median:>9.2f}{f'{found.low:.2f} to {found.high:.2f}':>18}"
            f"{found.kernel_ms:>10.1f}{shown[0]:>9}{shown[1]:>9}"
        )
    reference_ms = np.median([found.reference_ms for found in ratios.values()])
    terminalreporter.write_line(f"reference: {reference_ms:.1f} ms, load {os.getloadavg()[0]:.1f}")
    if config.getoption("--perf-save"):
        stored["ratios"] |= {name: round(found.median, 3) for name, found in ratios.items()}
        stored["machine"], stored["commit"] = describe_machine(), describe_code()["commit"]
        place.write_text(json.dumps(stored, indent=1) + "\n")
        terminalreporter.write_line(f"stored in {place}")
