"""Buildings fitted to their points, starting from the network's reconstructions or from nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.data.points import MIN_CLASSIFIED_POINTS
from p2wss.fit.boxes.chimneys import with_chimneys
from p2wss.fit.boxes.dormers import Box, find_boxes, is_over_boxes
from p2wss.fit.boxes.open_ground import OpenGround
from p2wss.fit.mesh.adjustment import adjusted
from p2wss.fit.mesh.parametric import kernel_mesh, transfer_angles
from p2wss.fit.mesh.short_edges import without_short_edges
from p2wss.fit.mesh.union import is_sound, simplified, union
from p2wss.fit.parts.frame import roof_frame
from p2wss.fit.parts.partition import fit_parts
from p2wss.fit.parts.parts import total_cost_m
from p2wss.fit.parts.roofs import Roof
from p2wss.fit.planes.fit import fit_planes
from p2wss.fit.points import ground_points, roof_points, wall_hits
from p2wss.fit.roof.confidence import expected_share
from p2wss.fit.roof.fitter import MIN_NUM_POINTS, FittedRoof, Fitter
from p2wss.fit.roof.prior import make_prior
from p2wss.fit.roof_edges import move_walls
from p2wss.fit.settings import THRESHOLDS, Thresholds
from p2wss.mesh import Mesh

METHOD = "fit"
# points of class ground this far inside the footprint show that no building is there
_GROUND_INSIDE_M = 0.5
# with fewer points on the roof, the parametric model knows more than planes in them show
_MIN_PLANE_POINTS = 40
# Where one roof that was searched from the network's values leaves the points further off than this on average, the
# building is also searched without them: the network knows one height only, and there may be parts.
_FAR_OFF_M = 0.05


def fit(
    buildings: Sequence[Building],
    config: Reconstruct,
    initial: Sequence[Reconstruction | None] | None = None,
    method: str = METHOD,
    thresholds: Thresholds = THRESHOLDS,
) -> list[Reconstruction]:
    """One reconstruction per building, in order: the solid below the planes that the points on its roof show, or the
    parametric building nearest to them. With few points, up to ``config.max_parts`` such buildings side by side as one
    solid.

    ``initial``: the network's reconstructions of the same buildings. Each is where the search begins and, with
    few points above all, what the result is drawn towards. It remains the result where there are too few points,
    the search finds nothing better, or the kernel rejects what the search finds. If the union of the parts is
    not closed, the building is fitted with fewer parts. With ``config.dormers``, boxes that the points show above
    the roof are added to the solid. Deterministic.
    """
    fitter = Fitter(thresholds.limits._replace(max_roof_height_m=float(config.max_roof_height_m)))
    result = []
    for building, start in zip(buildings, initial or [None] * len(buildings), strict=True):
        prices = thresholds.of_building(building.polygon.area, config.detail)
        reconstruction = fit_building(_Task(building, start, config, method, prices, fitter))
        if not reconstruction.has_mesh and start is not None and start.has_mesh:
            reconstruction = replace(start, method=method)
        result.append(reconstruction)
    return result


@dataclass(frozen=True)
class _Task:
    """One building to fit. initial: the network's reconstruction, if there is one."""

    building: Building
    initial: Reconstruction | None
    config: Reconstruct
    method: str
    thresholds: Thresholds
    fitter: Fitter


@dataclass(frozen=True)
class _Prepared:
    """A footprint and the points to which roofs are fitted.

    footprint: the rings that the mesh gets, in the building's own frame. rotation: (2, 2), of the frame
    ``xy @ rotation`` of all else, whose axes the parts follow. rings: of the footprint. point_m: (m, 3), the points on
    the roof, then those of open ground. open_ground: what these show.
    """

    footprint: Sequence[np.ndarray]
    rotation: np.ndarray
    rings: Sequence[np.ndarray]
    point_m: np.ndarray
    open_ground: OpenGround


@dataclass(frozen=True)
class _Solid:
    """A building before its last steps, in the frame of :class:`_Prepared`.

    roofs: of the parts; with planes, the one roof that is nearest to them all. num_parts: roofs between which there are
    steps. eave_height_m: of the largest part. angle_deg: of each edge of the footprint. is_parametric: whether this is
    the building of the paper, one part with one angle for each edge.
    """

    mesh: Mesh
    roofs: Sequence[Roof]
    num_parts: int
    eave_height_m: float
    angle_deg: np.ndarray
    is_parametric: bool


def fit_building(task: _Task) -> Reconstruction:
    """The stations of a building from its points to its mesh, in order."""
    prepared = prepare(task)
    if isinstance(prepared, str):
        return no_mesh(task.building, task.method, prepared)
    solid = cover_with_planes(task, prepared) or unite_parts(task, prepared)
    if isinstance(solid, str):
        return no_mesh(task.building, task.method, solid)
    mesh = smooth(task, prepared, solid)
    mesh = prepared.open_ground.marked(mesh)
    mesh = add_chimneys(task, prepared, mesh)
    return _reconstruction(task, prepared, solid, mesh)


def prepare(task: _Task) -> _Prepared | str:
    """The points on the roof, the axes of its planes, and a footprint whose walls stand where the roof begins; a
    reason without enough points."""
    building, config = task.building, task.config
    if not len(building.point_m):
        return reasons.NO_POINTS
    if len(building.point_m) < config.min_num_points:
        return reasons.TOO_FEW_POINTS
    roof_m = roof_points(building.polygon, building.point_m, building.classification)
    # a return from a wall says nothing of the roof above it
    roof_m = roof_m[~wall_hits(roof_m)]
    rotation = roof_frame(list(building.rings), roof_m)
    points = (roof_m, building.point_m, building.classification)
    footprint = move_walls(building.rings, *points, config.max_wall_shift_m)
    polygon = shapely.Polygon(footprint[0], footprint[1:])
    roof_m = roof_m[shapely.contains_xy(polygon, roof_m[:, 0], roof_m[:, 1])]
    if len(roof_m) < MIN_NUM_POINTS:
        return reasons.TOO_FEW_ROOF_POINTS
    open_m = np.zeros((0, 3))
    if len(roof_m) >= MIN_CLASSIFIED_POINTS:
        open_m = ground_points(polygon, building.point_m, building.classification, _GROUND_INSIDE_M)
    point_m = np.vstack([roof_m, open_m])
    point_m = np.column_stack([point_m[:, :2] @ rotation, point_m[:, 2]])
    rings = [ring @ rotation for ring in footprint]
    return _Prepared(footprint, rotation, rings, point_m, OpenGround(point_m, len(open_m)))


def cover_with_planes(task: _Task, prepared: _Prepared) -> _Solid | None:
    """The solid below the planes that the points show, or below the one parametric roof that is as near to them; None
    where points are too few for planes, or the parametric model is asked for."""
    config, thresholds, point_m = task.config, task.thresholds, prepared.point_m
    if thresholds.planes is None or len(point_m) < _MIN_PLANE_POINTS:
        return None
    if config.max_parts == 1 or not config.dormers:
        return None
    # open ground gets the lowest roof
    raised_m = np.column_stack([point_m[:, :2], np.maximum(point_m[:, 2], config.min_eave_height_m)])
    planes = fit_planes(prepared.rings, raised_m, thresholds.planes)
    if planes is None:
        return None
    roofs = fit_roofs(task, prepared, point_m, 1)
    if not roofs:
        return None
    if _is_parametric(roofs, []) and roofs[0].num_slopes <= planes.num_faces:
        off_m = np.minimum(np.abs(planes.off_m), thresholds.limits.cap_m).mean()
        if roofs[0].loss_m < off_m + thresholds.as_near_m:
            mesh, _ = unite(task, prepared, roofs, [])
            return None if mesh is None else _solid_of(prepared, roofs, [], mesh)
    mesh = planes.mesh(prepared.rings)
    if mesh is None:
        return None
    mesh = simplified(mesh.vertex_m, mesh.triangle) or mesh
    eave_height_m, angle_deg = planes.parameters(prepared.rings)
    return _Solid(mesh, roofs, int(planes.body.max()) + 1, eave_height_m, angle_deg, False)


def unite_parts(task: _Task, prepared: _Prepared) -> _Solid | str:
    """The solid of all parts and boxes, with fewer parts until it is closed; a reason without any."""
    mesh, max_parts = None, task.config.max_parts
    while mesh is None:
        parts = fit_roofs(task, prepared, prepared.point_m, max_parts)
        if not parts:
            return reasons.NO_ROOF
        parts, boxes = add_boxes(task, prepared, parts, max_parts)
        mesh, boxes = unite(task, prepared, parts, boxes)
        max_parts = len(parts) - 1
        if mesh is None and not max_parts:
            return reasons.NO_CLOSED_UNION
    return _solid_of(prepared, parts, boxes, mesh)


def _solid_of(prepared: _Prepared, parts: Sequence[Roof], boxes: Sequence[Box], mesh: Mesh) -> _Solid:
    """A solid with the eave height of the largest part that is not open ground and, for each edge of the footprint, the
    angle of the part there."""
    roofs = [part for part in parts if not prepared.open_ground.is_open(part)] or parts
    largest = max(roofs, key=lambda part: shapely.Polygon(part.rings[0], part.rings[1:]).area)
    part_angles = np.concatenate([part.angle_deg for part in parts])
    angle_deg = transfer_angles([ring for part in parts for ring in part.rings], part_angles, prepared.rings)
    return _Solid(mesh, parts, len(parts), largest.eave_z_m, angle_deg, _is_parametric(parts, boxes))


def fit_roofs(task: _Task, prepared: _Prepared, point_m: np.ndarray, max_parts: int) -> Sequence[Roof]:
    """At most ``max_parts`` parts of the footprint, each with the roof that its points (m, 3) show; none without a
    roof."""
    initial, rings = task.initial, prepared.rings
    if len(point_m) < MIN_NUM_POINTS:
        return []
    effort, cutting = task.thresholds.effort, replace(task.thresholds.cutting, max_parts=max_parts)
    usual_prior = make_prior(rings, len(point_m))
    if initial is None or initial.angle_deg is None or initial.eave_height_m is None or not initial.has_mesh:
        return fit_parts(task.fitter, rings, point_m, effort, cutting, [], usual_prior)
    guess_deg, eave_m = initial.angle_deg, initial.eave_height_m
    prior = make_prior(rings, len(point_m), guess_deg, initial.class_probability, eave_m)
    guess = FittedRoof(rings, guess_deg, eave_m, np.inf, len(point_m))
    candidates: list[list[Roof]] = [[replace(guess, loss_m=task.fitter.loss(guess, point_m, prior))]]
    candidates += [fit_parts(task.fitter, rings, point_m, effort, cutting, [guess_deg], prior)]
    parts = min(filter(None, candidates), key=lambda parts: total_cost_m(parts, cutting))
    is_far_off = total_cost_m(parts, cutting) > _FAR_OFF_M * len(point_m)
    if len(parts) == 1 and max_parts > 1 and is_far_off:
        without_network = fit_parts(task.fitter, rings, point_m, effort, cutting, [], usual_prior)
        if len(without_network) > 1:
            parts = min(parts, without_network, key=lambda parts: total_cost_m(parts, cutting))
    return parts


def add_boxes(
    task: _Task, prepared: _Prepared, parts: Sequence[Roof], max_parts: int
) -> tuple[Sequence[Roof], Sequence[Box]]:
    """(parts, the dormers and recesses that the points show on them). A roof that was fitted to the points of boxes too
    lies too high, so the parts are those without these points if that costs less."""
    if not task.config.dormers:
        return parts, []
    cost_m, boxes = _find_boxes(task, prepared, parts)
    _, loose_boxes = _find_boxes(task, prepared, parts, task.thresholds.boxes.loose_share)
    if loose_boxes:
        rest_m = prepared.point_m[~is_over_boxes(loose_boxes, prepared.point_m)]
        refit = fit_roofs(task, prepared, rest_m, max_parts)
        if refit:
            new_cost_m, new_boxes = _find_boxes(task, prepared, refit)
            if new_cost_m < cost_m:
                return refit, new_boxes
    return parts, boxes


def _find_boxes(
    task: _Task, prepared: _Prepared, parts: Sequence[Roof], price_share: float = 1.0
) -> tuple[float, Sequence[Box]]:
    """(cost of the parts and the boxes, the boxes that gain at least this share of their price)."""
    thresholds, num_points = task.thresholds, len(prepared.point_m)
    # as high as their solids are
    parts = [replace(part, eave_z_m=max(part.eave_z_m, task.config.min_eave_height_m)) for part in parts]
    loss_m, boxes = find_boxes(task.fitter, parts, prepared.point_m, thresholds.boxes, price_share)
    part_price_m = thresholds.cutting.price_m(num_points)
    return loss_m + len(boxes) * thresholds.boxes.price_m(num_points) + (len(parts) - 1) * part_price_m, boxes


def unite(
    task: _Task, prepared: _Prepared, parts: Sequence[Roof], boxes: Sequence[Box]
) -> tuple[Mesh | None, Sequence[Box]]:
    """(closed solid of the parts with their boxes, the boxes): with as many as leave it sound, those that gain most
    first; None if it is not closed without any."""
    heights_m = task.config.min_eave_height_m, task.config.max_roof_height_m
    for num_boxes in range(len(boxes), 0, -1):
        best = boxes[:num_boxes]
        raised = [box.as_part() for box in best if not box.is_recess]
        mesh = union([*parts, *raised], *heights_m, [box for box in best if box.is_recess])
        if mesh is not None and is_sound(mesh):
            return mesh, best
    if _is_parametric(parts, []):
        eave_m = max(parts[0].eave_z_m, heights_m[0])
        return kernel_mesh(prepared.rings, parts[0].angle_deg, eave_m, heights_m[1]), []
    return union(parts, *heights_m), []


def _is_parametric(parts: Sequence[Roof], boxes: Sequence[Box]) -> bool:
    """Whether a building is the parametric one of the paper: one part, with one angle for each edge."""
    return len(parts) == 1 and parts[0].is_level_at_eaves and not boxes


def smooth(task: _Task, prepared: _Prepared, solid: _Solid) -> Mesh:
    """The mesh without short edges, its planes adjusted to the points. A parametric one keeps its edges and, with one
    part at most, its planes."""
    mesh = solid.mesh
    thresholds, rings, point_m = task.thresholds, prepared.rings, prepared.point_m
    if solid.is_parametric:
        is_fixed = task.config.max_parts == 1 or not thresholds.adjust
        return mesh if is_fixed else adjusted(mesh, rings, point_m)
    limits = thresholds.cutting.price_m(len(point_m)), thresholds.short_edge_m
    mesh = without_short_edges(mesh, rings, point_m, *limits)
    return adjusted(mesh, rings, point_m) if thresholds.adjust else mesh


def add_chimneys(task: _Task, prepared: _Prepared, mesh: Mesh) -> Mesh:
    """The mesh with the chimneys on it, at the highest level of detail."""
    if task.config.detail != "high" or not task.config.dormers:
        return mesh
    with_all = with_chimneys(mesh, prepared.rings, prepared.point_m, task.thresholds.chimneys)
    return mesh if with_all is mesh else prepared.open_ground.marked(with_all)


def _reconstruction(task: _Task, prepared: _Prepared, solid: _Solid, mesh: Mesh) -> Reconstruction:
    building = task.building
    probability = None if task.initial is None else task.initial.class_probability
    return Reconstruction(
        building.building_id,
        building.tile,
        task.method,
        reasons.OK,
        building.origin_xy_m,
        building.ground_z_m,
        prepared.footprint,
        max(solid.eave_height_m, task.config.min_eave_height_m),
        solid.angle_deg,
        expected_share(task.fitter, solid.roofs, prepared.point_m, probability),
        mesh.turned(prepared.rotation.T),
        solid.num_parts,
    )
