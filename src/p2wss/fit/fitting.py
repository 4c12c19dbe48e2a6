"""Buildings fitted to their points."""

from collections.abc import Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace

import numpy as np
import shapely

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.data.points import MIN_CLASSIFIED_POINTS, MIN_HEIGHT_M
from p2wss.fit.parametric import MIN_NUM_POINTS, fit_roof, kernel_mesh
from p2wss.fit.planes.fit import PlanesFit, fit_planes
from p2wss.fit.points import ground_points, shaft_points, wall_hits
from p2wss.fit.roof_edges import move_walls
from p2wss.fit.settings import THRESHOLDS, Planes, Thresholds
from p2wss.mesh import Mesh
from p2wss.mesh.planar import with_exact_faces, without_straight_vertices
from p2wss.mesh.surface import topmost
from p2wss.skeleton.types import FaceKind

METHOD = "fit"
# if set, each fit appends the id of the building and its planes, or None: for those who ask why a roof is as it is
TRACE: ContextVar[list[tuple[str, PlanesFit | None]] | None] = ContextVar("trace", default=None)
# points of class ground, or low ones in a gap of the roof, this far inside the footprint show that no building is there
_GROUND_INSIDE_M = 0.5
# a level face higher above the ground than this is a roof, whatever points are over it
_MAX_FLOOR_M = 2.0


def fit(
    buildings: Sequence[Building], config: Reconstruct, thresholds: Thresholds = THRESHOLDS
) -> list[Reconstruction]:
    """One reconstruction per building, in order: the solid below the planes that the points on its roof show. With too
    few points for planes, or where ``config.roofs`` asks for it, the parametric building nearest to them.
    Deterministic.
    """
    return [fit_building(_Task(building, config, thresholds)) for building in buildings]


@dataclass(frozen=True)
class _Task:
    """One building to fit."""

    building: Building
    config: Reconstruct
    thresholds: Thresholds


@dataclass(frozen=True)
class _Prepared:
    """A footprint and the points to which roofs are fitted.

    rings: the footprint, with its walls where the roof begins. point_m: (m, 3), the points on the roof, then the points
    of open ground. num_open: the number of points of open ground.
    """

    rings: Sequence[np.ndarray]
    point_m: np.ndarray
    num_open: int


@dataclass(frozen=True)
class _Solid:
    """A building before its last steps.

    num_parts: the number of bodies, with steps between them. eave_height_m: the eave of the largest body. angle_deg:
    the angle at each edge of the footprint. is_parametric: whether this is the building of the paper; if so, ``planes``
    is None.
    """

    mesh: Mesh
    num_parts: int
    eave_height_m: float
    angle_deg: np.ndarray
    is_parametric: bool
    planes: PlanesFit | None = None


def fit_building(task: _Task) -> Reconstruction:
    """The reconstruction of a building: all steps from its points to its mesh, in order."""
    prepared = prepare(task)
    if isinstance(prepared, str):
        return no_mesh(task.building, METHOD, prepared)
    solid = cover_with_planes(task, prepared) or raise_parametric(task, prepared)
    if isinstance(solid, str):
        return no_mesh(task.building, METHOD, solid)
    if (trace := TRACE.get()) is not None:
        trace.append((task.building.building_id, solid.planes))
    mesh = solid.mesh if solid.is_parametric else remove_short_edges(task, solid.mesh)
    return _reconstruction(task, prepared, solid, mesh)


def prepare(task: _Task) -> _Prepared | str:
    """The points on the roof, and a footprint whose walls stand where the roof begins; or the reason why there are not
    enough points."""
    building, config = task.building, task.config
    if not len(building.point_m):
        return reasons.NO_POINTS
    if len(building.point_m) < config.min_num_points:
        return reasons.TOO_FEW_POINTS
    roof_m = building.point_m[building.is_on_building]
    # a return from a wall says nothing of the roof above it
    roof_m = roof_m[~wall_hits(roof_m)]
    points = (roof_m, building.point_m, building.classification)
    rings = move_walls(building.rings, *points, config.max_wall_shift_m)
    polygon = shapely.Polygon(rings[0], rings[1:])
    roof_m = roof_m[shapely.contains_xy(polygon, roof_m[:, 0], roof_m[:, 1])]
    if len(roof_m) < MIN_NUM_POINTS:
        return reasons.TOO_FEW_ROOF_POINTS
    open_m = np.zeros((0, 3))
    if len(roof_m) >= MIN_CLASSIFIED_POINTS:
        open_m = ground_points(polygon, building.point_m, building.classification, _GROUND_INSIDE_M)
        shaft_m = shaft_points(polygon, building.point_m, building.classification, roof_m, _GROUND_INSIDE_M)
        is_ground = shaft_m[:, 2] < MIN_HEIGHT_M
        roof_m, open_m = np.vstack([roof_m, shaft_m[~is_ground]]), np.vstack([shaft_m[is_ground], open_m])
    return _Prepared(rings, np.vstack([roof_m, open_m]), len(open_m))


def cover_with_planes(task: _Task, prepared: _Prepared) -> _Solid | None:
    """The solid below the planes that the points show; None where there are too few of them, or the parametric model is
    asked for."""
    config, thresholds = task.config, task.thresholds
    point_m, around_m = prepared.point_m, task.building.around_m
    # points on the roofs around count, too: they show what a house with few points on its roof shares with its row
    if config.roofs == "parametric" or len(point_m) + len(around_m) < thresholds.min_plane_points:
        return None

    def raised(each_m: np.ndarray) -> np.ndarray:
        # open ground gets the lowest roof
        return np.column_stack([each_m[:, :2], np.maximum(each_m[:, 2], config.min_eave_height_m)])

    settings = thresholds.planes.times(thresholds.detail[config.detail])
    area_m2 = shapely.Polygon(prepared.rings[0], prepared.rings[1:]).area
    has_few = len(point_m) < thresholds.known_per_m2 * area_m2
    supposed_m = raised(task.building.supposed_m) if has_few else np.zeros((0, 3))
    planes = fit_planes(
        prepared.rings,
        raised(point_m),
        settings,
        prepared.num_open,
        around_m,
        known_roof(task, prepared, supposed_m, settings) if has_few else None,
        supposed_m,
        task.building.line_m,
    )
    if planes is None:
        return None
    return _Solid(planes.mesh, planes.num_bodies, *planes.parameters(prepared.rings), False, planes)


def known_roof(task: _Task, prepared: _Prepared, supposed_m: np.ndarray, settings: Planes) -> Mesh | None:
    """The roof with which the search for planes begins, as few points hardly show how roofs meet. It is fitted to
    places (s, 3) at heights that a network supposes; without these, it is the parametric building of the paper."""
    supposed = fit_planes(prepared.rings, supposed_m, settings) if len(supposed_m) else None
    solid = supposed or raise_parametric(task, prepared)
    return None if isinstance(solid, str) else solid.mesh


def raise_parametric(task: _Task, prepared: _Prepared) -> _Solid | str:
    """The parametric building of the paper that is nearest to the points; or the reason why there is none."""
    rings, top_m = prepared.rings, task.config.max_roof_height_m
    roof = fit_roof(rings, prepared.point_m, task.thresholds.parametric, top_m)
    if roof is None:
        return reasons.NO_ROOF
    eave_m = max(roof.eave_z_m, task.config.min_eave_height_m)
    mesh = kernel_mesh(rings, roof.angle_deg, eave_m, top_m)
    if mesh is None:
        return reasons.NO_ROOF
    return _Solid(mesh, 1, roof.eave_z_m, roof.angle_deg, True)


def remove_short_edges(task: _Task, mesh: Mesh) -> Mesh:
    """The mesh without short edges, and without the vertices that vanished faces leave within an edge of two others."""
    return without_straight_vertices(with_exact_faces(mesh, task.thresholds.short_edge_m))


def _reconstruction(task: _Task, prepared: _Prepared, solid: _Solid, mesh: Mesh) -> Reconstruction:
    building = task.building
    return Reconstruction(
        building.building_id,
        building.tile,
        METHOD,
        reasons.OK,
        building.origin_xy_m,
        building.ground_z_m,
        prepared.rings,
        max(solid.eave_height_m, task.config.min_eave_height_m),
        solid.angle_deg,
        with_floors(mesh, prepared.point_m, prepared.num_open),
        solid.num_parts,
        is_simplified=solid.planes is not None and solid.planes.is_simplified,
        num_lines_used=0 if solid.planes is None else solid.planes.num_lines_used,
    )


def with_floors(mesh: Mesh, point_m: np.ndarray, num_open: int) -> Mesh:
    """The mesh with the kind ``FLOOR`` for open ground within the footprint, which stays where the building would be in
    pieces without it. At least one face remains a roof.

    point_m: (m, 3), the points to which the roof is fitted; the last ``num_open`` are of open ground. A face
    is open ground if it is level, at most 2 m above the ground, and most of the points over it are of open ground.
    """
    if not num_open:
        return mesh
    kind = mesh.kind
    is_low = (kind == FaceKind.FLAT) & (mesh.corner_m[:, :, 2].max(axis=1) <= _MAX_FLOOR_M)
    # the label of the face over each point plus one, 0 for none
    over = np.append(mesh.label[is_low], -1)[topmost(mesh.corner_m[is_low], point_m)[0]] + 1
    size = mesh.label.max() + 2
    num, num_ground = (np.bincount(each, minlength=size) for each in (over, over[-num_open:]))
    is_floor = is_low & (2 * num_ground > num)[mesh.label + 1]
    is_roof = ((kind == FaceKind.ROOF) | (kind == FaceKind.FLAT)) & ~is_floor
    kind = np.where(is_floor, np.uint8(FaceKind.FLOOR), kind)
    return replace(mesh, kind=kind) if is_roof.any() else mesh
