"""Why a mesh is off its points, measured: what the report says of the worst buildings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from p2wss.data.building import Reconstruction
from p2wss.eval.cases import Case
from p2wss.eval.measure import FAR_M, local_points, points_on_building
from p2wss.metrics.height import surface_height_m
from p2wss.metrics.surface import distance_to_mesh, triangle_areas
from p2wss.skeleton.types import FaceKind

SPARSE_PER_M2, SPARSE_POINTS = 1.0, 50
OCCLUDED_SHARE = 0.5
# a roof as a whole is too high or too low where what is left after a shift is this small, and this much smaller
_SHIFTED_M, _SHIFT_GAIN = 0.5, 0.5
# points this near belong together
_LINK_M = 1.0
_MIN_CLUSTER_POINTS = 8
_ANNEX_SHARE, _DORMER_SHARE = 0.05, 0.02
_DORMER_M2 = 15.0
_EDGE_M = 1.0


@dataclass(frozen=True)
class Reason:
    """kind: one word or two, for counting. sentence: with the figures that led to it."""

    kind: str
    sentence: str


@dataclass(frozen=True)
class Cluster:
    """Points together more than 0.5 m above or below the roof, and from the mesh: their share of those on the
    building, median height over the roof, area in m2 of metre cells, and whether they reach the footprint's edge."""

    share: float
    height_m: float
    area_m2: float
    at_edge: bool


def reason(case: Case, made: Reconstruction, num_parts: int = 1) -> Reason:
    """The first cause that the points show. num_parts: heights that the fit with parts found, if it was run."""
    if not made.has_mesh:
        return Reason("no mesh", f"No mesh: {made.status}.")
    chosen = points_on_building(case)
    point_m = local_points(case, made)[chosen]
    if len(point_m) < SPARSE_POINTS or len(point_m) < SPARSE_PER_M2 * case.building.polygon.area:
        density = len(point_m) / case.building.polygon.area
        return Reason("sparse", f"Sparse: {len(point_m)} points on the building, {density:.1f} per m².")
    above = point_m[:, 2] - surface_height_m(point_m[:, :2], made.vertex_m, made.triangle)
    distance = distance_to_mesh(point_m, made.vertex_m, made.triangle)
    beside, off = float(np.isnan(above).mean()), float(distance.mean())
    known = ~np.isnan(above)
    place, above, distance = point_m[known], above[known], distance[known]
    if beside > 0.2 or not len(above):
        return Reason(
            "footprint", f"Footprint: {beside:.0%} of the points on the building lie beside the mesh."
        )
    shift = float(np.median(above))
    # medians: points on walls are far below the roof
    spread = float(np.median(np.abs(above - shift)))
    if abs(shift) > FAR_M and spread < min(_SHIFTED_M, _SHIFT_GAIN * np.median(np.abs(above))):
        way = "low" if shift > 0 else "high"
        return Reason(
            "height error",
            f"Height error: the roof lies {abs(shift):.1f} m too {way}; moved by that, half of the points would "
            f"be within {spread:.2f} m of it.",
        )
    # what is far below the roof but near the mesh is on a wall
    over = np.where(distance > FAR_M, above, 0.0)
    high, low = _largest(case, place, over, made, 1), _largest(case, place, over, made, -1)
    heights = num_parts > 1 and made.num_parts == 1
    if low is not None and low.share >= _ANNEX_SHARE and low.at_edge and not (heights and low.share > 0.3):
        return Reason(
            "garage or annex",
            f"Garage or annex: {low.share:.0%} of the points ({low.area_m2:.0f} m², at the edge) lie "
            f"{-low.height_m:.1f} m below the roof.",
        )
    if heights:
        return Reason(
            "several heights",
            f"Several heights: the points ask for {num_parts} parts, the mesh has one height; "
            f"{(distance > FAR_M).mean():.0%} of the points are more than {FAR_M:g} m off.",
        )
    if high is not None and high.share >= _DORMER_SHARE:
        where = "at the edge" if high.at_edge else "inside"
        small = high.area_m2 <= _DORMER_M2
        return Reason(
            "dormer" if small else "higher part",
            f"{'Dormer or structure on the roof' if small else 'Higher part'}: {high.share:.0%} of the points "
            f"({high.area_m2:.0f} m², {where}) lie {high.height_m:.1f} m above the mesh.",
        )
    if case.visible_roof_share < OCCLUDED_SHARE:
        return Reason("occluded", f"Occluded: {case.visible_roof_share:.0%} of the roof has points.")
    far = float((distance > FAR_M).mean())
    if off > 0.25:
        return Reason(
            "roof shape",
            f"Shape of the roof: {far:.0%} of the points are more than {FAR_M:g} m off, in no one place.",
        )
    blind = _blind_share(made)
    return Reason(
        "walls",
        f"Walls and ground: the roof fits to {off:.2f} m; {blind:.0%} of the mesh's area is walls and ground, "
        "where the cloud has few points.",
    )


def _largest(
    case: Case, place: np.ndarray, above: np.ndarray, made: Reconstruction, sign: int
) -> Cluster | None:
    """The largest group of points beyond 0.5 m on one side of the roof."""
    own = np.flatnonzero(sign * above > FAR_M)
    if len(own) < _MIN_CLUSTER_POINTS:
        return None
    pairs = cKDTree(place[own, :2]).query_pairs(_LINK_M, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(own),) * 2)
    label = connected_components(links, directed=False)[1]
    group = own[label == np.bincount(label).argmax()]
    if len(group) < _MIN_CLUSTER_POINTS:
        return None
    cells = np.unique(np.floor(place[group, :2]), axis=0)
    boundary = shapely.affinity.translate(
        case.building.polygon, *np.subtract(case.building.origin_xy_m, made.origin_xy_m)
    ).boundary
    near = shapely.distance(boundary, shapely.points(place[group, :2])) < _EDGE_M
    return Cluster(
        share=len(group) / len(above),
        height_m=float(np.median(above[group])),
        area_m2=float(len(cells)),
        at_edge=bool(near.sum() >= _MIN_CLUSTER_POINTS),
    )


def _blind_share(made: Reconstruction) -> float:
    area = triangle_areas(made.vertex_m, made.triangle)
    blind = np.isin(made.kind, (FaceKind.GROUND, FaceKind.WALL))
    return float(area[blind].sum() / area.sum())
