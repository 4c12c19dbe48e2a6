"""Chimneys: small upright boxes with level tops that stand on a finished roof.

A chimney has few returns, so that it never pays as a part or a dormer of the roof does, and it changes nothing else:
boxes are added to a mesh that is not fitted again. What few returns show is uncertain, so they have to look like a
chimney: close together, level, with a roof around them, and nothing but them between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import shapely

from p2wss.fit.directions import directions
from p2wss.fit.mesh.simplification import is_sound, simplified
from p2wss.fit.settings import Chimneys
from p2wss.mesh import Mesh
from p2wss.mesh.booleans import manifold3d
from p2wss.mesh.surface import topmost
from p2wss.skeleton.groups import groups
from p2wss.skeleton.types import FaceKind

# returns from one top are at most this far apart in plan, and in height
_APART_M, _STEP_M = 0.7, 0.3
# a side lies midway to the next return from the roof, but at most this far from those inside
_MAX_GAP_M = 0.15
# a side is moved so far, beyond a wall, if less than this share of the strip there is within the footprint
_TO_WALL_M, _INSIDE_SHARE = 0.15, 0.9
# degrees: directions of walls that differ less are the same
_SAME_DEG = 4.0
# how much wider a chimney gets on each side, at most, until its union with the building is sound
_WIDER_M = (0.0, 0.05, 0.1)
# vertices below this height are those of the floor
_FLOOR_M = 1e-3
# larger residuals count as this, as in the fit
_CAP_M = 1.0
# a narrow row of returns beside a wall is from the edge of the roof on its other side
_THIN_M, _BESIDE_WALL_M = 0.2, 0.3
# the roof around a chimney has returns within this distance, most of which are this close to its planes
_AROUND_M, _ON_ROOF_M = 0.5, 0.3


@dataclass(frozen=True)
class Chimney:
    """A rectangle along the axes from ``low`` to ``high``, each (2,), and the height of its top."""

    low: np.ndarray
    high: np.ndarray
    top_z_m: float


def find_chimneys(mesh: Mesh, point_m: np.ndarray, chimneys: Chimneys) -> list[Chimney]:
    """The chimneys that points (m, 3) show above the roof of a mesh, both in a frame whose axes they follow."""
    point_m = np.ascontiguousarray(point_m, np.float64)
    triangle, roof_z = topmost(np.ascontiguousarray(mesh.corner_m), point_m)
    point_m, above_m = point_m[triangle >= 0], (point_m[:, 2] - roof_z)[triangle >= 0]
    clusters = _clusters(point_m, above_m, chimneys)
    if not clusters:
        return []
    walls = _walls(mesh)
    side_m = np.diff(mesh.corner_m[mesh.kind == FaceKind.GROUND, :, :2], axis=1)
    area_m2 = 0.5 * float(np.abs(np.linalg.det(side_m)).sum())
    max_area_m2 = min(chimneys.max_area_m2, chimneys.max_share * area_m2)
    result = []
    for cluster in clusters:
        xy = point_m[cluster, :2]
        if (
            np.ptp(xy, axis=0).min() < _THIN_M
            and walls.distance(shapely.Point(xy.mean(axis=0))) < _BESIDE_WALL_M
        ):
            continue
        chimney = _chimney(point_m, above_m, cluster, max_area_m2, chimneys)
        if chimney is not None:
            result.append(chimney)
    return result


def _walls(mesh: Mesh) -> shapely.MultiLineString:
    """The walls of a mesh in plan."""
    sides = mesh.corner_m[mesh.kind == FaceKind.WALL][:, [[0, 1], [1, 2], [2, 0]], :2]
    return shapely.MultiLineString(list(sides.reshape(-1, 2, 2)))


def _clusters(point_m: np.ndarray, above_m: np.ndarray, chimneys: Chimneys) -> list[np.ndarray]:
    """Indices of the points above the roof, in groups that may be from one top."""
    high = np.flatnonzero(above_m > chimneys.min_rise_m)
    if len(high) < chimneys.min_points:
        return []
    scaled = point_m[high] / (_APART_M, _APART_M, _STEP_M)
    first, second = scipy.spatial.cKDTree(scaled).query_pairs(2**0.5, output_type="ndarray").T
    plan, step = (scaled[first] - scaled[second])[:, :2], scaled[first, 2] - scaled[second, 2]
    near = ((plan**2).sum(axis=1) <= 1.0) & (np.abs(step) <= 1.0)
    label = groups(len(high), np.column_stack([first[near], second[near]]))
    clusters = [high[label == k] for k in range(label.max() + 1)]
    return [cluster for cluster in clusters if len(cluster) >= chimneys.min_points]


def _chimney(
    point_m: np.ndarray, above_m: np.ndarray, cluster: np.ndarray, max_area_m2: float, chimneys: Chimneys
) -> Chimney | None:
    """The chimney whose top has the points ``cluster``, None if they do not look like one."""
    top = float(np.median(point_m[cluster, 2]))
    if np.median(above_m[cluster]) > chimneys.max_rise_m:
        return None
    xy = point_m[:, :2]
    low, high = xy[cluster].min(axis=0), xy[cluster].max(axis=0)
    if (high - low).max() > chimneys.max_width_m:
        return None
    on_roof = np.abs(above_m) < _ON_ROOF_M
    low, high = _grown(xy[on_roof], low, high, chimneys.min_width_m)
    width, length = sorted((high - low).tolist())
    if length > chimneys.max_ratio * width or width * length > max_area_m2:
        return None
    within = ((xy >= low) & (xy <= high)).all(axis=1)
    around = ((xy >= low - _AROUND_M) & (xy <= high + _AROUND_M)).all(axis=1) & ~within
    # returns from the sides lie below the top
    is_solid = (above_m > _ON_ROOF_M) & (point_m[:, 2] < top + _STEP_M)
    if (within & is_solid).sum() < chimneys.solid_share * within.sum():
        return None
    if not around.any() or (around & on_roof).sum() < chimneys.around_share * around.sum():
        return None
    gain = np.minimum(np.abs(above_m[within]), _CAP_M) - np.minimum(np.abs(point_m[within, 2] - top), _CAP_M)
    return Chimney(low, high, top) if gain.sum() >= chimneys.price_m else None


def _grown(
    roof_xy: np.ndarray, low: np.ndarray, high: np.ndarray, min_width_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """The rectangle with sides midway to the next points on the roof, and no narrower than ``min_width_m``."""
    low, high = low.copy(), high.copy()
    gaps = np.full((2, 2), _MAX_GAP_M)
    for axis in range(2):
        across = roof_xy[:, 1 - axis]
        beside = roof_xy[(across >= low[1 - axis]) & (across <= high[1 - axis]), axis]
        for side, gap in enumerate((low[axis] - beside, beside - high[axis])):
            gaps[side, axis] = min(0.5 * gap[gap > 0].min(initial=np.inf), _MAX_GAP_M)
    low, high = low - gaps[0], high + gaps[1]
    missing = np.maximum(min_width_m - (high - low), 0.0) / 2
    return low - missing, high + missing


def with_chimneys(mesh: Mesh, rings: Sequence[np.ndarray], point_m: np.ndarray, chimneys: Chimneys) -> Mesh:
    """The mesh with those chimneys that points (m, 3) on the roof show and with which it is sound. They end at the
    walls of the building, over the footprint ``rings``, and are parallel to most of them."""
    angle = directions(rings, _SAME_DEG)[0]
    along = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned, local_m = mesh.turned(along), np.column_stack([point_m[:, :2] @ along, point_m[:, 2]])
    found = find_chimneys(turned, local_m, chimneys)
    if not found:
        return mesh
    footprint = shapely.Polygon(rings[0] @ along, [ring @ along for ring in rings[1:]])
    for chimney in found:
        turned = _united(turned, _to_walls(chimney, footprint)) or turned
    return turned.turned(along.T)


def _to_walls(chimney: Chimney, footprint: shapely.Polygon) -> Chimney:
    """The chimney with those sides moved outwards beside which the footprint ends nearly there."""
    bounds = np.concatenate([chimney.low, chimney.high])
    # for each side the bounds of the strip beyond it
    strips = np.tile(bounds, (4, 1))
    for side in range(4):
        strips[side, side] += -_TO_WALL_M if side < 2 else _TO_WALL_M
        strips[side, (side + 2) % 4] = bounds[side]
    beyond = shapely.box(*strips.T)
    inside_m2 = shapely.area(shapely.intersection(beyond, footprint))
    bounds = np.where(inside_m2 < _INSIDE_SHARE * shapely.area(beyond), strips.diagonal(), bounds)
    return Chimney(bounds[:2], bounds[2:], chimney.top_z_m)


def _united(mesh: Mesh, chimney: Chimney) -> Mesh | None:
    """The union of a mesh with a chimney, which is slightly wider if it is not sound otherwise; None if it is not sound
    at all."""
    whole = manifold3d.Manifold(
        manifold3d.Mesh64(np.ascontiguousarray(mesh.vertex_m), mesh.triangle.astype(np.uint64))
    )
    lowest_m = float(mesh.vertex_m[mesh.vertex_m[:, 2] > _FLOOR_M, 2].min())
    bottom_m = 0.5 * lowest_m
    # a solid with the walls of the building that ends above the chimney
    tall = whole.scale((1.0, 1.0, 2.0 * chimney.top_z_m / lowest_m))
    for wider_m in _WIDER_M:
        low, high = chimney.low - wider_m, chimney.high + wider_m
        size = [*(high - low).tolist(), chimney.top_z_m - bottom_m]
        box = manifold3d.Manifold.cube(size).translate((*low.tolist(), bottom_m)) ^ tall
        out = (whole + box).to_mesh64()
        triangle = np.array(out.tri_verts, np.int32)
        if box.is_empty() or not len(triangle):
            continue
        result = simplified(np.array(out.vert_properties, float)[:, :3], triangle)
        # a mesh that was not sound before stays as it was
        if result is not None and result.is_closed and (is_sound(result) or not is_sound(mesh)):
            return result
    return None
