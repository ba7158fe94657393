"""`simrecon doctor`: checks of this machine."""

import argparse
import json
from dataclasses import asdict

from reconstruction.commands.options import add_verb


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs,
        "doctor",
        "what works on this machine, what is missing, how to get it",
        "Check this machine; list installed plugins. Exit code 4: something required is missing.",
    )
    parser.add_argument("--json", action="store_true", help="print JSON for programs instead of text")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print all checks; return 4 if a required one fails."""
    from reconstruction.doctor import format_checks, run_checks

    checks = run_checks()
    print(json.dumps([asdict(c) for c in checks], indent=2) if arguments.json else format_checks(checks))
    return 4 if any(c.required and not c.ok for c in checks) else 0
