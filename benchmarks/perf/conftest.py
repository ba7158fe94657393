"""Times kernels in turns with the reference and prints the ratios.

pytest benchmarks/perf [--perf-rounds N] [--perf-json FILE]
"""

import json
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.perf.ratios import Ratio, ratio
from benchmarks.perf.reference import Reference

_RATIOS = pytest.StashKey[dict]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of this folder."""
    group = parser.getgroup("perf")
    group.addoption("--perf-rounds", type=int, default=21, help="rounds per kernel (default 21)")
    group.addoption("--perf-json", type=Path, metavar="FILE", help="write the least ratios there")


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
    """Return a function that times `kernel(*setup())` in turns with the reference and returns its result."""
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
        found = ratio(np.array(benchmark.stats.stats.data), np.array(taken))
        config.stash[_RATIOS][name] = found
        benchmark.extra_info.update(asdict(found))
        return result

    return run


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the ratios; write them where that was asked for."""
    ratios: dict[str, Ratio] = config.stash[_RATIOS]
    if not ratios:
        return
    terminalreporter.section("kernels, in units of the reference (one thread)")
    terminalreporter.write_line(f"{'kernel':<18}{'ratio':>9}{'quartiles':>18}{'least':>9}{'ms here':>10}")
    for name, found in ratios.items():
        terminalreporter.write_line(
            f"{name:<18}{found.median:>9.2f}{f'{found.low:.2f} to {found.high:.2f}':>18}"
            f"{found.least:>9.2f}{found.kernel_ms:>10.1f}"
        )
    reference_ms = np.median([found.reference_ms for found in ratios.values()])
    terminalreporter.write_line(f"reference: {reference_ms:.1f} ms, load {os.getloadavg()[0]:.1f}")
    place = config.getoption("--perf-json")
    if place:
        place.write_text(json.dumps({name: found.least for name, found in ratios.items()}, indent=1) + "\n")
