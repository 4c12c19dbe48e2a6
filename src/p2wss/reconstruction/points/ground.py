"""The ground of each building: the first source of a chain that is not above what the building's own points allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2wss.clouds.cropping import crop_points
from p2wss.clouds.crops import LOWEST_RINGS_M, CloudCrops, low_height, lowest_points
from p2wss.clouds.reading import Cloud
from p2wss.data import polygon_arrays
from p2wss.data.las_classes import BUILDING_CLASS, PLANT_CLASSES, has_class
from p2wss.data.points import MIN_HEIGHT_M
from p2wss.data.terrain import Terrain
from p2wss.fit.points import quantile
from p2wss.skeleton.types import Polygons

# where the ground of a building is from
AROUND, TERRAIN, LOWEST, STOREY = "around", "terrain", "lowest-points", "storey"
# without points and terrain: the median ground of the nearest buildings
BUILDINGS = "nearest-buildings"
# where the ground is not seen: the lowest points around, hardly any of class ground, or the lowest of the building
UNSEEN = UNCLASSIFIED, OWN = "unclassified-points", "own-points"


@dataclass(frozen=True)
class Rules:
    """Where the ground of a building may be; set by hand from drawn old towns.

    lowest_roof_m: the lowest roof is at least this high. storey_m: height of the low roof if nothing else is known.
    low_quantile: this quantile of the heights of the roof's points is the low roof; lower points may be of a shaft, or
    of a neighbour's roof. roof_share: if at least this share of a building's points has class building, only these show
    the roof, else all points do. step_m: points without class building may be ground, unless they are this much above
    the points beside. ground_step_m: points of class building within this height of the ground around are taken as
    ground, if they are at most half. min_own_points: least number of points that show a roof. terrain_sd_m,
    storey_sd_m: expected standard deviations where no points show the ground.
    """

    lowest_roof_m: float = 1.0
    storey_m: float = 3.0
    low_quantile: float = 0.05
    roof_share: float = 0.2
    step_m: float = 2.0
    ground_step_m: float = 0.5
    min_own_points: int = 5
    terrain_sd_m: float = 0.5
    storey_sd_m: float = 3.0


RULES = Rules()


@dataclass(frozen=True)
class Grounds:
    """The ground of each building. z_m: (n,); NaN without points and terrain: such a building gets the ground of the
    nearest buildings. source: object (n,). sd_m: (n,), the standard deviation of ``z_m``; NaN for the usual source, the
    ground around the footprint."""

    z_m: np.ndarray
    source: np.ndarray
    sd_m: np.ndarray


def ground_of(cloud: Cloud, cropped: CloudCrops, polygons: Polygons, terrain: Terrain | None) -> Grounds:
    """The ground of buildings: usually the ground points around the footprint.

    The terrain is the mean of its heights at the vertices of the footprint. A building without points stands on the
    terrain. If the ground around is too high for the points on the roof, the ground is the first of these that is low
    enough: the terrain, the lowest points around that are below the roof, or a storey below the roof. Where no ground
    is seen around, it is the terrain, else the lowest unclassified points around, else the lowest of the building's own
    points.
    """
    count = len(cropped.ground_z_m)
    z_m, sd_m = cropped.ground_z_m.copy(), cropped.guess_sd_m.copy()
    is_guess = np.isfinite(sd_m)
    source = np.where(is_guess, UNCLASSIFIED, AROUND).astype(object)
    is_unseen = is_guess | cropped.is_foot
    terrain_z = np.full(count, np.nan)
    highest_z = np.full(count, np.inf)
    for p in range(count):
        some = slice(cropped.offset[p], cropped.offset[p + 1])
        near, inside = cropped.point[some], cropped.inside[some]
        is_solid = ~has_class(cloud.classification[near], PLANT_CLASSES)
        own, beside = near[inside & is_solid], near[~inside & is_solid]
        roof = own[cloud.classification[own] == BUILDING_CLASS]
        if len(roof) < RULES.roof_share * len(own):
            roof = own
        # points to which the producer gave class building may be of the ground beside the building
        higher = roof[np.abs(cloud.z_m[roof] - z_m[p]) > RULES.ground_step_m]
        if roof is not own and 2 * len(higher) >= len(roof):
            roof = higher
        if len(roof) >= RULES.min_own_points:
            low_z, low_beside_z = (
                quantile(cloud.z_m[each], RULES.low_quantile) if len(each) else np.inf
                for each in (roof, beside)
            )
            # points without class building may be of the ground, if the points beside are not far below them
            may_be_ground = roof is own and low_z < low_beside_z + RULES.step_m
            # points without class building count as a roof only from a greater height on
            lowest_m = MIN_HEIGHT_M if roof is own else RULES.lowest_roof_m
            highest_z[p] = low_z + (RULES.lowest_roof_m if may_be_ground else -lowest_m)
        if terrain is not None and (len(own) == 0 or z_m[p] > highest_z[p] or is_unseen[p]):
            corner = slice(polygons.vertex_offset[p], polygons.vertex_offset[p + 1])
            height_m = terrain.interpolated(*polygons.xy_m[corner].T)
            terrain_z[p] = np.nanmean(height_m) if np.isfinite(height_m).any() else np.nan
    is_empty = (np.diff(cropped.offset) == 0) & np.isfinite(terrain_z)
    z_m[is_empty], source[is_empty], sd_m[is_empty] = terrain_z[is_empty], TERRAIN, RULES.terrain_sd_m
    too_high = np.flatnonzero((z_m > highest_z) | is_unseen)
    lowest = lowest_points(cloud) if len(too_high) else too_high
    around, _, offset = crop_points(
        cloud.x_m[lowest], cloud.y_m[lowest], polygon_arrays.take(polygons, too_high), LOWEST_RINGS_M[0]
    )
    for k, p in enumerate(too_high.tolist()):
        low = lowest[around[offset[k] : offset[k + 1]]]
        low = low[cloud.z_m[low] < highest_z[p]]
        if terrain_z[p] < highest_z[p]:
            z_m[p], source[p], sd_m[p] = terrain_z[p], TERRAIN, RULES.terrain_sd_m
        elif len(low) and z_m[p] > highest_z[p]:
            z_m[p] = min(low_height(cloud, low, polygons.rings(p)[0]), highest_z[p])
            source[p], sd_m[p] = LOWEST, np.std(cloud.z_m[low])
        elif z_m[p] > highest_z[p] or cropped.is_foot[p]:
            if z_m[p] > highest_z[p]:
                z_m[p] = highest_z[p] - RULES.storey_m + RULES.lowest_roof_m
            source[p], sd_m[p] = OWN if cropped.is_foot[p] else STOREY, RULES.storey_sd_m
    return Grounds(z_m, source, sd_m)
