"""Digest of the code of a module and of all modules of this project that it imports, directly or indirectly.

The digest is over syntax trees without docstrings; comments and layout do not count. Data files beside the modules
(weights, prompts, word lists) count. Imports inside functions are followed, imports under `TYPE_CHECKING` are not. The
modules are parsed, not imported.
"""

import ast
import hashlib
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

PACKAGES = ("reconstruction", "registry")
_DATA = (".txt", ".safetensors")


def code_digest(module: str, packages: tuple[str, ...] = PACKAGES) -> str:
    """Return the SHA-256 over a module, all modules of `packages` that it imports, and their data files.

    Args:
        module: dotted name.
        packages: top-level packages whose imports are followed; the module itself may belong to another one.

    Raises:
        ModuleNotFoundError: the module's top-level package is not installed.
        ValueError: a module has a relative import.
    """
    digest = hashlib.sha256()
    folders = set()
    for name in modules_behind(module, packages):
        file = _file_of(name)
        digest.update(f"{name}\0{_source(file, packages)[0]}\0".encode())
        folders.add(file.parent)
    for file in sorted({data for folder in folders for data in _data_files(folder)}):
        stat = file.stat()
        digest.update(file.name.encode() + b"\0" + _bytes_digest(file, stat.st_mtime_ns, stat.st_size))
    return digest.hexdigest()


def modules_behind(module: str, packages: tuple[str, ...] = PACKAGES) -> list[str]:
    """Return the sorted names of a module and of all modules of `packages` that it imports, directly or indirectly."""
    found, open_ends = {module}, [module]
    while open_ends:
        new = set(_source(_file_of(open_ends.pop()), packages)[1]) - found
        found |= new
        open_ends += sorted(new)
    return sorted(found)


def tree_digest(file: Path) -> str:
    """Return the SHA-256 over the syntax tree of one file, without docstrings."""
    return _source(file, ())[0]


def imported_modules(file: Path, packages: tuple[str, ...] = PACKAGES) -> frozenset[str]:
    """Return the modules of `packages` that a file imports, except under `TYPE_CHECKING`."""
    return _source(file, packages)[1]


def _source(file: Path, packages: tuple[str, ...]) -> tuple[str, frozenset[str]]:
    """Return the digest of a file's syntax tree, and the modules of `packages` that it imports."""
    stat = file.stat()
    return _parsed(file, stat.st_mtime_ns, stat.st_size, packages)


@lru_cache(maxsize=4096)
def _parsed(file: Path, mtime_ns: int, size: int, packages: tuple[str, ...]) -> tuple[str, frozenset[str]]:
    text: list[str] = []
    statements: list[ast.Import | ast.ImportFrom] = []
    _write(ast.parse(file.read_bytes(), str(file)), text, statements)
    imported: set[str] = set()
    for node in statements:
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        else:
            if node.level:
                raise ValueError(
                    f"{file}:{node.lineno}: relative imports are not followed; write the full module name"
                )
            assert node.module is not None
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = {name for name in inside if name.split(".")[0] in packages and _exists(name)}
            imported |= modules if modules == inside else modules | {node.module}
    own = frozenset(name for name in imported if name.split(".")[0] in packages)
    return hashlib.sha256("".join(text).encode()).hexdigest(), own


def _write(node: ast.AST, text: list[str], imports: list[ast.Import | ast.ImportFrom]) -> None:
    """Append a syntax tree as text, and its import statements, without docstrings and `if TYPE_CHECKING:` blocks.

    One walk: half the time of a transformer and `ast.dump`, which every run of the pipeline would wait for.
    """
    if isinstance(node, ast.Import | ast.ImportFrom):
        imports.append(node)
    text.append(f"{type(node).__name__}(")
    for name in node._fields:
        value = getattr(node, name, None)
        if isinstance(value, list):
            text.append("[")
            _write_all(value, text, imports)
            text.append("]")
        elif not isinstance(value, ast.AST):
            text.append(repr(value))
        elif name != "ctx":  # loads and stores stand in different places
            _write(value, text, imports)
        text.append(",")
    text.append(")")


def _write_all(items: list, text: list[str], imports: list[ast.Import | ast.ImportFrom]) -> None:
    for item in items:
        if not isinstance(item, ast.AST):
            text.append(f"{item!r},")
        elif isinstance(item, ast.If) and isinstance(item.test, ast.Name) and item.test.id == "TYPE_CHECKING":
            _write_all(item.orelse, text, imports)
        elif not (
            isinstance(item, ast.Expr)
            and isinstance(item.value, ast.Constant)
            and isinstance(item.value.value, str)
        ):
            _write(item, text, imports)


def _file_of(module: str) -> Path:
    base = _base_of(module)
    package = base / "__init__.py"
    return package if package.is_file() else base.with_suffix(".py")


def _exists(module: str) -> bool:
    return _file_of(module).is_file()


def _base_of(module: str) -> Path:
    package, *rest = module.split(".")
    return _root_of(package).joinpath(*rest)


@lru_cache(maxsize=64)
def _root_of(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"no package {package}", name=package)
    file = Path(spec.origin)
    return file.parent if file.name == "__init__.py" else file.with_suffix("")


@lru_cache(maxsize=256)
def _bytes_digest(file: Path, mtime_ns: int, size: int) -> bytes:
    return hashlib.sha256(file.read_bytes()).digest()


def _data_files(folder: Path) -> list[Path]:
    """Return the data files in a folder and in its subfolders without Python files."""
    out = []
    for item in sorted(folder.iterdir()):
        if item.suffix in _DATA:
            out.append(item)
        elif item.is_dir() and not any(item.glob("*.py")):
            out += _data_files(item)
    return out
