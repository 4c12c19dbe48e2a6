"""The problem that a fit solves, and work arrays, so that evaluating a roof allocates nothing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.fit.settings import Settings
from p2wss.skeleton.compiled import described, stored_tuple
from p2wss.skeleton.kinetic import skeleton_work
from p2wss.skeleton.queries import QueryWork, query_work
from p2wss.skeleton.records import SkeletonWork

_NUM_TRIALS = 4


class Polygon(NamedTuple):
    """A polygon. xy_m: float64 (n, 2), its vertices, exterior first. ring_offset: int64, where each ring begins, and
    n."""

    xy_m: np.ndarray
    ring_offset: np.ndarray


class Prior(NamedTuple):
    """What is assumed of a roof before its points are seen: what each possible roof costs, in metres of loss. An
    empty array assumes nothing.

    class_cost_m: float64 (n, 3), for each edge the cost of 0 degrees, of 90 degrees and of a slope. slope_deg:
    float64 (n,), the expected slope. degree_cost_m: for each degree of difference from it, up to 20. eave_z_m:
    float64 (1,), the expected height. eave_cost: for each metre of difference from it, up to 3.
    """

    class_cost_m: np.ndarray
    slope_deg: np.ndarray
    degree_cost_m: float
    eave_z_m: np.ndarray
    eave_cost: float


NO_PRIOR = Prior(np.zeros((0, 3)), np.zeros(0), 0.0, np.zeros(0), 0.0)


class Context(NamedTuple):
    """What every fit of a roof takes besides its polygon and its points. work_at: address of :class:`FitWork`."""

    work_at: int
    settings: Settings
    prior: Prior


class Problem(NamedTuple):
    """One polygon with its points, as compiled code takes it.

    num_edges, num_rings: of the polygon. x, y, z: float64 (m,), x and y relative to its first vertex.
    direction: int64 (num_edges,), 0 to num_directions - 1; edges that face the same way have the same number and
    share their slope. cap_m: larger residuals count as this. max_roof_height_m: above the eave. inward_m: float64
    (num_edges + 1, m) of a convex polygon, :func:`p2wss.fit.roof.envelope.inward_distances`; otherwise (0, 0).
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
    """Addresses of the functions that compiled code calls by address
    (:func:`p2wss.skeleton.compiled.by_address`); :mod:`p2wss.fit.roof.linkage` fills them in."""

    evaluate: int
    improve: int
    search: int


class FitWork(NamedTuple):
    """Arrays for polygons of up to ``max_edges`` edges with up to ``max_points`` points.

    rise: height of the roof above the eave over each point. slant: z of the unit normal of its face, NaN outside.
    sort_buffer: room for sorting, and for the cost of each point. last_deg: the angles of the last evaluation; tangent,
    cosine: of these. last_count: its number of points, -1 if it failed. group_row: of each direction, its row of the
    equations. group_deg, solution_deg: angles that the least squares give, per direction and
    per edge. excess: what a better roof might gain, per edge. trial: rows of angles, one for each level of nested
    searches. num_evaluations: int64 (1,), roofs evaluated so far. at: the address of ``description``, from which
    compiled code takes everything by ``fit_work_at``.
    """

    skeleton: SkeletonWork
    query: QueryWork
    face: np.ndarray
    distance: np.ndarray
    rise: np.ndarray
    slant: np.ndarray
    residual: np.ndarray
    sort_buffer: np.ndarray
    tangent: np.ndarray
    cosine: np.ndarray
    last_deg: np.ndarray
    last_count: np.ndarray
    group_tangent: np.ndarray
    group_count: np.ndarray
    group_row: np.ndarray
    group_deg: np.ndarray
    matrix: np.ndarray
    right_side: np.ndarray
    solution_deg: np.ndarray
    excess: np.ndarray
    trial: np.ndarray
    num_evaluations: np.ndarray
    code: Code
    at: int
    description: np.ndarray


NO_CODE = Code(*[0] * len(Code._fields))


def fit_work(max_edges: int, max_points: int, code: Code) -> FitWork:
    """Work arrays for one thread; :func:`p2wss.fit.roof.linkage.linked_work` has the addresses."""
    size = max_edges + 2
    work = FitWork(
        skeleton=skeleton_work(max_edges),
        query=query_work(max_edges),
        face=np.zeros(max_points, np.int64),
        distance=np.zeros(max_points),
        rise=np.zeros(max_points),
        slant=np.zeros(max_points),
        residual=np.zeros(max_points),
        sort_buffer=np.zeros(max_points),
        tangent=np.zeros(max_edges),
        cosine=np.ones(max_edges),
        last_deg=np.zeros(max_edges),
        last_count=np.full(1, -1),
        group_tangent=np.zeros(max_edges),
        group_count=np.zeros(max_edges),
        group_row=np.zeros(max_edges, np.int64),
        group_deg=np.zeros(max_edges),
        matrix=np.zeros((size, size)),
        right_side=np.zeros(size),
        solution_deg=np.zeros(max_edges),
        excess=np.zeros(max_edges),
        trial=np.zeros((_NUM_TRIALS, max_edges)),
        num_evaluations=np.zeros(1, np.int64),
        code=code,
        at=0,
        description=np.zeros(0, np.int64),
    )
    description = np.zeros(len(described(work)), np.int64)
    work = work._replace(at=description.ctypes.data, description=description)
    description[:] = described(work)
    return work


fit_work_at = stored_tuple(lambda: fit_work(1, 1, NO_CODE))
