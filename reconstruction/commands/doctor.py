"""`simrecon doctor`: what works on this machine, what is missing, how to get it."""

import argparse
import json
from dataclasses import asdict


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Register the verb."""
    parser = verbs.add_parser(
        "doctor",
        help="what works on this machine, what is missing, how to get it",
        description="Check this machine. Exit code 4 if something that is required is missing.",
    )
    parser.add_argument("--json", action="store_true", help="print JSON for programs instead of text")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run all checks and print them."""
    from reconstruction.doctor import format_checks, run_checks

    checks = run_checks()
    print(json.dumps([asdict(c) for c in checks], indent=2) if arguments.json else format_checks(checks))
    return 4 if any(c.required and not c.ok for c in checks) else 0
