"""The code that made a result: a fingerprint of a stage's module and of everything it imports from this package.

Snakemake reruns a rule when its ``params`` change. A fingerprint among them makes an edit of the code such a
change. It excludes layout, comments and docstrings, which cannot change a result. Words in the code, such as the
message of an error, count. So do the installed versions of the imported libraries that compute results.

Each version of a module is parsed once: what counts of it is kept in a file beside the compiled code, under a digest of
its bytes. A digest of the code does not depend on the version of Python.
"""

import ast
import json
from contextlib import suppress
from functools import cache
from hashlib import blake2b
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from p2wss.storage import sources
from p2wss.storage.messages import InputError
from p2wss.storage.sources import PACKAGE

# modules that do not count: their values reach a stage through the parameters, or they only pass paths on
NOT_TRACKED = ("p2wss.config.", "p2wss.storage.provenance.", "p2wss.storage.sources.", "p2wss.cli.")
# another version of these may give other numbers from the same code
LIBRARIES = ("embreex", "manifold3d", "numba", "numpy", "scipy", "shapely", "torch")
# fields of the syntax tree that do not count: where a name stands tells whether it is read or written, and the other
# fields are a matter of style
_NOT_CODE = ("ctx", "kind", "type_comment")

# what counts of a module depends on this file, too
_OF_THIS_FILE = sources.digest(Path(__file__)).hex()
# path within the package of what counts of its modules, by their names
_KEPT = "__pycache__/fingerprints.json"


class Module(NamedTuple):
    """What counts of a module. version: a digest of its source and of this file. digest: of its code. imports: the
    libraries, and the names in this package, that it imports."""

    version: str
    digest: str
    imports: list[str]


@cache
def fingerprint(*stages: str) -> str:
    """Hash of the import closure of the modules ``p2wss.<stage>``: 16 hexadecimal digits.

    A package named in ``stages`` counts with all its modules, an imported package with what its ``__init__`` imports. A
    folder of other files, such as "eval.templates", counts with their contents. Modules of :data:`NOT_TRACKED` count
    only if ``stages`` names them.

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
        elif name not in sources.modules():
            digests |= _other_files(name)
        else:
            kept[name] = _read(name, kept.get(name))
            digests[name] = kept[name].digest
            pending += [each for each in kept[name].imports if each in LIBRARIES or each in sources.modules()]
    if kept != known:
        _keep(kept)
    whole = blake2b(digest_size=8)
    for name in sorted(digests):
        whole.update(f"{name}\n{digests[name]}\n".encode())
    return whole.hexdigest()


def _version(library: str) -> str:
    """The installed version of a library, the same for its CPU and GPU builds; "" if it is not installed."""
    try:
        return metadata.version(library).partition("+")[0]
    except metadata.PackageNotFoundError:
        return ""


def _kept() -> dict[str, Module]:
    """What earlier processes have stored of the modules, whatever their versions."""
    try:
        content = json.loads((sources.ROOT / _KEPT).read_bytes())
        return {name: Module(*values) for name, values in content.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}  # there is none yet, or another version of this file has written it


def _keep(modules: dict[str, Module]) -> None:
    from p2wss.storage.files import write_text  # which imports pyarrow

    with suppress(InputError):  # the package is installed where nothing can be written
        write_text(sources.ROOT / _KEPT, json.dumps(modules))


def _read(name: str, known: Module | None) -> Module:
    """What counts of a module; ``known`` if that is of the present version."""
    version = sources.digest(sources.modules()[name]).hex() + _OF_THIS_FILE
    if known is not None and known.version == version:
        return known
    tree = ast.parse(sources.modules()[name].read_bytes())
    code: list[str] = []
    _write(tree, code)
    return Module(version, blake2b("".join(code).encode(), digest_size=16).hexdigest(), _inside(tree))


def _parts(name: str) -> list[str]:
    """The name of the module; for a package, the names of all its modules."""
    return [each for each in sources.modules() if f"{each}.".startswith(f"{name}.")] or [name]


def _other_files(name: str) -> dict[str, str]:
    """Digests of the files of a folder that is no package, by their path within the package."""
    folder = sources.ROOT.joinpath(*name.split(".")[1:])
    if not folder.is_dir():
        raise ModuleNotFoundError(f"no module {name}")
    return {
        file.relative_to(sources.ROOT).as_posix(): sources.digest(file).hex()
        for file in sorted(folder.iterdir())
    }


def _inside(tree: ast.Module) -> list[str]:
    """Names of libraries and of this package that are imported anywhere, also inside functions: modules, and what is in
    them.

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
    """Append ``node`` to ``code`` as Type(field=value,..), without empty fields and docstrings.

    ``ast.dump`` writes empty and optional fields differently in different versions of Python.
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
