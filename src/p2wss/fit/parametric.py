"""The paper's building, with one eave height and an angle per edge: fits it to points, and builds its mesh.

Height and slopes are found by iteratively reweighted least squares, for several roofs over one polygon at a time. While
the face over every point stays the same, z = eave + tan(angle) * distance is linear in the unknowns. So each round asks
the kernel for the faces, solves for the unknowns, and keeps the step only if the true loss falls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import shapely

from p2wss import skeleton
from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.fit.directions import edge_ends, turn_between
from p2wss.fit.points import even_order, every_kth
from p2wss.fit.settings import PARAMETRIC, USUAL_SLOPE_DEG, Parametric
from p2wss.mesh import Mesh
from p2wss.mesh.planar import with_exact_faces
from p2wss.skeleton import Polygons, Status, roof_points
from p2wss.skeleton.angles import bearings, slope_angles, tangents
from p2wss.skeleton.types import Meshes

# fewer points show no roof
MIN_NUM_POINTS = 3


@dataclass(frozen=True)
class Problem:
    """A polygon and the points over it.

    polygon: a single one. point_m: (m, 3). direction: int (n,), edges with the same number share their slope.
    degree_cost_m: the cost of each degree by which a slope differs from the usual slope. max_roof_height_m: above the
    eave.
    """

    polygon: Polygons
    point_m: np.ndarray
    direction: np.ndarray
    degree_cost_m: float
    settings: Parametric
    max_roof_height_m: float


@dataclass(frozen=True)
class Roofs:
    """k roofs over the polygon of a problem, and how its m points relate to them.

    angle_deg: (k, n). eave_z_m, loss_m: (k,). edge: int (k, m), the edge of the face over each point, -1 where the face
    is level. rise_m: (k, m), the height of the roof above the eave, NaN outside. residual_m: (k, m), at right angles to
    the face.
    """

    angle_deg: np.ndarray
    eave_z_m: np.ndarray
    loss_m: np.ndarray
    edge: np.ndarray
    rise_m: np.ndarray
    residual_m: np.ndarray

    def of(self, chosen: np.ndarray | slice) -> Roofs:
        """The chosen roofs, by mask, indices or slice."""
        return Roofs(*(getattr(self, each.name)[chosen] for each in fields(self)))

    def best(self) -> Roofs:
        """The roof with the least loss."""
        number = int(np.argmin(self.loss_m))
        return self.of(slice(number, number + 1))

    def where(self, places: np.ndarray, others: Roofs) -> Roofs:
        """These roofs with the roofs ``others`` at ``places``, a mask or indices."""
        result = [getattr(self, each.name).copy() for each in fields(self)]
        for array, each in zip(result, fields(self), strict=True):
            array[places] = getattr(others, each.name)
        return Roofs(*result)


@dataclass(frozen=True)
class FittedRoof:
    """A roof of the kernel over a polygon.

    rings: each (n, 2), exterior first. angle_deg: one per edge, rings in order: 0, 90 or 5 to 75. eave_z_m: height of
    the eaves. loss_m: mean residual of the points, with what slopes cost.
    """

    rings: Sequence[np.ndarray]
    angle_deg: np.ndarray
    eave_z_m: float
    loss_m: float


def fit_roof(
    rings: Sequence[np.ndarray],
    point_m: np.ndarray,
    settings: Parametric = PARAMETRIC,
    max_roof_height_m: float = np.inf,
) -> FittedRoof | None:
    """The best roof over a polygon for the points (m, 3) inside it, with whole degrees where that costs little. There
    is at least one point, and points are in the frame of the rings. None if the kernel refuses the polygon. The result
    does not depend on the order of the points.

    max_roof_height_m: above the eave.

    The loss is never above the loss of a flat roof.
    """
    ordered_m = point_m[even_order(point_m)]
    polygon = Polygons.from_rings([list(rings)])
    direction, axis = edge_groups(rings)
    degree_cost_m = settings.degree_cost_m / len(point_m)
    whole = Problem(polygon, ordered_m, direction, degree_cost_m, settings, max_roof_height_m)
    sample, last = (
        replace(whole, point_m=ordered_m[every_kth(len(ordered_m), count)])
        for count in (settings.num_search_points, settings.num_points)
    )
    starts = improved(sample, evaluate(sample, _starts(axis, settings)), settings.num_start_rounds)
    if not np.isfinite(starts.loss_m).any():
        return None
    found = _descended(sample, starts.best())
    roof = _tidied(
        last, improved(last, evaluate(last, found.angle_deg, found.eave_z_m), settings.num_last_rounds)
    )
    at_end = evaluate(whole, roof.angle_deg, roof.eave_z_m)
    return FittedRoof(rings, at_end.angle_deg[0], float(at_end.eave_z_m[0]), float(at_end.loss_m[0]))


def edge_groups(rings: Sequence[np.ndarray], same_deg: float = 12.0) -> tuple[np.ndarray, np.ndarray]:
    """(direction (n,), axis (n,)) of the edges. Edges that face the same way have the same direction, parallel edges
    the same axis. Number 0 has the greatest total length."""
    edge = np.diff(edge_ends(rings), axis=1)[:, 0]
    bearing_deg = np.degrees(bearings(edge))
    # lengths are compared in whole millimetres, so that rounding errors decide nothing
    length_mm = np.rint(1000.0 * np.hypot(*edge.T))
    groups = []
    for period_deg in (360.0, 180.0):
        group = np.full(len(edge), -1)
        for first in np.argsort(-length_mm, kind="stable"):
            if group[first] < 0:
                is_same = np.abs(turn_between(bearing_deg, bearing_deg[first], period_deg)) < same_deg
                group[is_same & (group < 0)] = group.max() + 1
        rank = np.argsort(np.argsort(-np.bincount(group, length_mm), kind="stable"))
        groups.append(rank[group])
    return groups[0], groups[1]


def _starts(axis: np.ndarray, settings: Parametric) -> np.ndarray:
    """Angles (k, n) of the roofs that a search starts from: a flat one, a hip roof, and gable roofs along the two main
    axes."""
    steep = np.full(len(axis), settings.start_deg)
    gables = [np.where(axis == number, steep, 90.0) for number in range(min(axis.max() + 1, 2))]
    return np.array([np.zeros(len(axis)), steep, *gables])


def _descended(problem: Problem, roof: Roofs) -> Roofs:
    """The roof after changes of single edges and of whole directions. The best change is made, as long as one lowers
    the loss enough."""
    settings = problem.settings
    num_edges = len(problem.direction)
    num_directions = int(problem.direction.max()) + 1
    units = problem.direction == np.arange(num_directions)[:, None]
    if num_edges <= settings.many_edges:
        units = np.vstack([np.eye(num_edges, dtype=bool), units])
    elif num_edges > settings.too_many_edges:
        return roof
    tolerance_m = _class_gain_m(problem)
    while True:
        changed = _changed(roof.angle_deg[0], units, problem.direction, settings)
        trial = improved(problem, evaluate(problem, changed), settings.num_trial_rounds)
        best = trial.best()
        if best.loss_m[0] >= roof.loss_m[0] - tolerance_m:
            return roof
        roof = improved(problem, best, settings.num_last_rounds)


def _class_gain_m(problem: Problem) -> float:
    """The least gain for which an edge changes its class, metres; more with few points."""
    settings = problem.settings
    return settings.class_gain_m * max(1.0, settings.full_num_points / len(problem.point_m))


def _changed(
    angle_deg: np.ndarray, units: np.ndarray, direction: np.ndarray, settings: Parametric
) -> np.ndarray:
    """Angles (k, n) to try: every other class and slope for each set of edges. Edges that face the same way keep a
    common slope."""
    rows = []
    is_slope = (angle_deg > 0.0) & (angle_deg < 90.0)
    for unit in units:
        for angle in settings.tried_deg:
            row = np.where(unit, angle, angle_deg)
            if 0.0 < angle < 90.0:
                row = np.where(is_slope & np.isin(direction, direction[unit]), angle, row)
            rows.append(row)
    different = np.unique(rows, axis=0)
    return different[(np.abs(different - angle_deg) > settings.same_slope_deg).any(axis=1)]


def _tidied(problem: Problem, roof: Roofs) -> Roofs:
    """The roof with whole degrees where that costs little; a flat roof if that is about as good."""
    settings, n = problem.settings, len(problem.direction)
    tolerance_m = _class_gain_m(problem)
    flat = improved(problem, evaluate(problem, np.zeros((1, n))), settings.num_last_rounds)
    if flat.loss_m[0] <= roof.loss_m[0] + tolerance_m:
        return flat
    if n <= settings.many_edges:
        apart = replace(problem, direction=np.arange(n))
        separate = _descended(apart, improved(apart, roof, settings.num_last_rounds))
        if separate.loss_m[0] < roof.loss_m[0] - max(tolerance_m, settings.separate_slope_gain_m):
            problem, roof = apart, separate
    for number in range(int(problem.direction.max()) + 1):
        # At the end of a gable roof hardly any point distinguishes a steep face from a vertical one, and returns from
        # a wall that stands back below its eave look like a steep face.
        angle_deg = roof.angle_deg[0]
        is_steep = (
            (problem.direction == number) & (angle_deg > settings.nearly_gable_deg) & (angle_deg < 90.0)
        )
        if is_steep.any():
            on = np.isin(roof.edge[0], np.flatnonzero(is_steep))
            depth_m = np.max(roof.rise_m[0, on], initial=0.0) / tangents(angle_deg[is_steep].max())
            gables = evaluate(problem, np.where(is_steep, 90.0, roof.angle_deg), roof.eave_z_m)
            gables = improved(problem, gables, settings.num_trial_rounds)
            most_m = settings.wall_hits_m if depth_m < settings.min_slope_width_m else settings.rounding_m
            if gables.loss_m[0] <= roof.loss_m[0] + max(tolerance_m, most_m):
                roof = gables
    whole = evaluate(problem, np.rint(roof.angle_deg), roof.eave_z_m)
    whole = improved(problem, whole, settings.num_trial_rounds, only_eaves=True)
    return whole if whole.loss_m[0] <= roof.loss_m[0] + settings.rounding_m else roof


def evaluate(problem: Problem, angle_deg: np.ndarray, eave_z_m: np.ndarray | None = None) -> Roofs:
    """The roofs of angles (k, n) and eaves (k,). By default, half of the points are above a roof and half below.

    The loss is the mean distance of the points from the roof, each at most ``cap_m``, plus the cost of unusual slopes.
    It is infinite where the kernel refuses the roof.
    """
    (k, n), m, settings = angle_deg.shape, len(problem.point_m), problem.settings
    one = problem.polygon
    polygons = Polygons(
        np.tile(one.xy_m, (k, 1)),
        np.append((n * np.arange(k)[:, None] + one.ring_offset[:-1]).ravel(), k * n),
        np.arange(k + 1) * (len(one.ring_offset) - 1),
    )
    over = roof_points(
        polygons,
        angle_deg.ravel(),
        0.0,
        np.tile(problem.point_m[:, :2], (k, 1)),
        np.repeat(np.arange(k), m),
        max_roof_height_m=problem.max_roof_height_m,
    )
    rise_m, edge = over.z_m.reshape(k, m), over.edge.reshape(k, m)
    above_m = problem.point_m[:, 2] - rise_m
    if eave_z_m is None:
        eave_z_m = np.nan_to_num(
            [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in above_m]
        )
    residual_m = (eave_z_m[:, None] - above_m) * _cosine(angle_deg, edge)
    loss_m = np.fmin(np.abs(residual_m), settings.cap_m).mean(axis=1)
    off_deg = np.minimum(np.abs(angle_deg - USUAL_SLOPE_DEG), settings.max_off_deg)
    is_slope = (angle_deg > 0.0) & (angle_deg < 90.0)
    loss_m = loss_m + np.where(is_slope, problem.degree_cost_m * off_deg, 0.0).sum(axis=1)
    loss_m = np.where(over.status == Status.OK, loss_m, np.inf)
    return Roofs(angle_deg, eave_z_m, loss_m, edge, rise_m, residual_m)


def _cosine(angle_deg: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """(k, m): the cosine of the slope of the face over each point."""
    slope_deg = np.take_along_axis(angle_deg, np.maximum(edge, 0), axis=1)
    return np.where(edge >= 0, np.cos(np.radians(slope_deg)), 1.0)


def improved(problem: Problem, roofs: Roofs, num_rounds: int, only_eaves: bool = False) -> Roofs:
    """The roofs after up to ``num_rounds`` rounds of least squares, none of them worse. only_eaves: slopes stay."""
    settings = problem.settings
    active = np.isfinite(roofs.loss_m)
    for _ in range(num_rounds):
        if not active.any():
            break
        before = roofs.of(active)
        angle_deg, eave_z_m = _least_squares(problem, before, only_eaves)
        done, pending = before, np.ones(len(before.loss_m), bool)
        for step in settings.steps:
            trial = evaluate(
                problem,
                before.angle_deg[pending] + step * (angle_deg - before.angle_deg)[pending],
                before.eave_z_m[pending] + step * (eave_z_m - before.eave_z_m)[pending],
            )
            is_better = trial.loss_m < before.loss_m[pending] - settings.min_step_gain_m
            place = np.flatnonzero(pending)[is_better]
            done = done.where(place, trial.of(is_better))
            pending[place] = False
            if not pending.any():
                break
        roofs = roofs.where(active, done)
        active[active] = before.loss_m - done.loss_m >= settings.min_round_gain_m
    return roofs


def _least_squares(problem: Problem, roofs: Roofs, only_eaves: bool) -> tuple[np.ndarray, np.ndarray]:
    """Angles (k, n) and eaves (k,) that fit the points best if each point keeps its face. Points are weighted by the
    inverse of their residuals."""
    settings = problem.settings
    angle_deg, edge = roofs.angle_deg, roofs.edge
    k, m = edge.shape
    is_slope = (angle_deg > 0.0) & (angle_deg < 90.0)
    tangent = np.where(is_slope, tangents(angle_deg), 0.0)
    of_face = np.take_along_axis(tangent, np.maximum(edge, 0), axis=1)
    distance_m = np.where(edge >= 0, roofs.rise_m, 0.0) / np.where(edge >= 0, of_face, 1.0)
    # points outside have a residual of NaN
    size_m = np.abs(roofs.residual_m)
    weight = _cosine(angle_deg, edge) ** 2 / np.maximum(size_m, settings.noise_m)
    weight = np.where(size_m <= settings.reach_m, weight, 0.0)
    # one unknown is the eave, the others are the tangents of the directions
    num_slopes = 0 if only_eaves else int(problem.direction.max()) + 1
    in_direction = problem.direction == np.arange(num_slopes)[:, None]
    matrix = np.ones((k, m, 1 + num_slopes))
    of_point = in_direction[:, np.maximum(edge, 0)].transpose(1, 2, 0) & (edge >= 0)[:, :, None]
    matrix[:, :, 1:] = of_point * distance_m[:, :, None]
    fixed_m = roofs.rise_m if only_eaves else np.where(edge >= 0, 0.0, roofs.rise_m)
    right_m = problem.point_m[:, 2] - np.nan_to_num(fixed_m)
    transposed = (matrix * weight[:, :, None]).transpose(0, 2, 1)
    square, right = transposed @ matrix, (transposed @ right_m[:, :, None])[:, :, 0]
    diagonal = np.arange(1 + num_slopes)
    # a small weight of the present values keeps a step small where the points determine nothing
    count = is_slope @ in_direction.T
    mean = (tangent @ in_direction.T) / np.maximum(count, 1)
    keep = np.column_stack([np.full(k, settings.keep_eave), np.full((k, num_slopes), settings.keep_slope)])
    square[:, diagonal, diagonal] += keep
    right += keep * np.column_stack([roofs.eave_z_m, mean])
    per_tangent = 1.0 / np.radians(1.0 + tangent**2)
    off_deg = np.maximum(np.abs(angle_deg - USUAL_SLOPE_DEG), settings.least_deg)
    slope_weight = np.where(is_slope, m * problem.degree_cost_m * per_tangent**2 / off_deg, 0.0)
    square[:, diagonal[1:], diagonal[1:]] += slope_weight @ in_direction.T
    right[:, 1:] += (slope_weight * tangents(np.array(USUAL_SLOPE_DEG))) @ in_direction.T
    solution = np.linalg.solve(square, right[:, :, None])[:, :, 0]
    if only_eaves:
        return angle_deg, solution[:, 0]
    slope_deg = np.clip(slope_angles(solution[:, 1:]), *settings.slopes_deg)
    return np.where(is_slope, slope_deg[:, problem.direction], angle_deg), solution[:, 0]


def simplify_exterior(rings: Sequence[np.ndarray], max_num_vertices: int) -> list[np.ndarray]:
    """The rings with at most ``max_num_vertices`` vertices in the exterior, by the Douglas-Peucker algorithm with a
    growing tolerance.

    Courtyards stay as they are. An exterior that keeps more vertices at any tolerance becomes its smallest enclosing
    rectangle.
    """
    exterior = shapely.Polygon(rings[0])
    simple: Any = exterior
    tolerance = 0.05
    size = float(np.hypot(*np.subtract(exterior.bounds[2:], exterior.bounds[:2])))
    while _num_vertices(simple) > max_num_vertices and tolerance < size:
        simple = exterior.simplify(tolerance, preserve_topology=True)
        tolerance *= 1.25
    if _num_vertices(simple) > max_num_vertices:
        simple = exterior.minimum_rotated_rectangle
    if simple is exterior:
        return list(rings)
    exterior = shapely.orient_polygons(simple, exterior_cw=False).exterior
    return [shapely.get_coordinates(exterior)[:-1], *rings[1:]]


def kernel_angles(angle_deg: np.ndarray) -> np.ndarray:
    """The nearest angles that the kernel takes: 0, 90, or 5 to 85 degrees.

    >>> kernel_angles(np.array([2.0, 4.0, 35.0, 86.0, 99.0]))
    array([ 0.,  5., 35., 85., 90.])
    """
    angle = np.clip(np.asarray(angle_deg, float), 0, 90)
    lowest, steepest = 5.0, 85.0
    angle = np.where(angle < lowest / 2, 0.0, np.where(angle < lowest, lowest, angle))
    return np.where(angle > (steepest + 90) / 2, 90.0, np.where(angle > steepest, steepest, angle))


def transfer_angles(
    source_rings: Sequence[np.ndarray], angle_deg: np.ndarray, target_rings: Sequence[np.ndarray]
) -> np.ndarray:
    """Angles (a value or a row per edge) of ``source_rings`` for the edges of ``target_rings``, which describe the same
    building with more or fewer vertices.

    Each target edge takes the angle of the source edge nearest to its midpoint among those that face within 45
    degrees of its direction or, if there is none, among all.
    """
    if len(source_rings) == len(target_rings) and all(map(np.array_equal, source_rings, target_rings)):
        return np.asarray(angle_deg, float)
    start, end = np.moveaxis(edge_ends(source_rings), 1, 0)
    target_start, target_end = np.moveaxis(edge_ends(target_rings), 1, 0)
    midpoint = (target_start + target_end) / 2
    along = end - start
    length = np.linalg.norm(along, axis=1)
    share = np.einsum("wkd,kd->wk", midpoint[:, None] - start, along) / length**2
    foot = start + np.clip(share, 0, 1)[..., None] * along
    distance = np.linalg.norm(midpoint[:, None] - foot, axis=2)
    direction = target_end - target_start
    cosine = (direction @ along.T) / (np.linalg.norm(direction, axis=1)[:, None] * length)
    facing = cosine >= np.sqrt(0.5)
    cost = np.where(facing, distance, distance + distance.max(initial=0) + 1)
    return np.asarray(angle_deg, float)[cost.argmin(axis=1)]


def build_meshes(
    buildings: Sequence[Building],
    rings: Sequence[Sequence[np.ndarray]],
    eave_height_m: np.ndarray,
    angle_deg: Sequence[np.ndarray],
    method: str,
    config: Reconstruct,
    status: Sequence[str],
) -> list[Reconstruction]:
    """Meshes through the kernel, which checks each. A building without a finite height has none.

    rings, eave_height_m (b,), angle_deg: one per building. status: why a building without a height has no mesh.
    """
    result = [no_mesh(b, method, reason) for b, reason in zip(buildings, status, strict=True)]
    ground_z_m = [building.ground_z_m for building in buildings]
    usable = np.flatnonzero(np.isfinite(eave_height_m) & np.isfinite(ground_z_m)).tolist()
    if not usable:
        return result
    meshes: Meshes = skeleton.build(
        Polygons.from_rings([list(rings[i]) for i in usable]),
        np.concatenate([angle_deg[i] for i in usable]),
        eave_height_m[usable],
        max_roof_height_m=config.max_roof_height_m,
    )
    for k, i in enumerate(usable):
        code = skeleton.Status(int(meshes.status[k]))
        result[i] = Reconstruction(
            buildings[i].building_id,
            buildings[i].tile,
            method,
            reasons.OK if code == skeleton.Status.OK else code.reason,
            buildings[i].origin_xy_m,
            buildings[i].ground_z_m,
            rings[i],
            float(eave_height_m[i]),
            angle_deg[i],
            with_exact_faces(Mesh.of_kernel(meshes, k)) if code == skeleton.Status.OK else None,
        )
    return result


def kernel_mesh(
    rings: Sequence[np.ndarray], angle_deg: np.ndarray, eave_height_m: float, max_roof_height_m: float
) -> Mesh | None:
    """The kernel's building over a polygon; None if the kernel refuses it."""
    polygons = Polygons.from_rings([list(rings)])
    meshes = skeleton.build(
        polygons, angle_deg, np.array([eave_height_m]), max_roof_height_m=max_roof_height_m
    )
    return with_exact_faces(Mesh.of_kernel(meshes, 0)) if meshes.status[0] == skeleton.Status.OK else None


def _num_vertices(polygon: shapely.Polygon) -> int:
    return len(polygon.exterior.coords) - 1
