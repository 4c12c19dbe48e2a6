"""The library manifold3d, for unions of solids, without threads of its own.

With its first difference of solids, it starts as many threads as there are processors, whatever ``--threads`` says. A
fork of this process does not have these threads, and may wait for them forever.
"""

import os

import manifold3d

__all__ = ["manifold3d"]


def _start_without_threads() -> None:
    """The library counts the processors that it may use once, when it starts."""
    if hasattr(os, "sched_setaffinity"):
        processors = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {min(processors)})
        try:
            cube = manifold3d.Manifold.cube()
            (cube - cube.translate((0.5, 0.5, 0.5))).num_tri()
        finally:
            os.sched_setaffinity(0, processors)


_start_without_threads()
