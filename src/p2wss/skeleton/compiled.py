"""How this package compiles: to cached machine code without the GIL, where a division by zero gives
infinity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

# a variable that starts as the literal 0 makes numba compile what it is passed to once more, for that
# constant
ZERO: Any = np.int64(0)

# called from Python
entry = njit(cache=True, nogil=True, error_model="numpy")
# called from compiled code only: without the wrappers for Python it compiles much faster
inner = njit(cache=True, nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
# called from one place: becomes part of its caller, because every compiled function optimises all that it
# calls over again
spliced = njit(nogil=True, error_model="numpy", inline="always")
