"""Which code made a result: a fingerprint of a stage's module and of all it imports from this package.

Snakemake reruns a rule when its ``params`` change. A fingerprint among them makes an edit of the code a
change, and leaves out what cannot change a result: comments, docstrings and layout.
"""

from __future__ import annotations

import ast
from functools import cache
from hashlib import blake2b
from importlib.util import find_spec
from pathlib import Path

PACKAGE = "p2wss"
# their values reach a stage through the parameters, or they only pass paths on
NOT_TRACKED = ("config", "provenance", "cli")


@cache
def fingerprint(*stages: str) -> str:
    """Hash of the import closure of the modules ``p2wss.<stage>``: 16 hexadecimal digits.

    A package named here counts with all its modules, one that is imported with what its ``__init__`` imports.
    A folder of other files, such as "eval.templates", counts with their contents.

    Raises ``ModuleNotFoundError`` for a stage that is nothing of the package.
    """
    pending = [part for stage in stages for part in _parts(f"{PACKAGE}.{stage}")]
    seen: dict[str, str] = {}
    while pending:
        module = pending.pop()
        if module in seen or (module.split(".")[1:2] and module.split(".")[1] in NOT_TRACKED):
            continue
        path = _source(module)
        if path is None:
            folder = _root().joinpath(*module.split(".")[1:])
            if not folder.is_dir():
                raise ModuleNotFoundError(f"no module {module}")
            seen |= {str(file.relative_to(_root())): _digest(file) for file in sorted(folder.iterdir())}
            continue
        tree = ast.parse(path.read_bytes())
        pending += _imports(tree, module, is_package=path.name == "__init__.py")
        seen[module] = ast.dump(_without_docstrings(tree))
    digest = blake2b(digest_size=8)
    for module in sorted(seen):
        digest.update(f"{module}\n{seen[module]}\n".encode())
    return digest.hexdigest()


def _parts(module: str) -> list[str]:
    """The module, and if it is a package its modules."""
    path = _source(module)
    inside = sorted(path.parent.rglob("*.py")) if path is not None and path.name == "__init__.py" else []
    names = [".".join((PACKAGE, *file.relative_to(_root()).with_suffix("").parts)) for file in inside]
    return [module, *(name.removesuffix(".__init__") for name in names)]


def _digest(file: Path) -> str:
    return blake2b(file.read_bytes(), digest_size=8).hexdigest()


def _root() -> Path:
    spec = find_spec(PACKAGE)
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).parent


def _source(module: str) -> Path | None:
    base = _root().joinpath(*module.split(".")[1:])
    for path in (base / "__init__.py", base.with_suffix(".py")):
        if path.is_file():
            return path
    return None


def _imports(tree: ast.AST, module: str, is_package: bool) -> list[str]:
    """Modules of this package imported anywhere in ``tree``, imports inside functions included."""
    found = []
    package = module if is_package else module.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parent = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parent, *([node.module] if node.module else [])])
            found.append(base)
            found += [f"{base}.{alias.name}" for alias in node.names]
    inside = [name for name in found if name == PACKAGE or name.startswith(f"{PACKAGE}.")]
    return [name for name in dict.fromkeys(inside) if _source(name) is not None]


def _without_docstrings(tree: ast.AST) -> ast.AST:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if (
            isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            and body
            and isinstance(body[0], ast.Expr)
            and isinstance(body[0].value, ast.Constant)
            and isinstance(body[0].value.value, str)
        ):
            node.body = body[1:] or [ast.Pass()]
    return tree
