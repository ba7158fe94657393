"""One finding about the machine, and the table of all of them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """One finding: what was looked for, whether it works, what to do if not."""

    name: str
    ok: bool
    detail: str  # what was found
    fix: str  # what to do if not ok
    required: bool  # whether reconstructions, or all of SimRecon, fail without it


def format_checks(checks: list[Check]) -> str:
    """Return the checks as a text table, and a line that sums them up."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        mark = "ok     " if check.ok else "MISSING" if check.required else "absent "
        lines.append(f"{mark}  {check.name.ljust(width)}  {check.detail}")
        if not check.ok and check.fix:
            lines.append(f"{'':7}  {'':{width}}  -> {check.fix}")
    broken = [check.name for check in checks if check.required and not check.ok]
    without = [check.name for check in checks if not check.required and not check.ok]
    lines.append("")
    if broken:
        lines.append(f"SimRecon cannot work here yet: {', '.join(broken)}.")
    elif without:
        lines.append(f"SimRecon works here, without: {', '.join(without)}.")
    else:
        lines.append("Everything works here.")
    return "\n".join(lines)
