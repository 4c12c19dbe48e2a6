"""Decorators that compile functions to cached machine code, without the GIL; a division by zero gives infinity.

numba's cache only notices changes in the file of a function, but the machine code of the function contains the code of
everything that it calls. So the names of the cached files carry a digest of the file and of all modules of this package
that it imports. Code from other sources is never loaded, not even by a process that runs while a file is being edited.
"""

from __future__ import annotations

import gc
import logging
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any, ClassVar
from zlib import crc32

import numpy as np
from llvmlite import binding
from llvmlite.binding import ffi
from numba import config, njit
from numba.core import event
from numba.core.caching import (
    FunctionCache,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.environment import Environment
from numba.core.runtime._nrt_python import c_helpers

from p2wss.storage.sources import digest, modules

try:
    import fcntl
except ModuleNotFoundError:  # Windows: two processes may compile the same function
    fcntl: Any = None  # type: ignore[no-redef]

# llvmlite notifies its listeners of every call of LLVM, a hundred and more for each function that is loaded
ffi.lib._lock._cblist.clear()

# a literal number, or a variable that starts as one, makes numba compile the functions it is passed to once more, for
# that constant
ZERO: Any = np.int64(0)
# read as text, since parsing all files takes longer than most commands
_IMPORT = re.compile(r"^from (p2wss[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
_NAME = re.compile(r"\w+")
log = logging.getLogger("p2wss")
# the byte of the lock file for :func:`alone_ahead`, beyond the bytes of all functions
_AHEAD = 1 << 32


@cache
def _digest_of_sources(path: Path) -> str:
    """Digest of a file's source and of the sources of all modules of this package that it imports, directly or not."""
    whole = blake2b(digest_size=6)
    pending, found = [path], {path}
    while pending:
        imported = _imported(pending.pop()) - found
        found |= imported
        pending += imported
    for each in sorted(found):
        whole.update(each.name.encode() + b"\0" + digest(each))
    return whole.hexdigest()


@cache
def _imported(path: Path) -> frozenset[Path]:
    result = set()
    for module, names in _IMPORT.findall(path.read_text(encoding="utf-8")):
        in_module = (f"{module}.{name}" for name in _NAME.findall(names))
        result |= {modules()[each] for each in (module, *in_module) if each in modules()}
    return frozenset(result)


class CacheLocator:
    """Where numba stores the machine code of a function, and how it recognises code from other sources.

    This is the interface of ``NUMBA_CACHE_LOCATOR_CLASSES``. The folders are numba's usual ones.
    """

    def __init__(self, function: Callable, file: str, folder: str) -> None:
        self._py_file = file
        self._folder = Path(folder)
        self._digest = _digest_of_sources(Path(file))
        self._function = f"{Path(file).stem}.{function.__qualname__}".replace("<", "").replace(">", "")
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable, file: str) -> CacheLocator | None:
        """The locator of a function, or None if there is no folder to write to."""
        for usual in (UserProvidedCacheLocator, InTreeCacheLocator, UserWideCacheLocator):
            locator = usual.from_function(function, file)
            if locator is not None:
                return cls(function, file, locator.get_cache_path())
        return None

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        """The part of the file names between the function and the version of Python."""
        return f"{self._line}.{self._digest}"

    def ensure_cache_path(self) -> None:
        """Called before every file that is written: removes the function's files from other sources."""
        self._folder.mkdir(parents=True, exist_ok=True)
        for path in self._folder.glob(f"{self._function}-*.nb[ic]"):
            if f".{self._digest}." not in path.name:
                path.unlink(missing_ok=True)


def cache_folder() -> Path | None:
    """Where the machine code of this package is kept; None: there is no folder to write to."""
    locator = CacheLocator.from_function(cache_folder, __file__)
    return None if locator is None else Path(locator.get_cache_path())


def is_stored(function: Any) -> bool:
    """Whether the cache has machine code of a compiled function of this package."""
    return bool(function._cache.is_stored)


@cache
def _log_once(text: str) -> None:
    log.info(text)


@cache
def _lock_file() -> int:
    folder = cache_folder() or Path()
    folder.mkdir(parents=True, exist_ok=True)
    return os.open(folder / "compiling.lock", os.O_RDWR | os.O_CREAT, 0o666)


@contextmanager
def alone_ahead() -> Iterator[bool]:
    """A block in which one process compiles ahead of what it needs: yields whether no other process is in one."""
    is_alone = True
    try:
        if fcntl is not None:
            fcntl.lockf(_lock_file(), fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _AHEAD)
    except OSError:
        is_alone = False
    try:
        yield is_alone
    finally:
        if fcntl is not None and is_alone:
            fcntl.lockf(_lock_file(), fcntl.LOCK_UN, 1, _AHEAD)


class _Cache:
    """The cache of one function. It is opened when the function is called. It loads machine code without the parts of
    numba that only the compiler needs: these take a tenth of a second and 30 MB, and the compiler loads them itself.

    While a process compiles a function, it locks one byte of a file beside the cache. Others wait and load the result.
    """

    of_all: ClassVar[list[_Cache]] = []

    def __init__(self, function: Callable) -> None:
        self._function = function
        self._byte = crc32(f"{function.__module__}.{function.__qualname__}".encode())
        # the digest of the sources as they are at import, not when the function is called
        _digest_of_sources(Path(function.__code__.co_filename))
        self.of_all.append(self)

    @cached_property
    def _opened(self) -> FunctionCache | None:
        before = config.CACHE_LOCATOR_CLASSES
        config.CACHE_LOCATOR_CLASSES = f"{__name__}.{CacheLocator.__name__}"
        try:
            return FunctionCache(self._function)
        except RuntimeError:  # no folder to write to
            _log_once("each run compiles anew: set NUMBA_CACHE_DIR to a folder that can be written")
            return None
        finally:
            config.CACHE_LOCATOR_CLASSES = before

    @property
    def is_stored(self) -> bool:
        return self._opened is not None and os.path.exists(self._opened._cache_file._index_path)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        # what machine code calls: allocation, for instance
        for name, address in c_helpers.items():
            binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)
        result: Any = self._opened and self._opened._load_overload(sig, target_context)
        if result is None and self._opened:
            self._wait()
            result = self._opened._load_overload(sig, target_context)
            if result is not None:
                self.release()
        bitcode = result and result.library._shared_module
        if bitcode and next(bitcode.functions, None) is None:
            result.library.__class__ = _Alone  # it has names only
        return result

    def _wait(self) -> None:
        """Wait until no other process compiles this function. This process then has the lock, to compile it itself."""
        if fcntl is None:
            return
        try:
            try:
                fcntl.lockf(_lock_file(), fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._byte)
            except (BlockingIOError, PermissionError):
                _log_once("another process compiles for this computer; waiting for it")
                fcntl.lockf(_lock_file(), fcntl.LOCK_EX, 1, self._byte)
        except OSError as error:  # a file system without locks
            log.debug("compiling without a lock: %s", error)

    def release(self) -> None:
        if fcntl is not None and self._opened:
            with suppress(OSError):
                fcntl.lockf(_lock_file(), fcntl.LOCK_UN, 1, self._byte)

    def save_overload(self, sig: Any, data: Any) -> None:
        if self._opened:
            self._opened.save_overload(sig, _ToStore(*data))
            self.release()


def _compiled(**options: Any) -> Callable[[Callable], Any]:
    def decorate(function: Callable) -> Any:
        result = njit(nogil=True, error_model="numpy", **options)(function)
        result._cache = _Cache(function)
        # numba would read the entry points of all installed packages to find extensions. Functions of this package need
        # none; functions of other programs still get theirs
        result._compilation_chain_init_hook = lambda: None
        return result

    return decorate


def _num_stored() -> int:
    return sum(each.is_stored for each in _Cache.of_all)


class _Notice(event.Listener):
    """Logs how many functions of p2wss are compiled, where that takes longer than a few seconds.

    The garbage collector is off meanwhile: searching the objects of the compiler takes a tenth of the time.
    """

    def __init__(self) -> None:
        self._depth, self._collects, self._is_for_ours = 0, False, False
        self._num_done = 0
        self._progress: Any = None

    def on_start(self, compilation: Any) -> None:
        function = compilation.data["dispatcher"]
        is_ours = isinstance(function._cache, _Cache)
        if self._depth == 0:
            self._is_for_ours = is_ours
        elif self._is_for_ours and function.py_func.__module__.startswith("numba."):
            # a function of numba, such as np.sort, which becomes a part of its caller
            function.targetoptions.update(no_cpython_wrapper=True, no_cfunc_wrapper=True)
            function._compiler.pipeline_class = _CompilerAsUsed
        if is_ours:
            from p2wss.storage.progress import Progress

            if self._progress is None:
                title, num_before = "compiling for this computer, once", _num_stored()
                self._progress = Progress(title, len(_Cache.of_all), "functions", num_before)
            # modules may have been imported since
            self._progress.total = len(_Cache.of_all)
        if self._depth == 0:
            # only the compiler needs this module; before the first function, it would load scipy's linear algebra to
            # see whether it is there, but no function here uses that
            from numba.np import linalg

            linalg.ensure_blas = lambda: None
            self._collects = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, compilation: Any) -> None:
        self._depth -= 1
        if self._depth == 0 and self._collects:
            gc.enable()
        function = compilation.data["dispatcher"]._cache
        if isinstance(function, _Cache):
            # not ``is_failed``, which says the opposite up to numba 0.68
            if compilation._exc_details is not None:
                function.release()
            self._num_done += 1
            # other processes may have compiled some, too; without a folder, none is stored
            self._progress.update(max(self._num_done, _num_stored()))


_notice = _Notice()
event.register("numba:compile", _notice)


class _ToStore(CompileResult):
    """What is stored of a function. The environments of its parts are left out if they have no constants: nothing reads
    them, and setting up dozens of them for each function takes a fifth of the time of loading."""

    __slots__ = ()

    def _find_referenced_environments(self) -> list[Environment]:
        return [each for each in super()._find_referenced_environments() if each.consts]


class _Library(JITCodeLibrary):
    def _optimize_functions(self, ll_module: Any) -> None:
        """A little, so that the module is small: what calls it is optimised with all that is linked into it."""
        ll_module.data_layout = self._codegen._data_layout
        passes, builder = self._codegen._function_pass_manager(opt=1)
        for each in ll_module.functions:
            passes.run(each, builder)


class _PartOfCallers(_Library):
    """A function that only compiled code calls. It becomes a part of the machine code of its callers and has none of
    its own, as nobody would use it."""

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Without machine code there is no variable for the environment."""

    def _optimize_final_module(self) -> None:
        """Nothing: it would be done again in every caller, at every level of calls."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        return 0

    def serialize_using_object_code(self) -> tuple:
        return self.serialize_using_bitcode()


class _Alone(_Library):
    """A function that only Python calls. Compiled callers would need its bitcode; in place of that, only the names of
    its functions are stored, as numba asks for no other address. Parsing the bitcode would take half of the time of
    loading, and the names of all constants a third."""

    def _get_module_for_linking(self) -> Any:
        raise TypeError(
            f"{self.name}: decorated with entry, so only for Python; with both it may be called here"
        )

    def serialize_using_object_code(self) -> tuple:
        names = [each.name for each in self._final_module.functions if not each.is_declaration]
        stub = binding.parse_assembly("\n".join(f'@"{name}" = global i8 0' for name in names))
        return self.name, "object", (self._get_compiled_object(), stub.as_bitcode())


class _CompilerAsUsed(Compiler):
    def define_pipelines(self) -> list:
        kind = _PartOfCallers if self.state.flags.no_cpython_wrapper else _Alone
        self.state.library = kind(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        return super().define_pipelines()


# called from Python
entry = _compiled(no_cfunc_wrapper=True, pipeline_class=_CompilerAsUsed)
# called from Python and from compiled code
both = _compiled(no_cfunc_wrapper=True)
# called from compiled code only: compiles faster, without the wrapper for Python
_for_callers: dict[str, Any] = {
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "pipeline_class": _CompilerAsUsed,
}
allocating = _compiled(**_for_callers)
# like ``allocating`` without reference counts of arrays, faster still; such a function cannot create arrays
inner = _compiled(**_for_callers, _nrt=False)
# like ``inner``, but inlined by LLVM: a call would pass seven numbers for each array, and all arrays of a tuple
embedded = _compiled(**_for_callers, _nrt=False, forceinline=True)
# a few lines that numba inserts in place of their call
inlined = _compiled(inline="always")
