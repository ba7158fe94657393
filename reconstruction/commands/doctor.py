"""`simrecon doctor`: checks of this machine."""

import argparse
import json
from dataclasses import asdict

from reconstruction.commands.options import add_verb

_LONG_S = 5.0  # a kernel that took longer is named


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs,
        "doctor",
        "what works on this machine, what is missing, how to get it",
        "Check this machine; list installed plugins. Exit code 4: something required is missing.",
    )
    parser.add_argument(
        "--warm",
        action="store_true",
        help="instead, compile the kernels of a reconstruction now (a minute or two, once after an installation or "
        "update); without this they compile during the first reconstruction",
    )
    parser.add_argument("--json", action="store_true", help="print JSON for programs instead of text")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print all checks; return 4 if a required one fails."""
    if arguments.warm:
        return _warm()
    from reconstruction.doctor import format_checks, run_checks

    checks = run_checks()
    print(json.dumps([asdict(c) for c in checks], indent=2) if arguments.json else format_checks(checks))
    return 4 if any(c.required and not c.ok for c in checks) else 0


def _warm() -> int:
    """Compile the kernels of all stages, one process a core; print each that took long."""
    import os
    import sys
    import time

    from reconstruction.core.precompiling import Kernel, are_compiled, compile_all

    if are_compiled():
        print("The kernels of a reconstruction are compiled on this machine.")
        return 0
    start = time.perf_counter()

    def told(kernel: Kernel, seconds: float) -> None:
        if seconds > _LONG_S:
            print(f"compiled {kernel} in {seconds:.0f} s", flush=True)

    count, failed = compile_all(os.cpu_count() or 1, told)
    for line in failed:
        print(f"could not be compiled: {line}", file=sys.stderr)
    print(f"{count - len(failed)} kernels are compiled, in {time.perf_counter() - start:.0f} s.")
    return 4 if failed else 0
