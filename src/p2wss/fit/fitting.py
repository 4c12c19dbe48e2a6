"""Buildings fitted to their points, starting from the network's reconstructions or from nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

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
from p2wss.fit.mesh.parametric import build_meshes, transfer_angles
from p2wss.fit.mesh.short_edges import short_edges, without_short_edges
from p2wss.fit.mesh.union import is_sound, union
from p2wss.fit.parts.frame import enclosing_rectangle, roof_frame
from p2wss.fit.parts.partition import fit_parts
from p2wss.fit.parts.parts import main_frame, total_cost_m
from p2wss.fit.parts.roofs import Roof
from p2wss.fit.points import ground_points, roof_points, wall_hits
from p2wss.fit.roof.confidence import expected_share
from p2wss.fit.roof.fitter import MIN_NUM_POINTS, FittedRoof, Fitter
from p2wss.fit.roof.prior import make_prior
from p2wss.fit.roof_edges import move_walls
from p2wss.fit.settings import THRESHOLDS, Cutting, Thresholds
from p2wss.mesh import Mesh

METHOD = "fit"
# points of class ground this far inside the footprint show that no building is there
_GROUND_INSIDE_M = 0.5
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
    """One reconstruction per building, in order: the parametric building nearest to the points on its roof, or
    up to ``config.max_parts`` of them side by side as one solid.

    ``initial``: the network's reconstructions of the same buildings. Each is where the search begins and, with
    few points above all, what the result is drawn towards. It remains the result where there are too few points,
    the search finds nothing better, or the kernel rejects what the search finds. If the union of the parts is
    not closed, the building is fitted with fewer parts. With ``config.dormers``, boxes that the points show above
    the roof are added to the solid. Deterministic.
    """
    fitter = Fitter(thresholds.limits._replace(max_roof_height_m=float(config.max_roof_height_m)))
    initials = [None] * len(buildings) if initial is None else list(initial)
    tasks = [
        _FitTask(
            building,
            start,
            config,
            method,
            thresholds.of_building(building.polygon.area, config.detail),
            fitter,
        )
        for building, start in zip(buildings, initials, strict=True)
    ]
    parts_fits = [task.fit_parts(config.max_parts) for task in tasks]
    result = []
    for task, parts_fit, single in zip(tasks, parts_fits, _mesh_single_parts(tasks, parts_fits), strict=True):
        reconstruction, parts_fit = task.reconstruct(parts_fit, single)
        reconstruction = task.with_chimneys(reconstruction, parts_fit)
        if parts_fit.parts:
            reconstruction = replace(reconstruction, confidence=task.confidence(parts_fit))
        if not reconstruction.has_mesh and task.initial is not None and task.initial.has_mesh:
            reconstruction = replace(task.initial, method=method)
        result.append(reconstruction)
    return result


@dataclass(frozen=True)
class _PartsFit:
    """The roofs that are fitted to the parts of a building.

    rings: the footprint that the mesh gets, in the building's own frame. rotation: (2, 2); parts and points are in
    the frame ``xy @ rotation``. parts: empty without a fit. reason: why there are no parts, a value of
    :mod:`p2wss.data.reasons`. point_m: (m, 3), all points on the roof. num_ground: how many of the points, the last
    ones, are of open ground; stated without parts only. goes_beyond: whether the parts reach beyond the footprint,
    where their solid is cut off.
    """

    rings: Sequence[np.ndarray]
    rotation: np.ndarray
    parts: Sequence[Roof]
    reason: str
    point_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    num_ground: int = 0
    goes_beyond: bool = False

    def in_building_frame(self, vertex_m: np.ndarray) -> np.ndarray:
        """Vertices (v, 3) of the rotated frame in the frame of the building."""
        return np.column_stack([vertex_m[:, :2] @ self.rotation.T, vertex_m[:, 2]])


@dataclass(frozen=True)
class _FitTask:
    """One building to fit. initial: the network's reconstruction, if there is one."""

    building: Building
    initial: Reconstruction | None
    config: Reconstruct
    method: str
    thresholds: Thresholds
    fitter: Fitter

    @cached_property
    def _without_parts(self) -> _PartsFit:
        """The footprint and the points to which parts are fitted, still without parts."""
        building, config = self.building, self.config
        rings = list(building.rings)
        rotation = main_frame(rings)
        if not len(building.point_m):
            return _PartsFit(rings, rotation, [], reasons.NO_POINTS)
        if len(building.point_m) < config.min_num_points:
            return _PartsFit(rings, rotation, [], reasons.TOO_FEW_POINTS)
        polygon = shapely.Polygon(rings[0], rings[1:])
        roof_point_m = self._roof_points(polygon)
        rotation = roof_frame(rings, roof_point_m)
        points = (roof_point_m, building.point_m, building.classification)
        rings = move_walls(rings, *points, config.max_wall_shift_m)
        polygon = shapely.Polygon(rings[0], rings[1:])
        roof_point_m = roof_point_m[shapely.contains_xy(polygon, roof_point_m[:, 0], roof_point_m[:, 1])]
        if len(roof_point_m) < MIN_NUM_POINTS:
            return _PartsFit(rings, rotation, [], reasons.TOO_FEW_ROOF_POINTS)
        num_ground = 0
        if len(roof_point_m) >= MIN_CLASSIFIED_POINTS:
            open_point_m = ground_points(polygon, building.point_m, building.classification, _GROUND_INSIDE_M)
            roof_point_m = np.vstack([roof_point_m, open_point_m])
            num_ground = len(open_point_m)
        roof_point_m = np.column_stack([roof_point_m[:, :2] @ rotation, roof_point_m[:, 2]])
        return _PartsFit(rings, rotation, [], "", roof_point_m, num_ground=num_ground)

    @cached_property
    def _open_ground(self) -> OpenGround:
        """Open ground within the footprint, in the frame of the parts."""
        without_parts = self._without_parts
        return OpenGround(without_parts.point_m, without_parts.num_ground)

    def _roof_points(self, polygon: shapely.Polygon) -> np.ndarray:
        """The points (m, 3) on the roof. Walls are not fitted: a return from one says nothing of the roof above it."""
        building = self.building
        point_m = roof_points(polygon, building.point_m, building.classification)
        return point_m[~wall_hits(point_m)]

    def fit_parts(self, max_parts: int, boxes: Sequence[Box] = ()) -> _PartsFit:
        """At most ``max_parts`` parts, fitted to the points that are not over ``boxes``."""
        without_parts = self._without_parts
        cutting = replace(self.thresholds.cutting, max_parts=max_parts)
        if without_parts.reason:
            return without_parts
        rings, rotation, roof_point_m = without_parts.rings, without_parts.rotation, without_parts.point_m
        point_m = roof_point_m[~is_over_boxes(boxes, roof_point_m)]
        if len(point_m) < MIN_NUM_POINTS:
            return _PartsFit(rings, rotation, [], reasons.TOO_FEW_ROOF_POINTS)
        rotated = [ring @ rotation for ring in rings]
        parts = self._parts_over(rotated, point_m, cutting)
        if max_parts > 1 and not np.array_equal(rotation, main_frame(list(self.building.rings))):
            # a roof that the footprint cuts off at an angle goes on beyond it
            around = enclosing_rectangle(rotated)
            prior = make_prior(around, len(point_m))
            beyond = fit_parts(self.fitter, around, point_m, self.thresholds.effort, cutting, [], prior)
            if beyond and (not parts or total_cost_m(beyond, cutting) < total_cost_m(parts, cutting)):
                return _PartsFit(rings, rotation, beyond, "", roof_point_m, goes_beyond=True)
        return _PartsFit(rings, rotation, parts, "" if parts else reasons.NO_ROOF, roof_point_m)

    def _parts_over(
        self, rings: Sequence[np.ndarray], point_m: np.ndarray, cutting: Cutting
    ) -> Sequence[Roof]:
        """The parts of the footprint ``rings`` for points (m, 3), both in the frame of the parts; empty without a
        roof."""
        initial, effort = self.initial, self.thresholds.effort
        usual_prior = make_prior(rings, len(point_m))
        if (
            initial is None
            or initial.angle_deg is None
            or initial.eave_height_m is None
            or not initial.has_mesh
        ):
            return fit_parts(self.fitter, rings, point_m, effort, cutting, [], usual_prior)
        guess_deg, eave_z_m = initial.angle_deg, initial.eave_height_m
        prior = make_prior(rings, len(point_m), guess_deg, initial.class_probability, eave_z_m)
        guess = FittedRoof(rings, guess_deg, eave_z_m, np.inf, len(point_m))
        candidates: list[list[Roof]] = [[replace(guess, loss_m=self.fitter.loss(guess, point_m, prior))]]
        candidates += [fit_parts(self.fitter, rings, point_m, effort, cutting, [guess_deg], prior)]
        parts = min(filter(None, candidates), key=lambda parts: total_cost_m(parts, cutting))
        is_far_off = total_cost_m(parts, cutting) > _FAR_OFF_M * len(point_m)
        if len(parts) == 1 and cutting.max_parts > 1 and is_far_off:
            without_network = fit_parts(self.fitter, rings, point_m, effort, cutting, [], usual_prior)
            if len(without_network) > 1:
                parts = min(parts, without_network, key=lambda parts: total_cost_m(parts, cutting))
        return parts

    def reconstruct(
        self, parts_fit: _PartsFit, single: Reconstruction | None
    ) -> tuple[Reconstruction, _PartsFit]:
        """The reconstruction and the fit that it shows: with boxes if there are any, and with fewer parts if there is
        no closed union of all. single: the mesh of a fit that has one part."""
        has_boxes = self.config.dormers and bool(parts_fit.parts) and (single is None or single.has_mesh)
        with_boxes = self._with_boxes(parts_fit) if has_boxes else None
        if with_boxes is not None:
            return with_boxes
        if single is not None:
            return single, parts_fit
        reconstruction, closed_fit = self._build_mesh(parts_fit)
        if has_boxes and reconstruction.has_mesh and closed_fit is not parts_fit:
            with_boxes = self._with_boxes(closed_fit)
        return with_boxes or (reconstruction, closed_fit)

    def _build_mesh(
        self, parts_fit: _PartsFit, boxes: Sequence[Box] = ()
    ) -> tuple[Reconstruction, _PartsFit]:
        """The mesh of a fit, or of one with fewer parts until their union is closed, and that fit. ``boxes``: over
        which points are ignored."""
        while True:
            reconstruction = self._mesh_of_parts(parts_fit)
            num_parts = len(parts_fit.parts)
            if reconstruction.has_mesh or (num_parts < 2 and not parts_fit.goes_beyond):
                return reconstruction, parts_fit
            parts_fit = self.fit_parts(max(num_parts - 1, 1), boxes)

    def _with_boxes(self, parts_fit: _PartsFit) -> tuple[Reconstruction, _PartsFit] | None:
        """The building with the boxes that its points show above its roof, as many as have a closed union with it, and
        the fit of its parts. None without boxes.

        A roof that was fitted to the points of the boxes too lies too high, so it is also fitted without them, and that
        may be better even without any box.
        """
        cost, boxes, loose_boxes = self._find_boxes(parts_fit, self.thresholds.boxes.loose_share)
        candidates = [(parts_fit, boxes)]
        if loose_boxes:
            refit = self.fit_parts(self.config.max_parts, loose_boxes)
            if refit.parts:
                new_cost, new_boxes, _ = self._find_boxes(refit)
                if new_cost < cost:
                    candidates.insert(0, (refit, new_boxes))
        for candidate, candidate_boxes in candidates:
            if candidate_boxes:
                mesh = self._sound_union(candidate, candidate_boxes)
                if mesh is not None:
                    return self._of_mesh(candidate, mesh), candidate
            elif candidate is not parts_fit:
                reconstruction, closed_fit = self._build_mesh(candidate, loose_boxes)
                if reconstruction.mesh is not None and is_sound(reconstruction.mesh):
                    return reconstruction, closed_fit
        return None

    def _sound_union(self, parts_fit: _PartsFit, boxes: Sequence[Box]) -> Mesh | None:
        """The union of the parts with all of the boxes, None if it is not sound."""
        mesh = self._union(parts_fit, boxes)
        return mesh if mesh is not None and is_sound(mesh) else None

    def _union(self, parts_fit: _PartsFit, boxes: Sequence[Box] = ()) -> Mesh | None:
        """The union of the parts with boxes, in the frame of the parts; None if it is not closed."""
        config = self.config
        raised = [box.as_part() for box in boxes if not box.is_recess]
        recesses = [box for box in boxes if box.is_recess]
        outline = [ring @ parts_fit.rotation for ring in parts_fit.rings] if parts_fit.goes_beyond else []
        heights = config.min_eave_height_m, config.max_roof_height_m
        return union([*parts_fit.parts, *raised], *heights, recesses, outline)

    def with_chimneys(self, reconstruction: Reconstruction, parts_fit: _PartsFit) -> Reconstruction:
        """A reconstruction with the chimneys on the roof that a fit describes, at the highest level of detail."""
        if self.config.detail != "high" or not self.config.dormers or not parts_fit.parts:
            return reconstruction
        frame = parts_fit.rotation, parts_fit.point_m, self._open_ground
        return with_chimneys(reconstruction, *frame, self.thresholds.chimneys)

    def confidence(self, parts_fit: _PartsFit) -> float | None:
        """The expected share of the building's values that are right."""
        probability = None if self.initial is None else self.initial.class_probability
        return expected_share(self.fitter, parts_fit.parts, parts_fit.point_m, probability)

    def _mesh_of_parts(self, parts_fit: _PartsFit) -> Reconstruction:
        """The reconstruction that a fit describes. With several parts it has the eave height of the largest one that is
        not open ground and, for each edge of the footprint, the angle of the part there."""
        building = self.building
        if not parts_fit.parts:
            return no_mesh(building, self.method, parts_fit.reason)
        (single,) = _mesh_single_parts([self], [parts_fit])
        if single is not None:
            return single
        mesh = self._union(parts_fit)
        if mesh is None:
            return no_mesh(building, self.method, reasons.NO_CLOSED_UNION)
        return self._of_mesh(parts_fit, mesh)

    def _of_mesh(self, parts_fit: _PartsFit, mesh: Mesh) -> Reconstruction:
        """The reconstruction with the parts of a fit and a mesh in their frame."""
        building, parts = self.building, parts_fit.parts
        price_m = self.thresholds.cutting.price_m(len(parts_fit.point_m))
        rings = [ring @ parts_fit.rotation for ring in parts_fit.rings]
        point_m = parts_fit.point_m
        short_edge_m = self.thresholds.short_edge_m
        mesh = without_short_edges(mesh, rings, point_m, price_m, short_edge_m)
        if self.thresholds.adjust:
            edges = short_edges(mesh, short_edge_m)
            mesh = adjusted(mesh, rings, point_m)
            if not set(edges).issuperset(short_edges(mesh, short_edge_m)):
                mesh = without_short_edges(mesh, rings, point_m, price_m, short_edge_m)
        roofs = [part for part in parts if not self._open_ground.is_open(part)] or parts
        largest = max(roofs, key=lambda part: shapely.Polygon(part.rings[0], part.rings[1:]).area)
        angle_deg = largest.angle_deg
        if len(parts) > 1 or parts_fit.goes_beyond:
            part_rings = [ring @ parts_fit.rotation.T for part in parts for ring in part.rings]
            part_angles = np.concatenate([part.angle_deg for part in parts])
            angle_deg = transfer_angles(part_rings, part_angles, parts_fit.rings)
        return Reconstruction(
            building.building_id,
            building.tile,
            self.method,
            reasons.OK,
            building.origin_xy_m,
            building.ground_z_m,
            parts_fit.rings,
            max(largest.eave_z_m, self.config.min_eave_height_m),
            angle_deg,
            None,
            self._open_ground.marked(mesh).turned(parts_fit.rotation.T),
            len(parts),
        )

    def _find_boxes(
        self, parts_fit: _PartsFit, loose_share: float = 1.0
    ) -> tuple[float, list[Box], list[Box]]:
        """(cost of the parts and the boxes, the boxes, the same and others that gain ``loose_share`` of the price)."""
        thresholds, num_points = self.thresholds, len(parts_fit.point_m)
        price_m = thresholds.boxes.price_m(num_points)
        # the eaves of a roof that goes on beyond the footprint may be below the ground
        lowest_z_m = -np.inf if parts_fit.goes_beyond else self.config.min_eave_height_m
        parts = [replace(part, eave_z_m=max(part.eave_z_m, lowest_z_m)) for part in parts_fit.parts]
        point_m, boxes = parts_fit.point_m, thresholds.boxes
        loss, found, loose = find_boxes(self.fitter, parts, point_m, price_m, boxes, loose_share)
        cost = loss + len(found) * price_m + (len(parts) - 1) * thresholds.cutting.price_m(num_points)
        return cost, found, loose


def _mesh_single_parts(
    tasks: Sequence[_FitTask], parts_fits: Sequence[_PartsFit]
) -> list[Reconstruction | None]:
    """The reconstructions of buildings of one part, all by one call of the kernel; None for the others."""
    result: list[Reconstruction | None] = [None] * len(tasks)
    indices = [
        i
        for i, parts_fit in enumerate(parts_fits)
        if len(parts_fit.parts) == 1 and parts_fit.parts[0].is_level_at_eaves and not parts_fit.goes_beyond
    ]
    if not indices:
        return result
    config, parts = tasks[0].config, [parts_fits[i].parts[0] for i in indices]
    height = np.array([part.eave_z_m for part in parts])
    reconstructions = build_meshes(
        [tasks[i].building for i in indices],
        [parts_fits[i].rings for i in indices],
        np.maximum(height, config.min_eave_height_m),
        [part.angle_deg for part in parts],
        np.full(len(indices), np.nan),
        tasks[0].method,
        config,
        [""] * len(indices),
    )
    for i, reconstruction in zip(indices, reconstructions, strict=True):
        # one part alone is the parametric building of the paper, with one angle for each edge
        if config.max_parts > 1 and tasks[i].thresholds.adjust:
            reconstruction = _adjusted_single_part(reconstruction, parts_fits[i])
        result[i] = reconstruction
    return result


def _adjusted_single_part(reconstruction: Reconstruction, parts_fit: _PartsFit) -> Reconstruction:
    """A reconstruction of the kernel with roofs that are adjusted to the points."""
    if reconstruction.mesh is None:
        return reconstruction
    point_m = parts_fit.in_building_frame(parts_fit.point_m)
    return replace(reconstruction, mesh=adjusted(reconstruction.mesh, reconstruction.rings, point_m))
