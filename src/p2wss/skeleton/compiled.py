"""How this package compiles: to cached machine code without the GIL, where a division by zero gives
infinity.

numba's cache of a function notices changes in the file of the function only, yet its machine code contains
that of all it calls. So here the names of the cached files carry a digest of all sources of the package, and
of the function's own package where that is another that builds on this one: code of other sources is never
found, not even by processes that run while a file is being edited.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numba.core.caching import FunctionCache, IndexDataCacheFile

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
entry = _compiled()
# called from compiled code only: without the wrappers for Python and without counting references to arrays it
# compiles faster; such a function cannot make arrays
inner = _compiled(no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
# a few lines that numba puts in place of their call
inlined = _compiled(inline="always")
