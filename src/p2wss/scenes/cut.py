"""Cut a scene: the buildings of a tile and of its margin, with heights and roof angles or a reason for exclusion."""

from collections import Counter

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from p2wss.config import Scenes
from p2wss.data import polygon_arrays, reasons
from p2wss.data.seeds import generator
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import tile_bounds, tiles_of_points
from p2wss.footprints.cleaning import clean_footprints, split_parts
from p2wss.scenes.roofs import FootprintEdges, draw_angles
from p2wss.storage.features import Features

# ranges from which eave heights are drawn where BD TOPO has no height, by its attribute nature, then by its usage
DRAWN_BY_NATURE_M = {
    "Serre": (2.5, 4.0),
    "Silo": (8.0, 20.0),
    "Eglise": (8.0, 14.0),
    "Chapelle": (3.5, 6.0),
    "Château": (7.0, 12.0),
    "Tour, donjon": (10.0, 20.0),
    "Industriel, agricole ou commercial": (4.0, 9.0),
}
DRAWN_BY_USAGE_M = {
    "Annexe": (2.2, 3.2),
    "Industriel": (4.0, 9.0),
    "Agricole": (3.5, 7.0),
    "Résidentiel": (2.8, 7.0),
}
DRAWN_M = (2.5, 6.5)
_STEP_M = 1.0  # between samples of the terrain along a footprint
# footprints with a gap of at most this share a party wall, as data sets rarely draw a common wall twice alike
_PARTY_GAP_M = 0.3
_PARTY_SHARE = 0.5
# footprints up to this far beyond the margin are read, too, so that a building has the same party walls in each scene.
# Footprints this near to the tile or to its buildings belong to the scene, however far away their centres are
NEIGHBOUR_DISTANCE_M = 20.0


def eave_heights(features: Features, config: Scenes) -> tuple[np.ndarray, np.ndarray]:
    """Eave height above the ground (float64, metres) and its source (text), one per feature.

    The height is the first of these that is known and at least ``min_eave_height_m``:

    1. "hauteur": BD TOPO's attribute, which is the height of the eave;
    2. "altitudes": altitude_minimale_toit - altitude_minimale_sol;
    3. "floors": num_floors x ``storey_height_m``;
    4. "drawn": drawn from a range by nature or usage, with a seed from (seed, "scenes", building_id).

    A missing column counts as unknown.
    """

    def numbers(name: str) -> np.ndarray:
        return features.columns.get(name, np.full(len(features), np.nan)).astype(float)

    candidates = {
        "hauteur": numbers("hauteur_m"),
        "altitudes": numbers("altitude_minimale_toit_m") - numbers("altitude_minimale_sol_m"),
        "floors": numbers("num_floors") * config.storey_height_m,
    }
    height = np.full(len(features), np.nan)
    source = np.full(len(features), "drawn", dtype=object)
    for name, values in candidates.items():
        rows = np.isnan(height) & (values >= config.min_eave_height_m) & np.isfinite(values)
        height[rows], source[rows] = values[rows], name
    for row in np.flatnonzero(np.isnan(height)):
        nature, usage = _text(features, "nature", int(row)), _text(features, "usage", int(row))
        low, high = DRAWN_BY_NATURE_M.get(nature) or DRAWN_BY_USAGE_M.get(usage) or DRAWN_M
        rng = generator(config.seed, "scenes", features["building_id"][row], "height")
        height[row] = np.round(rng.uniform(low, high), 1)
    return height, source


def _text(features: Features, column: str, row: int) -> str:
    value = features[column][row] if column in features.columns else None
    return value if isinstance(value, str) else ""


def ground_heights(shapes: np.ndarray, terrain: Terrain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(median height, lowest height, share of samples with data) of the terrain along the edges of each polygon.

    It is sampled every metre. float64 arrays (len(shapes),): NaN, NaN and 0 for a polygon that is empty or has no
    terrain.
    """
    num_shapes = len(shapes)
    boundary = shapely.segmentize(shapely.boundary(shapes), _STEP_M)
    xy, shape = shapely.get_coordinates(boundary, return_index=True)
    z = terrain.interpolated(xy[:, 0], xy[:, 1])
    has_data = np.isfinite(z)
    count = np.bincount(shape, minlength=num_shapes)
    share = np.bincount(shape[has_data], minlength=num_shapes) / np.maximum(count, 1)
    by_shape = pd.Series(z[has_data]).groupby(shape[has_data])
    median, lowest = np.full(num_shapes, np.nan), np.full(num_shapes, np.nan)
    rows = np.unique(shape[has_data])
    median[rows], lowest[rows] = by_shape.median().to_numpy(), by_shape.min().to_numpy()
    return median, lowest, share


def count_buildings(features: Features, tile_size_m: float, min_area_m2: float) -> dict[str, int]:
    """Number of footprints per tile (multipolygons split into parts), sorted by tile name.

    :func:`cut_scene` assigns buildings to tiles in the same way.
    """
    parts = split_parts(features, min_area_m2)
    counts = Counter(_tile_names(parts, tile_size_m))
    counts.pop("", None)
    return dict(sorted(counts.items()))


def cut_scene(
    features: Features, terrain: Terrain, tile: str, tile_size_m: float, config: Scenes
) -> gpd.GeoDataFrame:
    """The scene of a tile: the columns of :data:`p2wss.storage.schemas.scene.SCENE` and a geometry, sorted by id.

    features: the whole blocks (:func:`p2wss.footprints.cleaning.read_whole_blocks`) of the footprints that intersect
    the tile extended by ``margin_m`` + :data:`NEIGHBOUR_DISTANCE_M`, with ``building_id`` and the height columns of the
    stage fetch. terrain: of the tile and its margin, in the same CRS.

    A building belongs to the tile that contains the centre of its bounding box before cleaning. A building whose centre
    is in the margin, or that is near to the tile or to its buildings, is in the scene with ``in_tile`` False: else a
    hall beside the tile would not occlude its buildings, nor put them into the split guard. An excluded building keeps
    its row, with the reason as ``status``, an empty geometry, no angles and NaN heights.
    """
    result = clean_footprints(features, config)
    polygons, status = result.geometry, result["status"]
    is_party = party_walls(polygons)

    x_min, y_min, x_max, y_max = tile_bounds(tile, tile_size_m, config.margin_m)
    x, y = result["centre_x_m"], result["centre_y_m"]
    is_of_scene = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
    own = polygons[_tile_names(result, tile_size_m) == tile]
    around = np.array([shapely.box(*tile_bounds(tile, tile_size_m)), *own], dtype=object)
    near = shapely.STRtree(polygons).query(around, predicate="dwithin", distance=NEIGHBOUR_DISTANCE_M)[1]
    is_of_scene[near] = True
    selection = np.flatnonzero(is_of_scene)
    result, polygons, status = result.take(selection), polygons[selection], status[selection]

    height, source = eave_heights(result, config)
    median, lowest, known_share = ground_heights(polygons, terrain)
    status[(status == "ok") & (known_share < max(config.min_terrain_share, 1e-9))] = reasons.NO_TERRAIN
    status[(status == "ok") & (height > config.max_eave_height_m)] = reasons.TOO_HIGH
    usable: np.ndarray = status == "ok"
    roof_type: np.ndarray = np.full(len(selection), "none", dtype=object)
    angle_deg = [np.zeros(0, np.float32) for _ in selection]
    polygons[~usable] = shapely.Polygon()
    radius_m = shapely.length(shapely.maximum_inscribed_circle(np.where(usable, polygons, np.array(None))))
    rings = polygon_arrays.to_polygons(polygons)
    ids = result["building_id"]
    for row in np.flatnonzero(usable):
        edges = FootprintEdges.from_rings(rings.rings(int(row)), is_party[selection[row]], radius_m[row])
        roof_type[row], angles = draw_angles(edges, ids[row], config)
        angle_deg[row] = angles.astype(np.float32)

    scene = gpd.GeoDataFrame(
        {
            "building_id": ids,
            "tile": tile,
            "in_tile": _tile_names(result, tile_size_m) == tile,
            "status": status,
            "eave_height_m": np.where(usable, height, np.nan).astype(np.float32),
            "eave_height_source": source,
            "terrain_z_m": np.where(usable, median, np.nan),
            "base_z_m": np.where(usable, lowest, np.nan),
            "roof_type": roof_type,
            "angle_deg": angle_deg,
        },
        geometry=polygons,
        crs=features.crs,
    )
    return scene.sort_values("building_id", kind="stable").reset_index(drop=True)


def party_walls(polygons: np.ndarray) -> list[np.ndarray]:
    """For each polygon, bool (num_edges,): whether at least half of an edge is within 0.3 m of another polygon. Edges
    are numbered over all rings."""
    rings = polygon_arrays.to_polygons(polygons)
    offset = rings.vertex_offset
    starts, ends = rings.xy_m, rings.xy_m[rings.next_vertex]
    edges = np.asarray(shapely.linestrings(np.stack([starts, ends], axis=1)), dtype=object)
    polygon_of_edge = np.repeat(np.arange(len(rings)), np.diff(offset))
    edge, polygon = shapely.STRtree(polygons).query(edges, predicate="dwithin", distance=_PARTY_GAP_M)
    is_neighbour = polygon_of_edge[edge] != polygon
    edge, polygon = edge[is_neighbour], polygon[is_neighbour]
    neighbours, index = np.unique(polygon, return_inverse=True)
    buffers = shapely.buffer(polygons[neighbours], _PARTY_GAP_M, quad_segs=2)
    shared_m = shapely.length(shapely.intersection(edges[edge], buffers[index])) if len(edge) else np.zeros(0)
    share = np.bincount(edge, weights=shared_m, minlength=len(edges)) / np.maximum(
        shapely.length(edges), 1e-9
    )
    # a neighbour that only touches a corner covers a short end of the edge: less than the share
    is_party = share >= _PARTY_SHARE
    return [is_party[offset[p] : offset[p + 1]] for p in range(len(rings))]


def _tile_names(parts: Features, tile_size_m: float) -> np.ndarray:
    """The tile that contains the centre of each part; "" for a part without coordinates."""
    x, y = parts["centre_x_m"], parts["centre_y_m"]
    is_finite = np.isfinite(x) & np.isfinite(y)
    names = np.full(len(parts), "", dtype=object)
    names[is_finite] = tiles_of_points(x[is_finite], y[is_finite], tile_size_m)
    return names
