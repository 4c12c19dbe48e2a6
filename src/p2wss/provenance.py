"""The code that made a result: a fingerprint of a stage's module and of everything it imports from this package.

Snakemake reruns a rule when its ``params`` change. A fingerprint among them makes an edit of the code such a
change. It excludes what cannot change a result: layout and comments, and words that only people read, which
are docstrings, descriptions (of columns, options and settings), messages of errors and assertions, and what is
logged. Names, numbers and values such as a status or a reason count: a text without a space is a value even in
an error. Values of columns and titles of tables are results, and count.

Each module is parsed once per process, and its digest does not depend on the version of Python.
"""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from functools import cache
from hashlib import blake2b
from typing import NamedTuple

PACKAGE = "p2wss"
# their values reach a stage through the parameters, or they only pass paths on
NOT_TRACKED = ("config", "provenance", "cli")
# arguments that hold a description; that of a column, ``field(name, type, description)``, has no keyword
DESCRIPTIONS = ("description", "about", "help")
COLUMN, DESCRIPTION_OF_COLUMN = "field", 2
ERRORS = ("Error", "Exception", "Warning", "warn")  # how the name of what takes a message ends
LOGGERS = ("log", "logger", "logging")
LEVELS = ("debug", "info", "warning", "error", "exception", "critical", "log")

_ROOT = os.path.dirname(os.path.abspath(__file__))


class Module(NamedTuple):
    """What counts of a module: a digest of its code, and the modules of this package that it imports."""

    digest: str
    imports: tuple[str, ...]


@cache
def fingerprint(*stages: str) -> str:
    """Hash of the import closure of the modules ``p2wss.<stage>``: 16 hexadecimal digits.

    A package named here counts with all its modules, one that is imported with what its ``__init__`` imports.
    A folder of other files, such as "eval.templates", counts with their contents. Of :data:`NOT_TRACKED`, only what
    is named here counts.

    Raises ``ModuleNotFoundError`` for a stage that is not in the package.
    """
    digests: dict[str, str] = {}
    named = {part for stage in stages for part in _parts(f"{PACKAGE}.{stage}")}
    pending = sorted(named)
    while pending:
        name = pending.pop()
        is_tracked = name in named or not {*name.split(".")[1:2]} & {*NOT_TRACKED}
        if name in digests or not is_tracked:
            continue
        if _source(name) is None:
            digests |= _other_files(name)
        else:
            module = _read(name)
            digests[name] = module.digest
            pending += module.imports
    digest = blake2b(digest_size=8)
    for name in sorted(digests):
        digest.update(f"{name}\n{digests[name]}\n".encode())
    return digest.hexdigest()


@cache
def _read(name: str) -> Module:
    path = _source(name)
    assert path is not None
    with open(path, "rb") as file:
        tree = ast.parse(file.read())
    code: list[str] = []
    imports: list[ast.Import | ast.ImportFrom] = []
    _write(tree, code, imports)
    is_package = os.path.basename(path) == "__init__.py"
    digest = blake2b("".join(code).encode(), digest_size=16).hexdigest()
    return Module(digest, tuple(_inside(imports, name, is_package)))


def _parts(name: str) -> list[str]:
    """The module, and if it is a package its modules."""
    path = _source(name)
    if path is None or os.path.basename(path) != "__init__.py":
        return [name]
    parts = []
    for folder, _, files in os.walk(os.path.dirname(path)):
        package = ".".join([PACKAGE, *os.path.relpath(folder, _ROOT).split(os.sep)])
        for file in files:
            stem, suffix = os.path.splitext(file)
            if suffix == ".py":
                parts.append(package if stem == "__init__" else f"{package}.{stem}")
    return parts


def _other_files(name: str) -> dict[str, str]:
    """Digests of the files of a folder that is no package, by their path within the package."""
    folder = _path(name)
    if not os.path.isdir(folder):
        raise ModuleNotFoundError(f"no module {name}")
    digests = {}
    for file in sorted(os.listdir(folder)):
        with open(os.path.join(folder, file), "rb") as content:
            digest = blake2b(content.read(), digest_size=16).hexdigest()
        digests["/".join([*name.split(".")[1:], file])] = digest
    return digests


def _path(name: str) -> str:
    return os.path.join(_ROOT, *name.split(".")[1:])


@cache
def _source(name: str) -> str | None:
    base = _path(name)
    for path in (os.path.join(base, "__init__.py"), f"{base}.py"):
        if os.path.isfile(path):
            return path
    return None


def _inside(statements: list[ast.Import | ast.ImportFrom], name: str, is_package: bool) -> Iterator[str]:
    """Modules of this package among those that are imported anywhere, inside functions included."""
    package = name if is_package else name.rpartition(".")[0]
    names: dict[str, None] = {}
    for statement in statements:
        if isinstance(statement, ast.Import):
            names |= dict.fromkeys(alias.name for alias in statement.names)
            continue
        base = statement.module or ""
        if statement.level:
            parent = package.split(".")[: len(package.split(".")) - statement.level + 1]
            base = ".".join([*parent, *([statement.module] if statement.module else [])])
        names |= dict.fromkeys([base, *(f"{base}.{alias.name}" for alias in statement.names)])
    for imported in names:
        if imported.split(".")[0] == PACKAGE and _source(imported) is not None:
            yield imported


def _write(node: ast.AST, code: list[str], imports: list[ast.Import | ast.ImportFrom]) -> None:
    """Append ``node`` to ``code`` as Type(field=value,..), without what is empty and without words.

    Not ``ast.dump``: what it writes of empty and optional fields differs between versions of Python.
    """
    fields = ast.iter_fields(node)
    match node:
        case ast.Import() | ast.ImportFrom():
            imports.append(node)
        case ast.Constant():
            # the letter of u"" is a matter of taste; ascii, for what repr prints follows the Unicode tables
            fields = iter([("value", node.value)])
        case ast.Name() | ast.Attribute() | ast.Subscript() | ast.Starred() | ast.List() | ast.Tuple():
            # whether it is read or written follows from where it stands
            fields = ((field, value) for field, value in fields if field != "ctx")
        case ast.Call():
            fields = iter(_call(node))
        case ast.Assert():
            fields = iter([("test", node.test)])
    code.append(f"{type(node).__name__}(")
    for field, value in fields:
        if (value is None and not isinstance(node, ast.Constant)) or value == [] or field == "type_comment":
            continue
        code.append(f"{field}=")
        if isinstance(value, list):
            code.append("[")
            for item in value:
                if not isinstance(item, ast.AST):  # an absent default or key, a name
                    code.append(ascii(item))
                elif _is_only_words(item):
                    continue
                else:
                    _write(item, code, imports)
                code.append(",")
            code.append("]")
        elif isinstance(value, ast.AST):
            _write(value, code, imports)
        else:
            code.append(ascii(value))
        code.append(",")
    code.append(")")


def _is_only_words(item: ast.AST) -> bool:
    """Whether it is a statement that only people read: a docstring, a line of the log, or ``pass``."""
    if not isinstance(item, ast.Expr):
        return isinstance(item, ast.Pass)
    value = item.value
    return _is_log(value) or (isinstance(value, ast.Constant) and isinstance(value.value, str))


def _call(call: ast.Call) -> list[tuple[str, object]]:
    """The fields of a call without descriptions, messages and what is logged."""
    if _is_log(call):
        return []
    function = _name(call.func)
    arguments = list(call.args)
    if function.endswith(ERRORS):
        arguments = [argument for argument in arguments if not _is_message(argument)]
    elif function == COLUMN:
        description = arguments[DESCRIPTION_OF_COLUMN : DESCRIPTION_OF_COLUMN + 1]
        arguments = [a for a in arguments if not (a in description and _is_text(a))]
    keywords = [
        keyword for keyword in call.keywords if not (keyword.arg in DESCRIPTIONS and _is_text(keyword.value))
    ]
    return [("func", call.func), ("args", arguments), ("keywords", keywords)]


def _is_log(node: ast.AST) -> bool:
    """Whether it is a call like ``log.info(..)``, with nothing inside that the code after it needs."""
    return (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in LEVELS
        and _name(node.func.value) in LOGGERS
        and not any(
            isinstance(n, ast.NamedExpr | ast.Await | ast.Yield | ast.YieldFrom) for n in ast.walk(node)
        )
    )


def _name(node: ast.AST) -> str:
    """The last part of a dotted name."""
    return node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""


def _is_text(node: ast.AST) -> bool:
    """A string, with or without values in it, or several joined with + or %."""
    if isinstance(node, ast.BinOp):
        return _is_text(node.left)
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _is_message(node: ast.AST) -> bool:
    """A text with a space in it. One without is a name or a value, such as a reason in kebab-case."""
    return _is_text(node) and any(
        isinstance(part, ast.Constant) and isinstance(part.value, str) and " " in part.value.strip()
        for part in ast.walk(node)
    )
