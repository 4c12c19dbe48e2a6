"""How this package compiles: to cached machine code without the GIL, where a division by zero gives
infinity.

numba's cache of a function notices changes in the file of the function only, yet its machine code contains
that of all it calls. So here the names of the cached files carry a digest of all sources of the package, and
of the function's own package where that is another that builds on this one: code of other sources is never
found, not even by processes that run while a file is being edited.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit, typeof
from numba.core import cgutils
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.errors import TypingError
from numba.core.typing import signature
from numba.extending import intrinsic

# a variable that starts as the literal 0 makes numba compile what it is passed to once more, for that
# constant
ZERO: Any = np.int64(0)


@cache
def _digest_of_sources(folder: Path) -> str:
    """Of this package and of the one in ``folder``."""
    digest = blake2b(digest_size=6)
    for path in sorted({*Path(__file__).parent.glob("*.py"), *folder.glob("*.py")}):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


class _PackageCacheFile(IndexDataCacheFile):
    """The cached files of one function; the first new one removes those of other sources."""

    def __init__(self, folder: str, base: str, digest: str):
        super().__init__(folder, f"{base}.{digest}", digest)
        self._folder, self._function, self._digest = Path(folder), base.rpartition("-")[0], digest

    def save(self, key: object, data: object) -> None:
        super().save(key, data)
        for path in self._folder.glob(f"{self._function}-*.nb[ic]"):
            if f".{self._digest}." not in path.name:
                path.unlink(missing_ok=True)


class _PackageCache(FunctionCache):
    def __init__(self, function: Callable):
        super().__init__(function)
        digest = _digest_of_sources(Path(function.__code__.co_filename).parent)
        self._cache_file = _PackageCacheFile(self._cache_path, self._impl.filename_base, digest)


def _compiled(**options: Any) -> Callable[[Callable], Any]:
    def decorate(function: Callable) -> Any:
        dispatcher = njit(nogil=True, error_model="numpy", **options)(function)
        try:
            dispatcher._cache = _PackageCache(function)
        except RuntimeError:  # no folder to write to: compiled anew in each process
            return dispatcher
        return dispatcher

    return decorate


# called from Python
entry = _compiled(no_cfunc_wrapper=True)
# called from compiled code only: without the wrapper for Python it compiles faster
allocating = _compiled(no_cpython_wrapper=True, no_cfunc_wrapper=True)
# and without counting references to arrays faster still; such a function cannot make arrays
inner = _compiled(no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
# a few lines that numba puts in place of their call
inlined = _compiled(inline="always")


# of what is called by address: the types of its arguments
_argument_types: dict[Any, tuple] = {}


def address_of(function: Any, *examples: Any) -> int:
    """Where the machine code of a compiled function begins, for arguments of the types of ``examples``: those
    that :func:`by_address` calls it with. It is compiled or loaded if need be."""
    argument_types = _argument_types.setdefault(function, tuple(map(typeof, examples)))
    if argument_types not in function.overloads:
        function.compile(argument_types)
    result = function.overloads[argument_types]
    return result.library.get_pointer_to_function(result.fndesc.llvm_func_name)


def by_address(function: Any) -> Any:
    """A function for compiled code: ``made(code, *arguments)`` calls ``function(*arguments)`` at its
    :func:`address_of`, which is in the named tuple ``code`` under the name of the function.

    What numba compiles contains all that it calls, however deep, optimised and translated anew. A large function
    with several callers is therefore better called by address: then it is translated once.
    """
    name = function.py_func.__name__

    def define(typing_context: Any, code: Any, *arguments: Any) -> Any:
        called = function.overloads[_argument_types[function]].signature
        for given, wanted in zip(arguments, called.args, strict=True):
            if typing_context.can_convert(given, wanted) is None:
                raise TypingError(f"{name} is called by address with {given} in place of {wanted}")

        def generate(context: Any, builder: Any, _: Any, values: Any) -> Any:
            convention = context.call_conv
            pointer_type = convention.get_function_type(called.return_type, called.args).as_pointer()
            address = builder.extract_value(values[0], code.fields.index(name))
            status, result = convention.call_function(
                builder, builder.inttoptr(address, pointer_type), called.return_type, called.args, values[1:]
            )
            with cgutils.if_unlikely(builder, status.is_error):
                convention.return_status_propagate(builder, status)
            return result

        return signature(called.return_type, code, *called.args), generate

    # as many parameters as there are: numba would pack *arguments into one tuple, which takes long to compile
    names = ["typing_context", "code", *inspect.signature(function.py_func).parameters]
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    define.__signature__ = inspect.Signature([inspect.Parameter(each, kind) for each in names])  # type: ignore
    return intrinsic(define)
