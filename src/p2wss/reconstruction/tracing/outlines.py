"""Outlines of buildings from classified points alone, where there are no footprints.

Connected cells with points of class building are a block: buildings that touch. A block is split into buildings where
the height of its roofs jumps. The edge of a block is traced on the raster, regularised and fitted to the points
(:mod:`p2wss.reconstruction.tracing.outline_rings`). The seams between its buildings are straight lines through the
block, so neighbours share bit-identical walls. Points show the edges of roofs, which overhang the walls; each edge is
moved inwards by ``Outlines.overhang_m``.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pyproj
import rasterio.features
import scipy
import shapely
from rasterio.transform import Affine

from p2wss.clouds.cropping import crop_points
from p2wss.clouds.reading import Cloud
from p2wss.config import Outlines
from p2wss.data import polygon_arrays
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS, VEGETATION_CLASS, WATER_CLASS, has_class
from p2wss.data.points import MIN_HEIGHT_M
from p2wss.data.tiling import Bounds, grown
from p2wss.reconstruction.points.unclassified import filled, in_window, tiles
from p2wss.reconstruction.tracing.outline_rings import EdgePoints, directions, regularised, seam_lines
from p2wss.skeleton.groups import cell_neighbours, groups
from p2wss.storage.features import Features
from p2wss.storage.las_crs import horizontal
from p2wss.storage.messages import InputError, log

# a cell has at least this many points on average: if necessary, cells are larger than ``cell_m``, in steps of 5 cm, so
# that clouds of nearly the same density have the same cells
_POINTS_PER_CELL, _CELLS_PER_M = 2.0, 20
_NEIGHBOURS = 8
# with fewer points per square metre, outlines are coarse
_SPARSE = 1.0
_SQUARE = np.ones((3, 3), bool)
# a block is traced on a smoothed raster with cells smaller by this factor; the smoothing is in cells before that
_FINER, _SMOOTH_CELLS = 3, 0.8
# large buildings are split at smaller and smaller jumps in height, down to this
_LEAST_JUMP_M = 0.4
# pulses pass through more than this share of the cells of a crown. On a roof, they pass only at its edges, where walls
# may have any number of points
_MOST_CELLS = 0.5
# points up to this far from the trace of a block are used
_POINTS_MARGIN_M = 2.0
# first margin around a tile, which grows until blocks are whole; a block depends on this many cells beside it
_TILE_MARGIN_M, _BESIDE_CELLS = 64.0, 8
# the grid of seams, and how far a face may reach beyond the outline by rounding
_GRID_M, _TOLERANCE_M = 1e-3, 0.01


@dataclass(frozen=True)
class Raster:
    """Blocks and buildings in cells.

    building, block: int32 (rows, columns), the number of the building and of the block from 1, 0 outside. origin_m: x
    and y of the lower left corner; rows count to the north. density: points of class building per square metre.
    """

    building: np.ndarray
    block: np.ndarray
    origin_m: tuple[float, float]
    cell_m: float
    density: float

    @property
    def transform(self) -> Affine:
        """The transform from columns and rows to x and y."""
        return Affine(self.cell_m, 0, self.origin_m[0], 0, self.cell_m, self.origin_m[1])


@dataclass(frozen=True)
class CloudRaster(Raster):
    """The raster of a cloud. cell: int64 (n,), the index of the cell of each point, row by row. height_m: float64
    (rows, columns), the height of roofs."""

    cell: np.ndarray
    height_m: np.ndarray


def outlines_and_crowns(
    cloud: Cloud, settings: Outlines, is_classified: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """(the outlines of all buildings in the cloud, sorted by their lower left corners; the outlines of tree crowns).

    Both are object arrays of polygons. Neighbours share vertices along common walls. is_classified: whether class
    building is the producer's. If so, there are no outlines of crowns; else a warning says how many were left out.

    Raises :class:`InputError` if the cloud has no points, none of class building
    (:func:`p2wss.reconstruction.points.unclassified.with_classes` adds the class), or no outline of a building.
    """
    if not len(cloud):
        raise InputError("no outlines: the cloud has no points")
    is_building = cloud.classification == BUILDING_CLASS
    if not is_building.any():
        missing = "class 6 (building)" if is_classified else f"planes {MIN_HEIGHT_M:g} m above the ground"
        raise InputError(
            f"no outlines: the cloud has no points on {missing}; give footprints, or classify the points first"
        )
    found, are_crowns = [], []
    for part, raster, own in in_tiles(cloud, settings):
        found.append(own)
        are_crowns.append(np.zeros(len(own), bool) if is_classified else crowns(part, own, raster))
    if not sum(map(len, found)):
        raise InputError(f"no outlines: no building has at least {settings.min_area_m2:g} m2")
    shapes, is_crown = np.concatenate(found), np.concatenate(are_crowns)
    if not is_classified:
        if is_crown.all():
            raise InputError(
                f"no outlines: pulses pass through all {len(shapes)} as through trees; give footprints, or classify"
                " the points first"
            )
        if is_crown.any():
            log.warning(
                "warning: outlines left out, as pulses pass through them as through trees: %d", is_crown.sum()
            )
    bounds = shapely.bounds(shapes[~is_crown])
    return shapes[~is_crown][np.lexsort((bounds[:, 1], bounds[:, 0]))], shapes[is_crown]


def in_tiles(cloud: Cloud, settings: Outlines) -> Iterator[tuple[Cloud, CloudRaster, np.ndarray]]:
    """(points, their raster, outlines of buildings) of the cloud, or if it is large, of each tile with points of class
    building. Warns of a sparse cloud."""
    is_building = cloud.classification == BUILDING_CLASS
    density = _density(cloud.x_m[is_building], cloud.y_m[is_building])
    cell_m = max(settings.cell_m, np.ceil(_CELLS_PER_M * np.sqrt(_POINTS_PER_CELL / density)) / _CELLS_PER_M)
    if density < _SPARSE:
        text = (
            "warning: %.2g points per m2 on buildings: outlines are coarse, and buildings narrower than %.1f m may be"
            " missing; give footprints, if there are any"
        )
        log.warning(text, density, 3 * cell_m)
    is_done = np.zeros(len(cloud), bool)
    bounds = cloud.x_m.min(), cloud.y_m.min(), cloud.x_m.max(), cloud.y_m.max()
    for tile in tiles(cloud.x_m, cloud.y_m, float(cell_m)):
        if (is_building & ~is_done & in_window(cloud.x_m, cloud.y_m, tile)).any():
            part, raster = _of_tile(cloud, tile, is_done, settings, density, float(cell_m))
            yield part, raster, _outlines(part, raster, settings, bounds)


def _of_tile(
    cloud: Cloud, tile: Bounds, is_done: np.ndarray, settings: Outlines, density: float, cell_m: float
) -> tuple[Cloud, CloudRaster]:
    """(the points in a tile and so far around it that its blocks are whole; their raster, with only these blocks).
    is_done: bool, the points of the cloud in blocks of earlier tiles; the points in these blocks are added in place."""
    margin_m = _TILE_MARGIN_M
    while True:
        window = grown(tile, margin_m)
        rows = np.flatnonzero(in_window(cloud.x_m, cloud.y_m, window))
        x_m, y_m, z_m = (column[rows] for column in (cloud.x_m, cloud.y_m, cloud.z_m))
        part = Cloud(x_m, y_m, z_m, cloud.classification[rows], cloud.crs)
        raster = _rasterised(part, settings, density, cell_m)
        of_point, count = raster.block.ravel()[raster.cell], int(raster.block.max()) + 1
        is_own = np.bincount(raster.block[_cells_of(raster, tile, 0)].ravel(), minlength=count) > 0
        is_own[of_point[is_done[rows]]] = False
        is_own[0] = False
        is_border = np.ones(raster.block.shape, bool)
        is_border[_cells_of(raster, window, _BESIDE_CELLS)] = False
        if not is_own[raster.block[is_border]].any():
            break
        margin_m *= 2
    is_done[rows[is_own[of_point]]] = True
    block = np.where(is_own, np.cumsum(is_own), 0).astype(np.int32)[raster.block]
    return part, replace(raster, block=block, building=np.where(block, raster.building, 0))


def _cells_of(raster: Raster, window: Bounds, num_less: int) -> tuple[slice, slice]:
    """The rows and columns of a raster in a window of whole cells, without ``num_less`` cells along each side."""
    low, high = (
        (np.reshape(window, (2, 2))[k] - raster.origin_m) / raster.cell_m + side * num_less
        for k, side in ((0, 1), (1, -1))
    )
    most = np.array(raster.block.shape)[::-1]
    low, high = (np.rint(np.clip(each, 0, most)).astype(int).tolist() for each in (low, high))
    return slice(low[1], high[1]), slice(low[0], high[0])


def _outlines(cloud: Cloud, raster: CloudRaster, settings: Outlines, bounds: Bounds) -> np.ndarray:
    """The outlines of all buildings of a raster, block by block, an object array. bounds: of the whole cloud."""
    traces = _block_traces(raster, settings)
    arrays = polygon_arrays.to_polygons(np.array([trace for trace, _ in traces], dtype=object))
    point, _, offset = crop_points(cloud.x_m, cloud.y_m, arrays, _POINTS_MARGIN_M)
    result: list[shapely.Polygon] = []
    is_building = cloud.classification == BUILDING_CLASS
    is_free = has_class(cloud.classification, (GROUND_CLASS, WATER_CLASS))
    for index, (trace, window) in enumerate(traces):
        near = np.sort(point[offset[index] : offset[index + 1]])
        xy_m = np.column_stack([cloud.x_m[near], cloud.y_m[near]])
        points = EdgePoints(xy_m[is_building[near]], xy_m[is_free[near]], raster.density, bounds)
        result += _of_block(trace, window, points, settings)
    return np.array(result, dtype=object)


def with_plants(cloud: Cloud, crowns: np.ndarray) -> Cloud:
    """The cloud, in which points of class building inside polygons of crowns get class vegetation."""
    inside, _, _ = crop_points(cloud.x_m, cloud.y_m, polygon_arrays.to_polygons(crowns), 0.0)
    classes = cloud.classification.copy()
    classes[inside[classes[inside] == BUILDING_CLASS]] = VEGETATION_CLASS
    return replace(cloud, classification=classes)


def outline_features(shapes: np.ndarray, crs: pyproj.CRS) -> Features:
    """Outlines as footprints, with the columns ``building_id``, numbers from 1 as text, and ``area_m2``."""
    ids = np.array([str(number + 1) for number in range(len(shapes))], object)
    return Features(shapes, {"building_id": ids, "area_m2": shapely.area(shapes)}, horizontal(crs))


def _rasterised(cloud: Cloud, settings: Outlines, density: float, cell_m: float) -> CloudRaster:
    """The cells of blocks and buildings. Cells begin at whole multiples of their size, whatever the window."""
    is_building = cloud.classification == BUILDING_CLASS
    column = np.floor(cloud.x_m / cell_m).astype(np.int64)
    row = np.floor(cloud.y_m / cell_m).astype(np.int64)
    first = int(column.min()) - 2, int(row.min()) - 2
    column, row = column - first[0], row - first[1]
    shape = int(row.max()) + 3, int(column.max()) + 3
    cell = row * shape[1] + column
    counts = [
        np.bincount(cell[cloud.classification == value], minlength=shape[0] * shape[1]).reshape(shape)
        for value in (BUILDING_CLASS, GROUND_CLASS)
    ]
    is_roof = (counts[0] > 0) & (counts[0] >= counts[1])
    is_roof |= scipy.ndimage.binary_closing(is_roof, _SQUARE) & (counts[1] == 0)
    is_roof = scipy.ndimage.binary_opening(is_roof, _SQUARE)
    block = _large(scipy.ndimage.label(is_roof)[0], settings.min_area_m2 / cell_m**2)
    height_m = _heights(cell[is_building], cloud.z_m[is_building], shape)
    building = _split(block, height_m, settings, cell_m)
    origin_m = first[0] * cell_m, first[1] * cell_m
    return CloudRaster(building, block, origin_m, cell_m, density, cell, height_m)


def crowns(cloud: Cloud, shapes: np.ndarray, raster: CloudRaster) -> np.ndarray:
    """bool (n,): whether pulses pass through each outline as through the crown of a tree. raster: of the cloud.

    They do if most of its cells with points on or under the roof have a point under the roof, by at least the least
    height of a building.
    """
    is_building = cloud.classification == BUILDING_CLASS
    is_under = ~is_building & (cloud.z_m < raster.height_m.ravel()[raster.cell] - MIN_HEIGHT_M)
    numbered = ((outline, number) for number, outline in enumerate(shapes, start=1))
    number = rasterio.features.rasterize(
        numbered, raster.block.shape, transform=raster.transform, dtype=np.int32
    ).ravel()
    under, all_cells = (
        np.bincount(number[np.unique(raster.cell[chosen])], minlength=len(shapes) + 1)[1:]
        for chosen in (is_under, is_under | is_building)
    )
    return under > _MOST_CELLS * all_cells


def _density(x_m: np.ndarray, y_m: np.ndarray) -> float:
    """Points per square metre: the median number of points in the cells of 1 m with points. If that is 1, as in all
    sparser clouds, it is the density within the median distance of a point to its eighth neighbour, but at most 1."""
    xy_m = np.column_stack([x_m, y_m])
    count = float(np.median(np.unique(np.floor(xy_m).astype(np.int64), axis=0, return_counts=True)[1]))
    if count > 1 or len(xy_m) <= _NEIGHBOURS:
        return count
    far_m = scipy.spatial.KDTree(xy_m).query(xy_m, [_NEIGHBOURS + 1])[0]
    return min(count, float(_NEIGHBOURS / (np.pi * np.median(far_m) ** 2)))


def _large(label: np.ndarray, min_cells: float) -> np.ndarray:
    """The labels, numbered anew from 1; labels with too few cells become 0."""
    count = np.bincount(label.ravel())
    keep = count >= min_cells
    keep[0] = False
    return np.where(keep, np.cumsum(keep), 0)[label].astype(np.int32)


def _heights(cell: np.ndarray, z_m: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The median height of the points in each cell; cells without points have the height of the nearest cell."""
    order = np.lexsort((z_m, cell))
    cells, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    result = np.full(shape[0] * shape[1], np.nan)
    result[cells] = z_m[order][start + count // 2]
    return filled(result.reshape(shape))


def _split(block: np.ndarray, height_m: np.ndarray, settings: Outlines, cell_m: float) -> np.ndarray:
    """int32 (rows, columns), the number of the building of each cell: cells of a block that connect without a jump in
    height. Small buildings join a neighbour. Large buildings are split again at smaller jumps."""
    is_block = block > 0
    first, second = cell_neighbours(is_block)
    label, building, jump_m = block[is_block], np.zeros_like(block), _jumps_m(height_m, is_block)
    is_large = np.ones(label.max(initial=0) + 1, bool)
    least_m = settings.jump_m
    while True:
        connects = label[first] == label[second]
        connects &= ~is_large[label[first]] | (jump_m <= least_m)
        parts = groups(len(label), np.column_stack([first[connects], second[connects]]))
        label = _joined(parts, first, second, settings.min_part_m2 / cell_m**2)
        is_large = np.bincount(label) * cell_m**2 > settings.max_area_m2
        if least_m <= _LEAST_JUMP_M or not is_large.any():
            building[is_block] = label + 1
            return building
        least_m = max(least_m / 2, _LEAST_JUMP_M)


def _jumps_m(height_m: np.ndarray, is_block: np.ndarray) -> np.ndarray:
    """The jumps between the pairs of cells of :func:`cell_neighbours`, in metres: differences of height without what
    the slope of the roof explains, which is that of the cells before and after a pair."""
    # a margin, so that every cell has cells around it
    mask, z_m, result = np.pad(is_block, 1).ravel(), np.pad(height_m, 1).ravel(), []
    for step in (1, is_block.shape[1] + 2):
        first = np.flatnonzero(mask[:-step] & mask[step:])
        step_m = z_m[first + step] - z_m[first]
        slope_m, num_beside = np.zeros(len(first)), np.zeros(len(first))
        for beside in (first - step, first + step):
            is_pair = mask[beside] & mask[beside + step]
            slope_m += np.where(is_pair, z_m[beside + step] - z_m[beside], 0.0)
            num_beside += is_pair
        slope_m /= np.maximum(num_beside, 1)
        result.append(np.abs(step_m) - np.clip(slope_m * np.sign(step_m), 0, np.abs(step_m)))
    return np.concatenate(result)


def _joined(label: np.ndarray, first: np.ndarray, second: np.ndarray, min_cells: float) -> np.ndarray:
    """The labels (cells,), with small parts joined to the neighbour with the longest common wall."""
    count = np.bincount(label).astype(float)
    a, b = label[first], label[second]
    differs = a != b
    pair, length = np.unique(np.sort(np.column_stack([a, b])[differs], axis=1), axis=0, return_counts=True)
    walls: list[dict[int, int]] = [{} for _ in count]
    for (low, high), number in zip(pair.tolist(), length.tolist(), strict=True):
        walls[low][high] = walls[high][low] = number
    target = np.arange(len(count))
    # smallest first, by the sizes before; a part that grows is looked at with its new size in its turn
    for part in np.argsort(count, kind="stable").tolist():
        around = walls[part]
        if not around or count[part] >= min_cells:
            continue
        longest = max(around, key=lambda other: (around[other], -other))
        target[part] = longest
        count[longest] += count[part]
        for other, number in around.items():
            del walls[other][part]
            if other != longest:
                walls[longest][other] = walls[other][longest] = walls[longest].get(other, 0) + number
    while (target[target] != target).any():
        target = target[target]
    return target[label]


def _block_traces(raster: Raster, settings: Outlines) -> list[tuple[shapely.Polygon, Raster]]:
    """(edge, the part of the raster around it) of each block, in the order of their numbers. Edges are traced on cells
    of a third of the size after the raster is smoothed. So the steps in an edge oblique to the raster are small."""
    result = []
    fine_m = raster.cell_m / _FINER
    for number, window in enumerate(scipy.ndimage.find_objects(raster.block), start=1):
        rows, columns = (slice(part.start - 2, part.stop + 2) for part in window)
        is_block = raster.block[rows, columns] == number
        label = np.where(is_block, raster.building[rows, columns], 0)
        origin_m = (
            raster.origin_m[0] + columns.start * raster.cell_m,
            raster.origin_m[1] + rows.start * raster.cell_m,
        )
        smooth = scipy.ndimage.gaussian_filter(is_block.astype(float), _SMOOTH_CELLS)
        fine = scipy.ndimage.zoom(smooth, _FINER, order=1, mode="grid-constant", grid_mode=True) >= 0.5
        part = Raster(label, label, origin_m, raster.cell_m, raster.density)
        traces = _traces(fine.astype(np.int32), replace(part, cell_m=fine_m), settings.min_hole_m2)
        result.append((max(traces, key=lambda trace: trace[1].area)[1], part))
    return result


def _traces(label: np.ndarray, raster: Raster, min_hole_m2: float) -> list[tuple[int, shapely.Polygon]]:
    """(label, polygon along the edges of its cells), sorted by label and descending area, without small courtyards."""
    result = []
    found = rasterio.features.shapes(label, mask=label > 0, connectivity=4, transform=raster.transform)
    for shape, value in found:
        exterior, *holes = [shapely.LinearRing(ring) for ring in shape["coordinates"]]
        holes = [hole for hole in holes if shapely.Polygon(hole).area >= min_hole_m2]
        result.append((int(value), shapely.Polygon(exterior, holes)))
    return sorted(result, key=lambda item: (item[0], -item[1].area))


def _of_block(
    trace: shapely.Polygon, window: Raster, points: EdgePoints, settings: Outlines
) -> list[shapely.Polygon]:
    """The outlines of the buildings of a block. window: the part of the raster around it."""
    label, cell_m = window.building, window.cell_m
    main_deg = directions(trace, points, cell_m)
    outline = regularised(trace, main_deg, points, settings, cell_m)
    if len(np.unique(label[label > 0])) < 2:
        return [outline]
    parts = _traces(np.ascontiguousarray(label), window, 0)
    seams = seam_lines([part for _, part in parts], outline, main_deg, settings, cell_m)
    lines = shapely.union_all([outline.boundary, *seams], grid_size=_GRID_M)
    faces = shapely.get_parts(shapely.polygonize([lines]))
    faces = faces[shapely.contains_properly(outline.buffer(_TOLERANCE_M), faces)]
    return _assembled(faces, label, window, settings.min_part_m2) or [outline]


def _assembled(
    faces: np.ndarray, label: np.ndarray, raster: Raster, min_part_m2: float
) -> list[shapely.Polygon]:
    """The polygons of the buildings: each face goes to the building that has most of its cells, and small polygons are
    joined to a neighbour."""
    row, column = np.nonzero(label)
    centre: np.ndarray = shapely.points(  # type: ignore[assignment]
        raster.origin_m[0] + (column + 0.5) * raster.cell_m, raster.origin_m[1] + (row + 0.5) * raster.cell_m
    )
    face, cell = shapely.STRtree(centre).query(faces, predicate="contains")
    values = label[row, column]
    building = np.full(len(faces), -1)
    for index in range(len(faces)):
        labels = values[cell[face == index]]
        if len(labels):
            building[index] = np.bincount(labels).argmax()
    shapes = [shapely.union_all(faces[building == value]) for value in np.unique(building[building >= 0])]
    parts = [*shapely.get_parts(shapes), *faces[building < 0]] if shapes else []
    parts.sort(key=lambda part: part.area)
    # what is too small for a building joins the neighbour with the longest common wall
    while len(parts) > 1 and parts[0].area < min_part_m2:
        part = parts.pop(0)
        wall_m = [part.intersection(other).length for other in parts]
        longest = int(np.argmax(wall_m))
        joined = shapely.union_all([parts[longest], part])
        if joined.geom_type == "Polygon":
            parts[longest] = joined
        parts.sort(key=lambda part: part.area)
    return parts
