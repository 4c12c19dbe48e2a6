"""A building of the output, and how well its mesh fits its points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import TYPE_CHECKING, Any

import numpy as np

from p2wss.clouds.cropping import seen_share
from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.data.points import stride
from p2wss.fit.roof_edges import mean_overhang_m
from p2wss.mesh.surface import distance_to_mesh
from p2wss.reconstruction.outputs.measures import MeshMeasures, measure, unseen_roof_area_m2
from p2wss.reconstruction.product import NETWORK
from p2wss.reconstruction.registration.register import Registration

if TYPE_CHECKING:
    from p2wss.reconstruction.scene import SceneBuilding

STATUSES = ("ok", "flat", "none")
# a residual is the mean over at most this many points
_MAX_RESIDUAL_POINTS = 2048
# at most this many points of a building are kept for the page of the run
_MAX_SAMPLE_POINTS = 256
# a point this near to the mesh counts as near; an outline with a smaller share of near points is of trees. Of 151
# outlines of four clouds without classes, 33 have less, and one of these 33 lies on a footprint of a map
_NEAR_M, _MIN_NEAR_SHARE = 0.2, 0.8


@dataclass(frozen=True)
class Row:
    """A row of the input: a footprint with its points.

    number: index of the row in the results. status: of the footprint, "ok" or why it cannot be used. columns,
    registration, dates, ground, failure: as in :class:`Result`. is_own_outline: whether the footprint is an outline of
    points to which p2wss itself gave class building.
    """

    number: int
    building: Building
    status: str
    columns: Mapping[str, Any] = field(default_factory=dict)
    registration: Registration | None = None
    dates: tuple[date, date] | None = None
    ground: tuple[str, float] | None = None
    failure: str = ""
    is_own_outline: bool = False


@dataclass(frozen=True)
class Result:
    """A building of the output: its reconstruction, its points and how well the mesh fits them.

    status: ``ok``, ``flat`` (a flat roof instead, for ``reason``) or ``none`` (no mesh, for ``reason``).
    residual_m: mean distance of the points on the building to the mesh; NaN without any.
    visible_share: share of the footprint's 1 m cells that have a point on the building.
    not_representable: the building was fitted, but the residual is more than ``not_representable_m``.
    columns: values of the footprint's input columns by their names, None where there is no value.
    registration: how the footprint was moved, None without a registration.
    rmse_m, share_within_20cm: root mean square, and share up to 20 cm, of the distances of the residual.
    is_reliable: the points support the reconstruction: status ``ok``, a small residual, and half of the footprint seen.
    dates: the first and the last day of its points; None if unknown.
    overhang_m: how far roofs reach beyond the edges of the footprint, negative where they end inside: the mean over the
    length of the edges at which points show it; NaN if they show it at none.
    measures: of the mesh; None without one.
    unseen_roof_area_m2: area in plan of the roof of the mesh in 1 m cells without a point; NaN without a mesh.
    party_wall_area_m2: area of the walls that stand against other buildings of the run; NaN if unknown.
    ground: source of the height of the ground, and its standard deviation
    (:mod:`p2wss.reconstruction.points.ground`); None where it is unknown.
    sample_m: float32 (n, 4), some of the points on the building, in the frame of its mesh, and their distances to it.
    failure: the traceback of a building with the reason ``internal-error``, else empty.
    num_lines: number of lines of its roof on a map; None in a run without such lines.
    is_like_trees: the footprint is an outline of points to which p2wss itself gave class building, and too many of
    these points are far from the fitted mesh, as in crowns of trees.
    """

    reconstruction: Reconstruction
    status: str
    reason: str | None
    num_points: int
    residual_m: float
    visible_share: float
    not_representable: bool
    columns: Mapping[str, Any] = field(default_factory=dict)
    registration: Registration | None = None
    rmse_m: float = float("nan")
    share_within_20cm: float = float("nan")
    is_reliable: bool = False
    dates: tuple[date, date] | None = None
    overhang_m: float = float("nan")
    measures: MeshMeasures | None = None
    unseen_roof_area_m2: float = float("nan")
    party_wall_area_m2: float = 0.0
    ground: tuple[str, float] | None = None
    sample_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), np.float32))
    failure: str = ""
    num_lines: int | None = None
    is_like_trees: bool = False

    @property
    def flags(self) -> tuple[str, ...]:
        """What contradicts the footprint: names of :data:`p2wss.data.reasons.FLAGS`."""
        of_trees = (reasons.LIKE_TREES,) if self.is_like_trees else ()
        return of_trees if self.registration is None else self.registration.flags + of_trees


def result_of(row: Row, reconstruction: Reconstruction, config: Reconstruct) -> Result:
    """The result of a row of the input with this reconstruction: how well the points fit, and measures of the mesh."""
    building = row.building
    reason = None if reconstruction.status == "ok" else reconstruction.status
    status = "none" if not reconstruction.has_mesh else "ok" if reason is None else "flat"
    if reconstruction.is_simplified:
        reason = reason or reasons.SIMPLIFIED
    on_building = building.is_on_building if building.rings else np.zeros(len(building.point_m), bool)
    point_m = building.point_m[on_building]
    point_m = point_m[:: stride(len(point_m), _MAX_RESIDUAL_POINTS)]
    # without a mesh, distances are 0
    distance_m, mesh = np.zeros(len(point_m)), reconstruction.mesh
    residual_m = rmse_m = share_within_20cm = float("nan")
    if mesh is not None and len(point_m):
        distance_m = distance_to_mesh(point_m, mesh.vertex_m, mesh.triangle)
        residual_m, rmse_m = float(distance_m.mean()), float(np.sqrt((distance_m**2).mean()))
        share_within_20cm = float((distance_m <= _NEAR_M).mean())
    is_fitted = status == "ok" and reconstruction.method != NETWORK
    is_far = residual_m > config.not_representable_m
    visible_share = overhang_m = unseen_m2 = float("nan")
    if building.rings:
        # points in whole centimetres, as in crops
        x_m, y_m = np.round(building.point_m[on_building, :2], 2).T
        visible_share = seen_share(building.polygon, x_m, y_m)
        if mesh is not None:
            unseen_m2 = unseen_roof_area_m2(mesh, x_m, y_m)
        overhang_m = mean_overhang_m(building.rings[0], building.point_m, building.classification)
    is_like_trees = row.is_own_outline and is_fitted and share_within_20cm < _MIN_NEAR_SHARE
    is_near = status == "ok" and residual_m <= config.not_representable_m and not is_like_trees
    return Result(
        reconstruction,
        status,
        reason,
        len(building.point_m),
        residual_m,
        visible_share,
        is_fitted and is_far,
        row.columns,
        row.registration,
        rmse_m,
        share_within_20cm,
        is_reliable=is_near and visible_share >= 0.5,
        dates=row.dates,
        ground=row.ground,
        overhang_m=overhang_m,
        measures=measure(reconstruction.placed_mesh) if reconstruction.has_mesh else None,
        unseen_roof_area_m2=unseen_m2,
        sample_m=np.column_stack([point_m, distance_m])[:: stride(len(point_m), _MAX_SAMPLE_POINTS)].astype(
            np.float32
        ),
        failure=row.failure,
        num_lines=building.num_lines,
        is_like_trees=is_like_trees,
    )


def failed(row: Row, method: str) -> Result:
    """The result of a row at which even the flat roof, or a measure of it, has failed: without a mesh, computing
    nothing."""
    reason, unknown = reasons.INTERNAL_ERROR, float("nan")
    return Result(
        no_mesh(row.building, method, reason),
        "none",
        reason,
        len(row.building.point_m),
        residual_m=unknown,
        visible_share=unknown,
        not_representable=False,
        columns=row.columns,
        registration=row.registration,
        dates=row.dates,
        ground=row.ground,
        failure=row.failure,
        num_lines=row.building.num_lines,
    )


def summary(results: Iterable[Result | SceneBuilding]) -> str:
    """One line: how many of each status, and why.

    ``74 buildings: 72 ok, 1 flat (too-few-points: 1), 1 none (no-points: 1); 2 of them not representable``
    """
    reasons: dict[str, Counter[str | None]] = {status: Counter() for status in STATUSES}
    num_flagged = num_lines = num_used = 0
    for result in results:
        reasons[result.status][result.reason] += 1
        num_flagged += result.not_representable
        if isinstance(result, Result) and result.num_lines:
            num_lines += result.num_lines
            num_used += result.reconstruction.num_lines_used
    parts = []
    for status, of_status in reasons.items():
        text = ", ".join(f"{reason}: {of_status[reason]}" for reason in sorted(filter(None, of_status)))
        if of_status or status == "ok":
            parts.append(f"{of_status.total()} {status}" + (f" ({text})" if text else ""))
    flagged = f"; {num_flagged} of them not representable" if num_flagged else ""
    lines = f"; of {num_lines} lines {num_used} used, {num_lines - num_used} unused" if num_lines else ""
    num_results = sum(each.total() for each in reasons.values())
    return f"{num_results} buildings: " + ", ".join(parts) + flagged + lines
