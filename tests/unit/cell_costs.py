"""Costs of cells in tests of the search for planes."""

from __future__ import annotations

import numpy as np

from p2wss.fit.planes.costs import Costs, problem_of
from p2wss.fit.settings import PlanePrices


def all_costs(
    cell_m3: np.ndarray,
    pair: np.ndarray,
    length_m: np.ndarray,
    prices: PlanePrices,
    line: np.ndarray | None = None,
    plane: np.ndarray | None = None,
    end_m: np.ndarray | None = None,
    num_known: int = 0,
) -> Costs:
    """Costs of cells that may have every plane, (c, k); with a line for each side, and level planes 10 m apart, unless
    others are given."""
    num_cells, num_planes = cell_m3.shape
    problem = problem_of(
        np.arange(num_cells + 1) * num_planes,
        np.tile(np.arange(num_planes), num_cells),
        np.array(cell_m3, float).ravel(),
        pair,
        np.arange(len(pair)) if line is None else line,
        length_m,
        np.zeros((len(pair), 2, 2)) if end_m is None else end_m,
        np.array([[0.0, 0.0, 10.0 * k] for k in range(num_planes)]) if plane is None else plane,
        np.arange(num_planes) >= num_planes - num_known,
    )
    return Costs(problem, prices, np.zeros((num_cells, 2)))
