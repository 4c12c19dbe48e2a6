"""The code that made a result: a fingerprint of a stage's module and of everything it imports from this package.

Snakemake reruns a rule when its ``params`` change. A fingerprint among them makes an edit of the code such a
change. It excludes layout, comments and docstrings, which cannot change a result. Words in the code, such as the
message of an error, count. So do the installed versions of the imported libraries that compute results.

Each version of a module is parsed once: what counts of it is kept in a file beside the compiled code, under a digest of
its bytes. A digest of the code does not depend on the version of Python.
"""

from __future__ import annotations

import ast
import json
from contextlib import suppress
from functools import cache
from hashlib import blake2b
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from p2wss.storage.errors import InputError

PACKAGE = "p2wss"
# their values reach a stage through the parameters, or they only pass paths on
NOT_TRACKED = ("p2wss.config.", "p2wss.storage.provenance.", "p2wss.cli.")
# another version of these may give other numbers from the same code
LIBRARIES = ("embreex", "manifold3d", "numba", "numpy", "scipy", "shapely", "torch")
# of the syntax tree: whether a name is read or written follows from where it stands, and the rest is a matter of taste
_NOT_CODE = ("ctx", "kind", "type_comment")

_THIS_FILE = Path(__file__).read_bytes()
_ROOT = Path(__file__).resolve().parents[1]
# below the package: what counts of its modules, by their names
_KEPT = "__pycache__/fingerprints.json"


class Module(NamedTuple):
    """What counts of a module: a digest of its code, and the libraries and names in this package that it imports.
    version: a digest of its source and of this file."""

    version: str
    digest: str
    imports: list[str]


@cache
def fingerprint(*stages: str) -> str:
    """Hash of the import closure of the modules ``p2wss.<stage>``: 16 hexadecimal digits.

    A package named here counts with all its modules, one that is imported with what its ``__init__`` imports.
    A folder of other files, such as "eval.templates", counts with their contents. Of :data:`NOT_TRACKED`, only what
    is named here counts.

    Raises ``ModuleNotFoundError`` for a stage that is not in the package.
    """
    digests: dict[str, str] = {}
    kept = _kept()
    known = dict(kept)
    named = {part for stage in stages for part in _parts(f"{PACKAGE}.{stage}")}
    pending = sorted(named)
    while pending:
        name = pending.pop()
        # the package itself is the public interface, which calls the stages and is called by none
        is_tracked = name in named or (name != PACKAGE and not f"{name}.".startswith(NOT_TRACKED))
        if name in digests or not is_tracked:
            continue
        if name in LIBRARIES:
            digests[name] = _version(name)
        elif _source(name) is None:
            digests |= _other_files(name)
        else:
            kept[name] = _read(name, kept.get(name))
            digests[name] = kept[name].digest
            pending += [each for each in kept[name].imports if each in LIBRARIES or _source(each) is not None]
    if kept != known:
        _keep(kept)
    digest = blake2b(digest_size=8)
    for name in sorted(digests):
        digest.update(f"{name}\n{digests[name]}\n".encode())
    return digest.hexdigest()


def _version(library: str) -> str:
    """The version that is installed, the same for CPUs and GPUs; "" without the extra that needs the library."""
    try:
        return metadata.version(library).partition("+")[0]
    except metadata.PackageNotFoundError:
        return ""


def _kept() -> dict[str, Module]:
    """What earlier processes have read, of any version of the modules."""
    try:
        content = json.loads((_ROOT / _KEPT).read_bytes())
        return {name: Module(*values) for name, values in content.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}  # there is none yet, or another version of this file has written it


def _keep(modules: dict[str, Module]) -> None:
    from p2wss.storage.files import write_text  # which imports pyarrow

    with suppress(InputError):  # the package is installed where nothing can be written
        write_text(_ROOT / _KEPT, json.dumps(modules))


def _read(name: str, known: Module | None) -> Module:
    """What counts of a module; ``known`` if that is of the present version."""
    path = _source(name)
    assert path is not None
    source = path.read_bytes()
    version = blake2b(source + _THIS_FILE, digest_size=16).hexdigest()
    if known is not None and known.version == version:
        return known
    tree = ast.parse(source)
    code: list[str] = []
    _write(tree, code)
    digest = blake2b("".join(code).encode(), digest_size=16).hexdigest()
    return Module(version, digest, _inside(tree))


def _parts(name: str) -> list[str]:
    """The module, and if it is a package its modules."""
    path = _source(name)
    if path is None or path.name != "__init__.py":
        return [name]
    modules = (file.relative_to(_ROOT).with_suffix("") for file in path.parent.rglob("*.py"))
    return [".".join([PACKAGE, *module.parts]).removesuffix(".__init__") for module in modules]


def _other_files(name: str) -> dict[str, str]:
    """Digests of the files of a folder that is no package, by their path within the package."""
    folder = _path(name)
    if not folder.is_dir():
        raise ModuleNotFoundError(f"no module {name}")
    return {
        file.relative_to(_ROOT).as_posix(): blake2b(file.read_bytes(), digest_size=16).hexdigest()
        for file in sorted(folder.iterdir())
    }


def _path(name: str) -> Path:
    return _ROOT.joinpath(*name.split(".")[1:])


@cache
def _source(name: str) -> Path | None:
    base = _path(name)
    candidates = base / "__init__.py", base.with_name(f"{base.name}.py")
    return next((path for path in candidates if path.is_file()), None)


def _inside(tree: ast.Module) -> list[str]:
    """Libraries, and names in this package, that are imported anywhere, inside functions included: modules, and what
    is in them.

    All imports are absolute.
    """
    names: dict[str, None] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= dict.fromkeys(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= dict.fromkeys([node.module, *(f"{node.module}.{alias.name}" for alias in node.names)])
    libraries = {name.split(".")[0] for name in names}.intersection(LIBRARIES)
    return [*sorted(libraries), *(name for name in names if name.split(".")[0] == PACKAGE)]


def _write(node: object, code: list[str]) -> None:
    """Append ``node`` to ``code`` as Type(field=value,..), without what is empty and without docstrings.

    Not ``ast.dump``: what it writes of empty and optional fields differs between versions of Python.
    """
    if isinstance(node, list):
        for item in node:
            if not _is_docstring(item):
                _write(item, code)
                code.append(",")
    elif isinstance(node, ast.AST):
        code.append(f"{type(node).__name__}(")
        for field, value in ast.iter_fields(node):
            is_empty = value == [] or (value is None and not isinstance(node, ast.Constant))
            if field not in _NOT_CODE and not is_empty:
                code.append(f"{field}=[")
                _write(value, code)
                code.append("]")
        code.append(")")
    else:
        code.append(ascii(node))  # what repr prints follows the Unicode tables


def _is_docstring(item: object) -> bool:
    return (
        isinstance(item, ast.Expr)
        and isinstance(item.value, ast.Constant)
        and isinstance(item.value.value, str)
    )
