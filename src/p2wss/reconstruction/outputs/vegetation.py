"""Trees and clumps of plants as simple closed volumes.

A crown is a basin of a watershed around a maximum of the smoothed height of the canopy (Q. Chen et al. 2006, "Isolating
individual trees in a savanna woodland using small footprint lidar data").
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
import scipy
import shapely

from p2wss.clouds.reading import Cloud
from p2wss.data.las_classes import PLANT_CLASSES
from p2wss.data.tiling import Bounds, grown
from p2wss.formats.meshes import VEGETATION
from p2wss.mesh import Mesh
from p2wss.reconstruction.points.cloud_index import CloudIndex
from p2wss.reconstruction.points.unclassified import ground_z_m, is_open, planar
from p2wss.reconstruction.running.failures import note, surviving
from p2wss.skeleton.angles import bearings


@dataclass(frozen=True)
class Rules:
    """What is a plant; chosen on simulated trees (``benchmarks/vegetation.py``).

    cell_m, smoothing_m: cell of the raster of heights, and standard deviation of its smoothing. spacing_m: a top is the
    highest place within this distance. min_height_m: least height above the ground of points of plants. min_num_points,
    min_area_m2: of a crown. base_quantile: a crown begins at this quantile of the heights of its points. beside_m: if
    the cloud has no classes of plants, points this near to a footprint belong to the building. num_sides: of a volume.
    tile_m, margin_m: points are read by tiles, with a margin that is more than the width of a crown.
    """

    cell_m: float = 0.5
    smoothing_m: float = 0.5
    spacing_m: float = 2.0
    min_height_m: float = 2.0
    min_num_points: int = 5
    min_area_m2: float = 1.0
    base_quantile: float = 0.05
    beside_m: float = 1.0
    num_sides: int = 8
    tile_m: float = 256.0
    margin_m: float = 16.0


RULES = Rules()


@dataclass(frozen=True)
class Plant:
    """A crown. mesh: closed, in the CRS of the run. height_m, base_m: heights of its top and its lower end above the
    ground. width_m: diameter of a circle with its area."""

    name: str
    mesh: Mesh
    height_m: float
    base_m: float
    width_m: float
    num_points: int

    @property
    def city_type(self) -> str:
        """The type of its city object; a plant wider than high is a clump or a hedge."""
        return "PlantCover" if self.width_m > self.height_m else "SolitaryVegetationObject"

    @property
    def attributes(self) -> dict[str, float]:
        """The attributes for files: height_m, base_m, width_m and num_points, rounded."""
        return {
            name: round(getattr(self, name), 2) for name in ("height_m", "base_m", "width_m", "num_points")
        }


def plants(points: CloudIndex, window: Bounds, footprints: np.ndarray) -> list[Plant]:
    """The plants with tops in a window, which the index must cover with a margin of 16 m. They are made of points of
    the classes of plants. If the cloud has no such points, they are made of points above the ground that lie outside
    ``footprints`` and on no plane."""
    outlines = shapely.STRtree(footprints)

    def of_tile(corner: tuple[float, float]) -> list[Plant]:
        x, y = corner
        tile = (
            max(x, window[0]),
            max(y, window[1]),
            min(x + RULES.tile_m, window[2]),
            min(y + RULES.tile_m, window[3]),
        )
        around = grown((x, y, x + RULES.tile_m, y + RULES.tile_m), RULES.margin_m)
        cloud = points.near(np.array([around]))
        # plants by the producer's classes, even where p2wss adds ground and buildings
        own = points.near(np.array([around]), adds_classes=False).classification
        is_plant = np.isin(own, PLANT_CLASSES) if points.has_plants else None
        return list(_plants(cloud, is_plant, around, tile, outlines)) if len(cloud) else []

    def none(corner: tuple[float, float], trace: str) -> list[list[Plant]]:
        note(f"vegetation around {corner[0]:.0f} {corner[1]:.0f}", trace, "there is none")
        return [[]]

    # tiles with points
    corners = np.unique(np.floor(points.places_m / RULES.tile_m), axis=0) * RULES.tile_m
    first, last = np.floor(np.reshape(window, (2, 2)) / RULES.tile_m) * RULES.tile_m
    corners = corners[((corners >= first) & (corners <= last)).all(axis=1)]
    return list(chain(*surviving(lambda some: map(of_tile, some), list(map(tuple, corners.tolist())), none)))


def _plants(
    cloud: Cloud, is_plant: np.ndarray | None, around: Bounds, tile: Bounds, outlines: shapely.STRtree
) -> Iterator[Plant]:
    """The plants with tops in a tile. is_plant: bool (n,), by the producer's classes; None if it has no classes of
    plants."""
    x_m, y_m = cloud.x_m, cloud.y_m
    ground_m = ground_z_m(cloud)
    height_m = cloud.z_m - ground_m
    row, column = (
        np.floor((values - low) / RULES.cell_m).astype(int)
        for values, low in ((y_m, around[1]), (x_m, around[0]))
    )
    shape = tuple(round((around[k + 2] - around[k]) / RULES.cell_m) for k in (1, 0))
    inside = (row >= 0) & (column >= 0) & (row < shape[0]) & (column < shape[1])
    may_be_plant = is_open(cloud.classification) if is_plant is None else is_plant
    chosen = np.flatnonzero(inside & may_be_plant & (height_m >= RULES.min_height_m))
    if is_plant is None:
        chosen = chosen[~planar(np.column_stack([x_m, y_m, cloud.z_m])[chosen])]
        place = shapely.points(x_m[chosen], y_m[chosen])
        near = outlines.query(place, predicate="dwithin", distance=RULES.beside_m)[0]
        chosen = np.delete(chosen, near)
    # sorted, so that the top among equally high points does not depend on their order in files
    chosen = chosen[np.lexsort([values[chosen] for values in (cloud.z_m, x_m, y_m)])]
    label = _basins(row[chosen], column[chosen], height_m[chosen], shape)
    chosen = chosen[label[row[chosen], column[chosen]] > 0]
    of_point = label[row[chosen], column[chosen]]
    area_m2 = np.bincount(np.maximum(label, 0).ravel()) * RULES.cell_m**2
    order = np.argsort(of_point, kind="stable")
    for own in np.split(chosen[order], np.flatnonzero(np.diff(of_point[order])) + 1):
        if len(own) < RULES.min_num_points:
            continue
        top = own[height_m[own].argmax()]
        size_m2 = area_m2[label[row[top], column[top]]]
        is_here = tile[0] <= x_m[top] < tile[2] and tile[1] <= y_m[top] < tile[3]
        if is_here and size_m2 >= RULES.min_area_m2:
            base_m, high_m = np.quantile(height_m[own], RULES.base_quantile), height_m[top]
            base_m = float(min(base_m, 0.8 * high_m))  # a volume, even of a flat crown
            mesh = _volume(
                np.column_stack([x_m[own], y_m[own]]), ground_m[top] + base_m, float(cloud.z_m[top])
            )
            # named by the cell of its top, which no other crown has; in decimetres, as some formats allow no dot
            place = [f"{10 * RULES.cell_m * (each[top] // RULES.cell_m):.0f}" for each in (x_m, y_m)]
            yield Plant(
                "_".join(["plant", *place]),
                mesh,
                float(high_m),
                base_m,
                float(np.sqrt(4 / np.pi * size_m2)),
                len(own),
            )


def _basins(row: np.ndarray, column: np.ndarray, height_m: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """int (rows, columns): the number of the crown of each cell, from 1; below 1 for a cell of no crown."""
    canopy_m = np.zeros(shape)
    np.maximum.at(canopy_m, (row, column), height_m)
    canopy_m = scipy.ndimage.grey_closing(canopy_m, 3)
    smooth_m = scipy.ndimage.gaussian_filter(canopy_m, RULES.smoothing_m / RULES.cell_m)
    reach = round(RULES.spacing_m / RULES.cell_m)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    highest_m = scipy.ndimage.maximum_filter(smooth_m, footprint=np.hypot(x, y) <= reach)
    is_canopy = canopy_m >= RULES.min_height_m
    top, _ = scipy.ndimage.label((smooth_m == highest_m) & is_canopy, np.ones((3, 3)))
    depth_cm = np.clip(65535 - 100 * smooth_m, 0, 65535).astype(np.uint16)
    label = scipy.ndimage.watershed_ift(depth_cm, np.where(is_canopy, top, -1).astype(np.int32))
    # the basins of what is no canopy take the rims of crowns, too: give these back to the crown beside
    return np.where(is_canopy & (label < 1), scipy.ndimage.grey_dilation(label, 5), label)


def _volume(xy_m: np.ndarray, low_z_m: float, high_z_m: float) -> Mesh:
    """A closed volume around points (n, 2) between two heights: an ellipsoid whose radius in each horizontal direction
    reaches the farthest point there."""
    from trimesh.creation import uv_sphere  # takes longer to import than the rest

    def side(xy: np.ndarray) -> np.ndarray:
        return np.round(bearings(xy) / (2 * np.pi) * RULES.num_sides).astype(int) % RULES.num_sides

    middle = xy_m.mean(axis=0)
    radius_m = np.zeros(RULES.num_sides)
    np.maximum.at(radius_m, side(xy_m - middle), np.hypot(*(xy_m - middle).T))
    radius_m = np.maximum(radius_m, max(radius_m.mean() / 2, RULES.cell_m / 2))
    sphere = uv_sphere(count=[4, RULES.num_sides // 2])
    ring_m = middle + sphere.vertices[:, :2] * radius_m[side(sphere.vertices[:, :2]), None]
    vertex_m = np.column_stack([ring_m, low_z_m + (high_z_m - low_z_m) * (sphere.vertices[:, 2] + 1) / 2])
    triangle = np.asarray(sphere.faces, np.int32)
    kind = np.full(len(triangle), VEGETATION, np.uint8)
    return Mesh(vertex_m, triangle, kind, np.arange(len(triangle), dtype=np.int32))
