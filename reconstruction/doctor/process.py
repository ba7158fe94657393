"""Checks in other processes, as a broken driver or compiled package may crash or hang the process that loads it."""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from reconstruction.doctor.check import Check

TIME_LIMIT_S = 60.0
_ROOT = Path(__file__).parents[2]
_CALL = """
import dataclasses, json, sys
sys.path.insert(0, {root!r})
from {module} import {function}
found = {function}()
print(found if isinstance(found, str) else json.dumps([dataclasses.asdict(check) for check in found]))
"""


def start_call(module: str, function: str) -> subprocess.Popen:
    """Start a process that calls a function without arguments, and prints the text or the checks that it returns."""
    return start(_CALL.format(root=str(_ROOT), module=module, function=function))


def start(code: str) -> subprocess.Popen:
    """Start a process that runs Python code, in a folder where no file can shadow a module."""
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tempfile.gettempdir(),
    )


def finish(name: str, process: subprocess.Popen, fix: str, required: bool) -> Check:
    """Wait for a process; it passes if its exit code is 0, and its last line of output is the detail."""
    code, out, err = wait(process)
    if code == 0:
        return Check(name, True, out.strip().splitlines()[-1] if out.strip() else "works", "", required)
    return Check(name, False, _reason(code, err), fix, required)


def finish_checks(name: str, process: subprocess.Popen) -> list[Check]:
    """Wait for a process that prints checks as JSON; return them, or one check with the reason of its failure."""
    code, out, err = wait(process)
    if code == 0:
        return [Check(**found) for found in json.loads(out.strip().splitlines()[-1])]
    detail = f"could not be checked: {_reason(code, err)}"
    return [Check(name, False, detail, "repair what is missing above first", False)]


def wait(process: subprocess.Popen) -> tuple[int | None, str, str]:
    """Return exit code, output and error output of a process; the code is None after `TIME_LIMIT_S`."""
    try:
        out, err = process.communicate(timeout=TIME_LIMIT_S)
        return process.returncode, out, err
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        return None, out, err


def _reason(code: int | None, err: str) -> str:
    """Return why a process failed: its last line of error output, without the exception's name."""
    if code is None:
        return f"no answer within {TIME_LIMIT_S:g} s"
    if code < 0:
        return f"the process crashed (signal {-code})"
    if not err.strip():
        return f"exit code {code}"
    return re.sub(r"^(\w+\.)*(\w*Error|\w*Exception): ", "", err.strip().splitlines()[-1])
