"""Why a mesh is far from its points: the causes that the report states for the worst buildings, with figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import cKDTree

from p2wss.data.building import Reconstruction
from p2wss.data.reasons import MEANINGS
from p2wss.eval.cases import Case, local_points
from p2wss.eval.metrics.height import surface_height_m
from p2wss.mesh import Mesh
from p2wss.mesh.surface import distance_to_mesh
from p2wss.mesh.topology import groups
from p2wss.skeleton.types import FaceKind

FAR_M = 0.5
# with a larger mean distance of points to mesh a building is one of those whose causes are counted
UNEXPLAINED_M = 0.25
SPARSE_PER_M2, SPARSE_POINTS = 1.0, 50
# with more of the points on the building beside the mesh, the footprint is the cause
_MAX_BESIDE_SHARE = 0.2
OCCLUDED_SHARE = 0.5
# a roof as a whole is too high or too low if a shift reduces the median gap below this, and below this share of it
_SHIFTED_M, _SHIFT_GAIN = 0.5, 0.5
# points this near to each other form a cluster
_LINK_M = 1.0
_MIN_CLUSTER_POINTS = 8
_ANNEX_SHARE, _DORMER_SHARE = 0.05, 0.02
# with more of the points, a low cluster of a building with several heights is one of its parts, not an annex
_MAX_ANNEX_SHARE = 0.3
_DORMER_M2 = 15.0
_EDGE_M = 1.0


@dataclass(frozen=True)
class Cause:
    """kind: a short phrase, for counting. sentence: the same as a sentence, with the figures that led to it."""

    kind: str
    sentence: str


@dataclass(frozen=True)
class Cluster:
    """A cluster of points more than 0.5 m above or below the roof and away from the mesh.

    share: of the points on the building. height_m: median height above the roof. area_m2: of the 1 m cells with
    such points. at_edge: whether the cluster reaches the edge of the footprint.
    """

    share: float
    height_m: float
    area_m2: float
    at_edge: bool


def cause_of_error(case: Case, reconstruction: Reconstruction, num_parts: int = 1) -> Cause:
    """The first cause, in a fixed order, that the points show.

    num_parts: number of parts of the building by the fit, 1 where the fit was not run.
    """
    mesh = reconstruction.mesh
    if mesh is None:
        return Cause("no mesh", f"No mesh: {MEANINGS.get(reconstruction.status, reconstruction.status)}.")
    on_building = case.building.is_on_building
    point_m = local_points(case, reconstruction)[on_building]
    if len(point_m) < SPARSE_POINTS or len(point_m) < SPARSE_PER_M2 * case.building.polygon.area:
        density = len(point_m) / case.building.polygon.area
        return Cause("sparse", f"Sparse: {len(point_m)} points on the building, {density:.1f} per m².")
    above = point_m[:, 2] - surface_height_m(point_m[:, :2], mesh.vertex_m, mesh.triangle)
    distance = distance_to_mesh(point_m, mesh.vertex_m, mesh.triangle)
    has_roof = ~np.isnan(above)
    beside, mean_distance_m = float((~has_roof).mean()), float(distance.mean())
    point_m, above, distance = point_m[has_roof], above[has_roof], distance[has_roof]
    if beside > _MAX_BESIDE_SHARE or not len(above):
        return Cause(
            "footprint", f"Footprint: {beside:.0%} of the points on the building lie beside the mesh."
        )
    return (
        _height_error(above)
        or _part_at_another_height(case, reconstruction, point_m, above, distance, num_parts)
        or _remaining_cause(case, reconstruction, distance, mean_distance_m)
    )


def _height_error(above_m: np.ndarray) -> Cause | None:
    """The cause of a roof that is too high or too low as a whole. above_m: heights of points above the roof, (n,)."""
    shift_m = float(np.median(above_m))
    # medians: points on walls are far below the roof
    spread_m = float(np.median(np.abs(above_m - shift_m)))
    if abs(shift_m) <= FAR_M or spread_m >= min(_SHIFTED_M, _SHIFT_GAIN * np.median(np.abs(above_m))):
        return None
    direction = "low" if shift_m > 0 else "high"
    return Cause(
        "height error",
        f"Height error: the roof is {abs(shift_m):.1f} m too {direction}; at the right height, half of the points "
        f"would be within {spread_m:.2f} m of it.",
    )


def _part_at_another_height(
    case: Case,
    reconstruction: Reconstruction,
    point_m: np.ndarray,
    above_m: np.ndarray,
    distance_m: np.ndarray,
    num_parts: int,
) -> Cause | None:
    """The cause of an annex, a dormer or several heights that the mesh lacks.

    point_m: (n, 3), points over the mesh. above_m: their heights above the roof. distance_m: to the mesh.
    """
    # a point far below the roof but near the mesh is on a wall
    gap_m = np.where(distance_m > FAR_M, above_m, 0.0)
    high, low = (_largest_cluster(case, point_m, gap_m, reconstruction, sign) for sign in (1, -1))
    several_heights = num_parts > 1 and reconstruction.num_parts == 1
    if (
        low is not None
        and low.share >= _ANNEX_SHARE
        and low.at_edge
        and not (several_heights and low.share > _MAX_ANNEX_SHARE)
    ):
        return Cause(
            "garage or annex",
            f"Garage or annex: {low.share:.0%} of the points ({low.area_m2:.0f} m², at the edge) lie "
            f"{-low.height_m:.1f} m below the roof.",
        )
    if several_heights:
        return Cause(
            "several heights",
            f"Several heights: the fit finds {num_parts} parts, the mesh has a single height; "
            f"{(distance_m > FAR_M).mean():.0%} of the points are more than {FAR_M:g} m from it.",
        )
    if high is not None and high.share >= _DORMER_SHARE:
        where = "at the edge" if high.at_edge else "inside"
        is_small = high.area_m2 <= _DORMER_M2
        return Cause(
            "dormer" if is_small else "higher part",
            f"{'Dormer or structure on the roof' if is_small else 'Higher part'}: {high.share:.0%} of the points "
            f"({high.area_m2:.0f} m², {where}) lie {high.height_m:.1f} m above the mesh.",
        )
    return None


def _remaining_cause(
    case: Case, reconstruction: Reconstruction, distance_m: np.ndarray, mean_distance_m: float
) -> Cause:
    """Occlusion, the shape of the roof, or what the points cannot show.

    distance_m: of points over the mesh to it. mean_distance_m: of all points on the building.
    """
    if case.visible_roof_share < OCCLUDED_SHARE:
        return Cause("occluded", f"Occluded: only {case.visible_roof_share:.0%} of the roof has points.")
    far = float((distance_m > FAR_M).mean())
    if mean_distance_m > UNEXPLAINED_M:
        return Cause(
            "roof shape",
            f"Shape of the roof: {far:.0%} of the points are more than {FAR_M:g} m from the mesh, scattered over it.",
        )
    unseen = _ground_and_wall_share(reconstruction.mesh)
    return Cause(
        "walls",
        f"Walls and ground: the roof fits to {mean_distance_m:.2f} m; {unseen:.0%} of the mesh's area is walls "
        "and ground, where the cloud has few points.",
    )


def _largest_cluster(
    case: Case, point_m: np.ndarray, gap_m: np.ndarray, reconstruction: Reconstruction, sign: int
) -> Cluster | None:
    """The largest cluster of points more than 0.5 m above (sign 1) or below (sign -1) the roof, if there is one."""
    far = np.flatnonzero(sign * gap_m > FAR_M)
    if len(far) < _MIN_CLUSTER_POINTS:
        return None
    pairs = cKDTree(point_m[far, :2]).query_pairs(_LINK_M, output_type="ndarray")
    label = groups(len(far), pairs)
    group = far[label == np.bincount(label).argmax()]
    if len(group) < _MIN_CLUSTER_POINTS:
        return None
    cells = np.unique(np.floor(point_m[group, :2]), axis=0)
    boundary = shapely.affinity.translate(
        case.building.polygon, *np.subtract(case.building.origin_xy_m, reconstruction.origin_xy_m)
    ).boundary
    near = shapely.distance(boundary, shapely.points(point_m[group, :2])) < _EDGE_M
    return Cluster(
        share=len(group) / len(gap_m),
        height_m=float(np.median(gap_m[group])),
        area_m2=float(len(cells)),
        at_edge=bool(near.sum() >= _MIN_CLUSTER_POINTS),
    )


def _ground_and_wall_share(mesh: Mesh | None) -> float:
    """The share of the mesh's area that faces the ground or stands upright."""
    if mesh is None:
        return 0.0
    unseen = np.isin(mesh.kind, (FaceKind.GROUND, FaceKind.WALL))
    return float(mesh.area_m2[unseen].sum() / mesh.area_m2.sum())
