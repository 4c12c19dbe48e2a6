"""Buildings fitted to their points, from the network's reconstruction or from nothing (``p2wss.fit``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import shapely

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.fit.confidence import expected_share
from p2wss.fit.dormers import Boxes, add_boxes, on_boxes
from p2wss.fit.mesh import build_meshes as build
from p2wss.fit.mesh import mesh_footprint, transfer_angles
from p2wss.fit.one_height import MIN_NUM_POINTS, Effort, Fitter, Limits, OneHeight
from p2wss.fit.parts import Cutting, cost_m, fit_parts, main_frame
from p2wss.fit.points import roof_points
from p2wss.fit.prior import believed
from p2wss.fit.solid import Mesh, is_sound, union

METHOD = "fit"
# boxes are looked for with this share of what they have to gain before the roof is fitted without their points
_LOOSE = 0.5
# mean distance of the points from one roof, where the network leads, that says it led astray, as it knows one height
# only: a search without it may find parts
_FAR_OFF_M = 0.05


@dataclass(frozen=True)
class Thresholds:
    """What decides between roofs; `docs/methods/fit.md` says how the defaults were chosen."""

    effort: Effort = field(default_factory=Effort)
    limits: Limits = field(default_factory=Limits)
    cutting: Cutting = field(default_factory=Cutting)
    boxes: Boxes = field(default_factory=Boxes)


def fit(
    buildings: Sequence[Building],
    config: Reconstruct,
    known: Sequence[Reconstruction] | None = None,
    method: str = METHOD,
    thresholds: Thresholds = Thresholds(),
) -> list[Reconstruction]:
    """One reconstruction per building, in order: the parametric building nearest to the points on its roof, or
    up to ``config.max_parts`` of them side by side as one solid.

    ``known``: the network's reconstructions of the same buildings; each is where a search begins and, the more
    so the fewer the points, what it is drawn to. It stays where the points are too few, nothing better is found
    or the kernel rejects what is found. What has no closed union is fitted with fewer parts. With
    ``config.dormers`` boxes that the points show above the roof are added to the solid. Deterministic.
    """
    fitter = Fitter(replace(thresholds.limits, max_roof_height_m=config.max_roof_height_m))
    starts = [None] * len(buildings) if known is None else list(known)
    ones = [
        _One(building, start, config, method, thresholds, fitter)
        for building, start in zip(buildings, starts, strict=True)
    ]
    founds = [one.found(config.max_parts) for one in ones]
    result = []
    for one, found, single in zip(ones, founds, _of_one_part(ones, founds), strict=True):
        made, found = (single, found) if single is not None else one.meshed(found)
        start = one.start
        if config.dormers and made.has_mesh:
            made = one.with_boxes(made, found)
        if not made.has_mesh and start is not None and start.has_mesh:
            made = replace(start, method=method)
        result.append(made)
    return result


@dataclass(frozen=True)
class _Found:
    """What the points say of a building: its parts in the frame ``xy @ rotation``, with the points there on the
    roof, or why there are none."""

    rings: Sequence[np.ndarray]
    rotation: np.ndarray
    parts: Sequence[OneHeight]
    refused: str
    point_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    def placed(self, vertex_m: np.ndarray) -> np.ndarray:
        """Vertices (v, 3) of that frame in the building's own."""
        return np.column_stack([vertex_m[:, :2] @ self.rotation.T, vertex_m[:, 2]])


@dataclass(frozen=True)
class _One:
    """One building to fit."""

    building: Building
    start: Reconstruction | None
    config: Reconstruct
    method: str
    thresholds: Thresholds
    fitter: Fitter

    def fit(self, boxes: Sequence[OneHeight] = ()) -> tuple[Reconstruction, _Found]:
        """The building without the points on ``boxes``, of so many parts as have a closed union."""
        return self.meshed(self.found(self.config.max_parts, boxes), boxes)

    def meshed(self, found: _Found, boxes: Sequence[OneHeight] = ()) -> tuple[Reconstruction, _Found]:
        """As :meth:`fit` from what was found at first."""
        while True:
            made = self._meshed(found)
            if made.has_mesh or len(found.parts) < 2:
                return made, found
            found = self.found(len(found.parts) - 1, boxes)

    def confidence(self, found: _Found) -> float | None:
        """The expected share of its numbers that are right."""
        odds = None if self.start is None else self.start.class_probability
        return expected_share(self.fitter, found.parts, found.point_m, odds)

    def with_boxes(self, made: Reconstruction, found: _Found) -> Reconstruction:
        """The building with the boxes that its points show above its roof, as many as have a closed union with it.

        A roof that was fitted to the points of the boxes too lies too high: it is also fitted without them."""
        cost, boxes = self._boxed(made, found)
        candidates = [(made, found, boxes)]
        _, loose = self._boxed(made, found, _LOOSE)
        if loose:
            again = self.fit(loose)
            if again[0].has_mesh:
                new_cost, new_boxes = self._boxed(*again)
                if new_cost < cost:
                    candidates.insert(0, (*again, new_boxes))
        for one, its_found, its_boxes in candidates:
            mesh = _union_with(its_found.parts, its_boxes, one.ground_z_m, self.config)
            if mesh is not None:
                vertex_m = found.placed(mesh.vertex_m)
                return replace(
                    one, vertex_m=vertex_m, triangle=mesh.triangle, kind=mesh.kind, edge=mesh.plane
                )
        return made

    def found(self, max_parts: int, boxes: Sequence[OneHeight] = ()) -> _Found:
        """At most so many parts, from the points that are not on ``boxes``."""
        building, config, start, effort = self.building, self.config, self.start, self.thresholds.effort
        cutting = replace(self.thresholds.cutting, max_parts=max_parts)
        rings = mesh_footprint(building, config)
        rotation = main_frame(rings)
        if not len(building.point_m):
            return _Found(rings, rotation, [], reasons.NO_POINTS)
        if len(building.point_m) < config.min_num_points:
            return _Found(rings, rotation, [], reasons.TOO_FEW_POINTS)
        ground = building.ground_z_m
        polygon = shapely.Polygon(rings[0], rings[1:])
        point_m = roof_points(polygon, building.point_m, building.classification, ground)
        if len(point_m) < MIN_NUM_POINTS:
            return _Found(rings, rotation, [], reasons.TOO_FEW_ROOF_POINTS)
        point_m = np.column_stack([point_m[:, :2] @ rotation, point_m[:, 2]])
        every_point_m, point_m = point_m, point_m[~on_boxes(boxes, point_m)]
        turned = [ring @ rotation for ring in rings]
        if start is None or start.angle_deg is None or start.eave_height_m is None or not start.has_mesh:
            prior = believed(turned, len(point_m))
            parts = fit_parts(self.fitter, turned, point_m, effort, cutting, [], prior)
            return _Found(rings, rotation, parts, "" if parts else reasons.NO_ROOF, every_point_m)
        guess, eave_z_m = start.angle_deg, start.eave_height_m + ground
        prior = believed(turned, len(point_m), guess, start.class_probability, eave_z_m)
        before = OneHeight(turned, guess, eave_z_m, np.inf, np.inf, len(point_m))
        answers = [[replace(before, loss_m=self.fitter.loss(before, point_m, prior))]]
        answers += [fit_parts(self.fitter, turned, point_m, effort, cutting, [guess], prior)]
        parts = min(filter(None, answers), key=lambda parts: cost_m(parts, cutting))
        far_off = cost_m(parts, cutting) > _FAR_OFF_M * len(point_m)
        if len(parts) == 1 and cutting.max_parts > 1 and far_off:
            usual = believed(turned, len(point_m))
            alone = fit_parts(self.fitter, turned, point_m, effort, cutting, [], usual)
            if len(alone) > 1:
                parts = min(parts, alone, key=lambda parts: cost_m(parts, cutting))
        return _Found(rings, rotation, parts, "", every_point_m)

    def _meshed(self, found: _Found) -> Reconstruction:
        """The row of the building. Of several parts it tells the eave height of the largest and, for each edge
        of the footprint, the angle of the part there."""
        building, config = self.building, self.config
        if not found.parts:
            return no_mesh(building, self.method, found.refused)
        (single,) = _of_one_part([self], [found])
        if single is not None:
            return single
        ground = building.ground_z_m
        largest = max(found.parts, key=lambda part: shapely.Polygon(part.rings[0], part.rings[1:]).area)
        height = max(largest.eave_z_m - ground, config.min_eave_height_m)
        mesh = union(found.parts, ground, config.min_eave_height_m, config.max_roof_height_m)
        if mesh is None:
            return no_mesh(building, self.method, reasons.NO_CLOSED_UNION)
        part_rings = [ring @ found.rotation.T for part in found.parts for ring in part.rings]
        part_angles = np.concatenate([part.angle_deg for part in found.parts])
        return Reconstruction(
            building.building_id,
            building.tile,
            self.method,
            "ok",
            building.origin_xy_m,
            ground,
            found.rings,
            height,
            transfer_angles(part_rings, part_angles, found.rings),
            self.confidence(found),
            found.placed(mesh.vertex_m),
            mesh.triangle,
            mesh.kind,
            mesh.plane,
            len(found.parts),
        )

    def _boxed(
        self, made: Reconstruction, found: _Found, share: float = 1.0
    ) -> tuple[float, list[OneHeight]]:
        """(cost of all with the boxes, the boxes) that gain this share of what they have to."""
        thresholds, num_points = self.thresholds, len(found.point_m)
        least = thresholds.boxes.least_gain_m(num_points)
        turned = np.column_stack(
            [made.vertex_m[:, :2] @ found.rotation, made.vertex_m[:, 2] + made.ground_z_m]
        )
        loss, boxes = add_boxes(
            found.parts, turned, made.triangle, found.point_m, share * least, thresholds.boxes
        )
        cut = thresholds.cutting.least_gain_m(num_points)
        return loss + len(boxes) * least + (len(found.parts) - 1) * cut, boxes


def _of_one_part(ones: Sequence[_One], founds: Sequence[_Found]) -> list[Reconstruction | None]:
    """The rows of buildings of one part, all by one call of the kernel; None for others."""
    result: list[Reconstruction | None] = [None] * len(ones)
    chosen = [i for i, found in enumerate(founds) if len(found.parts) == 1]
    if not chosen:
        return result
    config, parts = ones[0].config, [founds[i].parts[0] for i in chosen]
    ground = [ones[i].building.ground_z_m for i in chosen]
    height = np.array([part.eave_z_m for part in parts]) - ground
    told = [ones[i].confidence(founds[i]) for i in chosen]
    made = build(
        [ones[i].building for i in chosen],
        [founds[i].rings for i in chosen],
        ground,
        np.maximum(height, config.min_eave_height_m),
        [part.angle_deg for part in parts],
        np.array([np.nan if confidence is None else confidence for confidence in told]),
        ones[0].method,
        config,
        [""] * len(chosen),
        np.array([part.top_m for part in parts]),
    )
    for i, one in zip(chosen, made, strict=True):
        result[i] = one
    return result


def _union_with(
    parts: Sequence[OneHeight], boxes: Sequence[OneHeight], ground_z_m: float, config: Reconstruct
) -> Mesh | None:
    """The union with all boxes or, if that is not sound, with those that it is sound with one after the other;
    None: with no box."""
    heights = (ground_z_m, config.min_eave_height_m, config.max_roof_height_m)
    if not boxes:
        return None
    mesh = union([*parts, *boxes], *heights)
    if mesh is not None and is_sound(mesh):
        return mesh
    kept, best = list(parts), None
    for box in boxes:
        mesh = union([*kept, box], *heights)
        if mesh is not None and is_sound(mesh):
            kept, best = [*kept, box], mesh
    return best
