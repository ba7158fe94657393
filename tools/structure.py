"""Print the structure of the code: files, lines, longest function, numeric literals by package, and import circles.

    python tools/structure.py [--json]

Exits with 1 where modules import each other in a circle. What we aim for: tools/README.md.
"""

import argparse
import ast
import graphlib
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from reconstruction.code_digest import imported_modules  # noqa: E402

PACKAGES = (
    "registry",
    "reconstruction",
    "simrecon_envs",
    "studio",
    "synthetic",
    "priors",
    "benchmarks",
    "examples",
    "tools",
)
PRODUCT = ("registry", "reconstruction", "simrecon_envs", "studio")
_USUAL = (0, 1, 2, 0.5)
_LONG_FILE = 450


@dataclass
class Row:
    """Figures of a package."""

    package: str
    files: int = 0
    lines: int = 0
    literals: int = 0  # numbers other than 0, 1, 2, .5 and indices
    longest_function: int = 0
    longest_name: str = ""
    long_files: int = 0  # of more than 450 lines


def measure(files: list[Path], package: str) -> Row:
    """Return the figures of some files."""
    row = Row(package)
    for file in files:
        text = file.read_text()
        tree, lines = ast.parse(text), text.count("\n")
        row.files += 1
        row.lines += lines
        row.long_files += lines > _LONG_FILE
        nodes = list(ast.walk(tree))
        slices = [node.slice for node in nodes if isinstance(node, ast.Subscript)]
        indices = {id(n) for part in slices for n in ast.walk(part)}
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = node.end_lineno - node.lineno + 1
                if length > row.longest_function:
                    row.longest_function = length
                    row.longest_name = f"{file.relative_to(ROOT)}:{node.lineno} {node.name}"
            is_number = isinstance(node, ast.Constant) and type(node.value) in (int, float)
            row.literals += is_number and id(node) not in indices and abs(node.value) not in _USUAL
    return row


def packages() -> dict[str, list[Path]]:
    """Return the files of every package and, of `reconstruction` and `simrecon_envs`, of what is in it."""
    out: dict[str, list[Path]] = {}
    for name in PACKAGES:
        for file in sorted((ROOT / name).rglob("*.py")):
            inside = file.relative_to(ROOT / name).parts
            deep = name in ("reconstruction", "simrecon_envs") and len(inside) > 1
            out.setdefault(f"{name}.{inside[0]}" if deep else name, []).append(file)
    return out


def circle() -> list[str]:
    """Return modules that import each other in a circle, the first again at the end; empty where none do."""
    names = {
        ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
        for files in packages().values()
        for file in files
    }
    graph = {name: imported_modules(file, PACKAGES) & names.keys() for name, file in names.items()}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", action="store_true", help="for programs")
    options = parser.parse_args()
    rows = [measure(files, name) for name, files in packages().items()]
    product = sum(row.lines for row in rows if row.package.split(".")[0] in PRODUCT)
    found = circle()
    if options.json:
        print(json.dumps({"packages": [asdict(r) for r in rows], "product_lines": product, "circle": found}))
        return 1 if found else 0
    print(f"{'package':<34}{'files':>6}{'lines':>8}{'literals':>10}{'long files':>12}  longest function")
    for row in rows:
        print(
            f"{row.package:<34}{row.files:>6}{row.lines:>8}{row.literals:>10}{row.long_files:>12}  "
            f"{row.longest_function} {row.longest_name}"
        )
    print(f"product code: {product} lines")
    print(f"import circles: {' -> '.join(found) or 'none'}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
