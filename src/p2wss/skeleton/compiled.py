"""How this package compiles: to cached machine code without the GIL, where a division by zero gives
infinity.

numba's cache of a function notices changes in the file of the function only, yet its machine code contains
that of all it calls. So here the names of the cached files carry a digest of all sources of the package, and
of the function's own package where that is another that builds on this one: code of other sources is never
found, not even by processes that run while a file is being edited.
"""

from __future__ import annotations

import gc
import inspect
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numba import config, njit, typeof
from numba.core import cgutils, event
from numba.core.caching import InTreeCacheLocator, UserProvidedCacheLocator, UserWideCacheLocator
from numba.core.errors import TypingError
from numba.core.typing import signature
from numba.extending import intrinsic

# a variable that starts as the literal 0 makes numba compile what it is passed to once more, for that
# constant
ZERO: Any = np.int64(0)
log = logging.getLogger("p2wss")


@cache
def _digest_of_sources(folder: Path) -> str:
    """Of this package and of the one in ``folder``."""
    digest = blake2b(digest_size=6)
    for path in sorted({*Path(__file__).parent.glob("*.py"), *folder.glob("*.py")}):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


class CacheLocator:
    """Where numba keeps the machine code of a function and how it tells that of other sources: the interface that
    ``NUMBA_CACHE_LOCATOR_CLASSES`` asks for. The folders are numba's usual ones."""

    def __init__(self, function: Callable, file: str, folder: str) -> None:
        self._py_file = file
        self._folder = Path(folder)
        self._digest = _digest_of_sources(Path(file).parent)
        self._function = f"{Path(file).stem}.{function.__qualname__}".replace("<", "").replace(">", "")
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable, file: str) -> CacheLocator | None:
        """None: there is no folder to write to."""
        for usual in (UserProvidedCacheLocator, InTreeCacheLocator, UserWideCacheLocator):
            found = usual.from_function(function, file)
            if found is not None:
                return cls(function, file, found.get_cache_path())
        return None

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        """Part of the names of the files, between the function and the version of Python."""
        return f"{self._line}.{self._digest}"

    def ensure_cache_path(self) -> None:
        """Called before every file that is written: those of other sources go."""
        self._folder.mkdir(parents=True, exist_ok=True)
        for path in self._folder.glob(f"{self._function}-*.nb[ic]"):
            if f".{self._digest}." not in path.name:
                path.unlink(missing_ok=True)


def cache_folder() -> Path | None:
    """Where the machine code of this package is kept; None: there is no folder to write to."""
    locator = CacheLocator.from_function(cache_folder, __file__)
    return None if locator is None else Path(locator.get_cache_path())


@contextmanager
def _our_locator() -> Iterator[None]:
    before = config.CACHE_LOCATOR_CLASSES
    config.CACHE_LOCATOR_CLASSES = f"{__name__}.{CacheLocator.__name__}"
    try:
        yield
    finally:
        config.CACHE_LOCATOR_CLASSES = before


def _compiled(**options: Any) -> Callable[[Callable], Any]:
    def decorate(function: Callable) -> Any:
        common = {"nogil": True, "error_model": "numpy", **options}
        with _our_locator():
            try:
                return njit(cache=True, **common)(function)
            except RuntimeError:  # no folder to write to: compiled anew in each process
                _notice.is_cached = False
                return njit(**common)(function)

    return decorate


_ONCE = "once, up to a minute; p2wss warm-up does it ahead"
_EACH_TIME = "up to a minute, every time: set NUMBA_CACHE_DIR to a folder that can be written"


class _Notice(event.Listener):
    """Tells, once in a process, that functions of p2wss are compiled: it takes up to a minute without a word.

    The garbage collector rests meanwhile: looking through all that a compiler holds takes a tenth of the time.
    """

    def __init__(self) -> None:
        self.told, self.is_cached = False, True
        self._depth, self._collects = 0, False

    def on_start(self, begun: Any) -> None:
        if not self.told and begun.data["dispatcher"].py_func.__module__.partition(".")[0] == "p2wss":
            self.told = True
            log.info("compiling for this computer (%s)", _ONCE if self.is_cached else _EACH_TIME)
        if self._depth == 0:
            self._collects = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, ended: Any) -> None:
        self._depth -= 1
        if self._depth == 0 and self._collects:
            gc.enable()


_notice = _Notice()
event.register("numba:compile", _notice)


def expect_compilation() -> None:
    """This process compiles on purpose: no word of it."""
    _notice.told = True


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
