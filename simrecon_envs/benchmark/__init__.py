"""Suites of tasks that are proven to be solvable, policies in them, comparisons, demonstrations.

    from simrecon_envs.benchmark import load_suite
    suite = load_suite("suite.json")
    env = suite.make(suite.tasks[0])

`simrecon benchmark --help` is the way in for people; docs/embodied_benchmarks.md says how it works.
"""

from simrecon_envs.benchmark.compare import compare_results
from simrecon_envs.benchmark.results import Results, load_results
from simrecon_envs.benchmark.suite import Suite, SuiteTask, load_suite

__all__ = ["Results", "Suite", "SuiteTask", "compare_results", "load_results", "load_suite"]
