"""The compiled functions that others call by their address, each for one set of types.

numba translates what a function calls once more with each of its callers; a function
that is called by address is translated once. That halves the time that the whole package takes to compile.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from p2wss.fit.roof.search import search
from p2wss.fit.roof.solve import evaluate, improve
from p2wss.fit.roof.work import NO_PRIOR, Code, FitWork, Problem, fit_work
from p2wss.fit.settings import Effort
from p2wss.skeleton.compiled import address_of


def linked_work(max_edges: int, max_points: int) -> FitWork:
    """Work arrays for one thread, with the addresses of the functions."""
    return fit_work(max_edges, max_points, _code())


@cache
def _code() -> Code:
    """The addresses. Callees come before their callers, which are compiled for the types of each callee."""
    row, grid, offset = np.zeros(1), np.zeros((1, 1)), np.zeros(1, np.int64)
    work_at, effort = 1, Effort()
    problem = Problem(1, 1, row, row, row, offset, 1, 1.0, 1.0, NO_PRIOR, grid)
    return Code(
        evaluate=address_of(evaluate, problem, work_at, row, 1.0),
        improve=address_of(improve, problem, work_at, row, 1.0, 1, True, 1.0),
        search=address_of(search, problem, work_at, effort, grid, 1, 1.0),
    )
