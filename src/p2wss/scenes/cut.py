"""One tile: its buildings and those of its margin, each with heights and angles or the reason why not."""

from __future__ import annotations

from collections import Counter

import geopandas as gpd
import numpy as np
import shapely

from p2wss.config import Scenes
from p2wss.data import polygon_arrays
from p2wss.data.footprints import clean_footprints, split_parts
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import tile_bounds, tiles_of_points
from p2wss.scenes.heights import eave_heights, ground_heights
from p2wss.scenes.roofs import Outline, draw_angles
from p2wss.skeleton import Status

NO_TERRAIN = "no-terrain"
TOO_HIGH = "too-high"
# buildings nearer than this stand wall to wall; the same wall is rarely drawn twice alike
_PARTY_GAP_M = 0.3
_PARTY_SHARE = 0.5
# neighbours are looked for this far beyond the margin: a building has the same party walls in each scene
NEIGHBOUR_M = 20.0


def count_buildings(frame: gpd.GeoDataFrame, tile_size_m: float, min_area_m2: float) -> dict[str, int]:
    """Number of footprints (multipolygons split) per tile, in order of tile names; see :func:`cut_scene`."""
    parts = split_parts(frame, min_area_m2)
    counts = Counter(_tiles(parts, tile_size_m))
    counts.pop("", None)
    return dict(sorted(counts.items()))


def cut_scene(
    frame: gpd.GeoDataFrame, terrain: Terrain, tile: str, tile_size_m: float, config: Scenes
) -> gpd.GeoDataFrame:
    """The columns of :data:`p2wss.io.SCENE` and a geometry, sorted by building id.

    frame: footprints that meet the tile grown by ``margin_m`` + :data:`NEIGHBOUR_M` or more, with
    ``building_id`` and the height columns of the fetch stage. A building belongs to the tile that holds the
    middle of its bounding box before cleaning; others whose middle is in the margin have ``in_tile`` False. A
    building that cannot be used keeps its row: empty geometry, no angles, NaN heights.
    """
    result = clean_footprints(frame, config)
    polygons = result.geometry.to_numpy()
    status = result["status"].to_numpy(dtype=object).copy()
    is_party = party_walls(polygons)

    x_min, y_min, x_max, y_max = tile_bounds(tile, tile_size_m, config.margin_m)
    x, y = result["middle_x_m"].to_numpy(), result["middle_y_m"].to_numpy()
    near = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
    chosen = np.flatnonzero(near)
    result, polygons, status = result.iloc[chosen], polygons[chosen], status[chosen]

    height, source = eave_heights(result, config)
    median, lowest, known_share = ground_heights(polygons, terrain)
    status[(status == "ok") & (known_share < max(config.min_terrain_share, 1e-9))] = NO_TERRAIN
    status[(status == "ok") & (height > config.max_eave_height_m)] = TOO_HIGH
    usable = status == "ok"
    roof_type = np.full(len(chosen), "none", dtype=object)
    angle_deg = [np.zeros(0, np.float32) for _ in chosen]
    polygons[~usable] = shapely.Polygon()
    radius_m = shapely.length(shapely.maximum_inscribed_circle(np.where(usable, polygons, None)))
    rings = polygon_arrays.to_polygons(polygons)
    ids = result["building_id"].astype(str).to_numpy(dtype=object)
    for row in np.flatnonzero(usable):
        outline = Outline.from_rings(rings.rings(int(row)), is_party[chosen[row]], radius_m[row])
        roof_type[row], angles = draw_angles(outline, ids[row], config)
        angle_deg[row] = angles.astype(np.float32)

    scene = gpd.GeoDataFrame(
        {
            "building_id": ids,
            "tile": tile,
            "in_tile": _tiles(result, tile_size_m) == tile,
            "status": status,
            "eave_height_m": np.where(usable, height, np.nan).astype(np.float32),
            "eave_height_source": source,
            "ground_z_m": np.where(usable, median, np.nan),
            "base_z_m": np.where(usable, lowest, np.nan),
            "roof_type": roof_type,
            "angle_deg": angle_deg,
        },
        geometry=polygons,
        crs=frame.crs,
    )
    return scene.sort_values("building_id", kind="stable").reset_index(drop=True)


def failed_fraction(scene: gpd.GeoDataFrame) -> float:
    """Share of the tile's own buildings that were left out, those that are only too small not counted."""
    status = scene["status"].to_numpy()[scene["in_tile"].to_numpy()]
    counted = status != Status.TOO_SMALL.reason
    return float(np.mean(status[counted] != "ok")) if counted.any() else 0.0


def party_walls(polygons: np.ndarray) -> list[np.ndarray]:
    """Per polygon and edge (over all rings): is at least half of it within 0.3 m of another polygon?"""
    rings = polygon_arrays.to_polygons(polygons)
    offset = rings.vertex_offset
    starts, ends = rings.xy_m, rings.xy_m[_next_vertex(rings.ring_offset)]
    edges = np.asarray(shapely.linestrings(np.stack([starts, ends], axis=1)), dtype=object)
    owner = np.repeat(np.arange(len(rings)), np.diff(offset))
    edge, other = shapely.STRtree(polygons).query(edges, predicate="dwithin", distance=_PARTY_GAP_M)
    foreign = owner[edge] != other
    edge, other = edge[foreign], other[foreign]
    touched, index = np.unique(other, return_inverse=True)
    around = shapely.buffer(polygons[touched], _PARTY_GAP_M, quad_segs=2)
    shared = shapely.length(shapely.intersection(edges[edge], around[index])) if len(edge) else np.zeros(0)
    share = np.bincount(edge, weights=shared, minlength=len(edges)) / np.maximum(shapely.length(edges), 1e-9)
    # a neighbour that only stands at a corner covers the end of the edge up to the gap
    flags = share >= _PARTY_SHARE
    return [flags[offset[p] : offset[p + 1]] for p in range(len(rings))]


def _next_vertex(ring_offset: np.ndarray) -> np.ndarray:
    following = np.arange(1, ring_offset[-1] + 1)
    last = ring_offset[1:] - 1
    following[last] = ring_offset[:-1]
    return following


def _tiles(parts: gpd.GeoDataFrame, tile_size_m: float) -> np.ndarray:
    """Tile of each part, "" for one without a place."""
    x, y = parts["middle_x_m"].to_numpy(), parts["middle_y_m"].to_numpy()
    there = np.isfinite(x) & np.isfinite(y)
    names = np.full(len(parts), "", dtype=object)
    names[there] = tiles_of_points(x[there], y[there], tile_size_m)
    return names
