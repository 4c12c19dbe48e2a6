"""What a fit works on and with: the problem, and work arrays that no evaluation of a roof allocates anew."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.skeleton.kinetic import skeleton_work
from p2wss.skeleton.queries import QueryWork, query_work
from p2wss.skeleton.records import SkeletonWork

_NUM_ROWS = 4


class Settings(NamedTuple):
    """How a roof is sought, as compiled code takes it; :class:`p2wss.fit.one_height.Limits` and ``Effort``
    say what each means."""

    num_search_points: int
    num_points: int
    num_followed: int
    num_descents: int
    max_rounds: int
    flat_top: bool
    cap_m: float
    max_roof_height_m: float
    top_gain_m: float
    class_gain_m: float
    own_slope_gain_m: float
    rounding_m: float


class Prior(NamedTuple):
    """What is believed of a roof before its points: the cost, in metres of loss, of what it may be. Empty
    arrays: nothing.

    class_cost_m: float64 (n, 3), of each edge: 0 degrees, 90 degrees and a slope. slope_deg: float64 (n,), the
    usual one. degree_cost_m: of each degree that a slope is off, up to 20. eave_z_m: float64 (1,). eave_cost: of each
    metre that the eave is off, up to 3.
    """

    class_cost_m: np.ndarray
    slope_deg: np.ndarray
    degree_cost_m: float
    eave_z_m: np.ndarray
    eave_cost: float


NO_PRIOR = Prior(np.zeros((0, 3)), np.zeros(0), 0.0, np.zeros(0), 0.0)


class Problem(NamedTuple):
    """One polygon with its points, as compiled code takes it.

    num_edges, num_rings: of the polygon. x, y, z: float64 (m,), x and y relative to its first vertex.
    direction: int64 (num_edges,), which edges face the same way and so share their slope: 0 to
    num_directions - 1. cap_m: residuals count up to this. max_roof_height_m: above the eave. inward_m: float64
    (num_edges + 1, m) of a convex polygon, :func:`p2wss.fit.envelope.inward_distances`; else (0, 0).
    """

    num_edges: int
    num_rings: int
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    direction: np.ndarray
    num_directions: int
    cap_m: float
    max_roof_height_m: float
    prior: Prior
    inward_m: np.ndarray


class Code(NamedTuple):
    """Where functions begin that compiled code calls by :func:`p2wss.skeleton.compiled.call_at`; of
    :mod:`p2wss.fit.linkage`."""

    evaluate: int
    improve: int
    search: int
    fit_roof: int
    improved_roof: int
    side_of_cut: int
    is_sound: int
    fit_side: int


class FitWork(NamedTuple):
    """Arrays for polygons of up to ``max_edges`` edges with up to ``max_points`` points.

    rise: of the roof above the eave, over each point. cosine: of each edge's slope. trial: rows of angles of nested
    searches. num_evaluations: int64 (1,), counts roofs looked at.
    """

    skeleton: SkeletonWork
    query: QueryWork
    face: np.ndarray
    distance: np.ndarray
    rise: np.ndarray
    residual: np.ndarray
    sorted: np.ndarray
    tangent: np.ndarray
    cosine: np.ndarray
    group_tangent: np.ndarray
    group_count: np.ndarray
    matrix: np.ndarray
    right_side: np.ndarray
    solved: np.ndarray
    excess: np.ndarray
    trial: np.ndarray
    num_evaluations: np.ndarray
    code: Code


def fit_work(max_edges: int, max_points: int, code: Code) -> FitWork:
    """Work arrays for one thread; :func:`p2wss.fit.linkage.linked_work` knows the addresses."""
    size = max_edges + 2
    return FitWork(
        skeleton=skeleton_work(max_edges),
        query=query_work(max_edges),
        face=np.zeros(max_points, np.int64),
        distance=np.zeros(max_points),
        rise=np.zeros(max_points),
        residual=np.zeros(max_points),
        sorted=np.zeros(max_points),
        tangent=np.zeros(max_edges),
        cosine=np.zeros(max_edges),
        group_tangent=np.zeros(max_edges),
        group_count=np.zeros(max_edges),
        matrix=np.zeros((size, size)),
        right_side=np.zeros(size),
        solved=np.zeros(max_edges),
        excess=np.zeros(max_edges),
        trial=np.zeros((_NUM_ROWS, max_edges)),
        num_evaluations=np.zeros(1, np.int64),
        code=code,
    )
