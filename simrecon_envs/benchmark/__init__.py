"""Suites of tasks that an oracle has solved, evaluation of policies on them, comparisons, demonstrations.

    from simrecon_envs.benchmark import load_suite
    suite = load_suite("suite.json")
    env = suite.make(suite.tasks[0])

The command line is `simrecon benchmark --help`; docs/embodied_benchmarks.md explains the method.
"""

from simrecon_envs.benchmark.compare import compare_results
from simrecon_envs.benchmark.results import Results, load_results
from simrecon_envs.benchmark.suite import Suite, SuiteTask, load_suite

__all__ = ["Results", "Suite", "SuiteTask", "compare_results", "load_results", "load_suite"]
