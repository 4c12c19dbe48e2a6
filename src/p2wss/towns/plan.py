"""The plan of a town: blocks between bent streets, and what kind of buildings each holds."""

import numpy as np
import shapely

from p2wss.towns.buildings import DrawnBuilding
from p2wss.towns.houses import draw_closed_block, draw_courtyard_building, draw_hall, draw_houses, draw_rows
from p2wss.towns.site import CENTRE, LIDAR_RADIUS_M, LIDAR_TILE, X_MAX, X_MIN, Y_MAX, Y_MIN, in_lidar_tile

BLOCK_M = (80.0, 62.0)
HALF_STREET_M = 5.0
# what is drawn on a block; nothing on a park
_DRAW = {
    "closed": draw_closed_block,
    "courtyard": draw_courtyard_building,
    "rows": draw_rows,
    "houses": draw_houses,
    "halls": draw_hall,
}
# distance from the centre in metres, and shares of the kinds of blocks up to it
_SHARES = (
    (190, {"closed": 0.6, "courtyard": 0.15, "rows": 0.2, "halls": 0.05}),
    (400, {"closed": 0.1, "rows": 0.5, "houses": 0.28, "halls": 0.05, "park": 0.07}),
    (960, {"rows": 0.08, "houses": 0.36, "halls": 0.05, "park": 0.51}),
)


def draw_town(rng: np.random.Generator) -> list[DrawnBuilding]:
    """Blocks between bent streets: closed blocks in the centre, then rows, then detached houses and halls."""
    town: list[DrawnBuilding] = []
    for block in _blocks(rng):
        centre = block.mean(axis=0)
        radius_m = float(np.hypot(*(centre - CENTRE)))
        kind = _block_kind(radius_m, rng)
        if kind in _DRAW:
            town += _DRAW[kind](block, rng)
    return [building for building in town if _has_room(building.footprint)]


def _has_room(footprint: shapely.geometry.base.BaseGeometry) -> bool:
    """Whether a footprint lies inside the region and, in the LiDAR tile, near the centre and away from the edge of the
    cloud."""
    if footprint.geom_type != "Polygon" or not footprint.is_valid:
        return False
    is_inside = shapely.box(X_MIN + 6, Y_MIN + 6, X_MAX - 6, Y_MAX - 6).contains(footprint)
    is_far = in_lidar_tile(footprint) and footprint.distance(shapely.Point(CENTRE)) > LIDAR_RADIUS_M
    return bool(is_inside and not is_far and footprint.distance(LIDAR_TILE.exterior) > 3)


def _blocks(rng: np.random.Generator) -> list[np.ndarray]:
    """Quadrilaterals (4, 2), counter-clockwise, between the axes of a bent and shaken grid of streets."""
    reach = 20
    i, j = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1), indexing="ij")
    u = i * BLOCK_M[0] + rng.uniform(-6, 6, i.shape)
    v = j * BLOCK_M[1] + rng.uniform(-6, 6, i.shape)
    u, v = u + 30 * np.sin(v / 260), v + 24 * np.sin(u / 310 + 0.7)
    turn = np.radians(17)
    x = CENTRE[0] + np.cos(turn) * u - np.sin(turn) * v
    y = CENTRE[1] + np.sin(turn) * u + np.cos(turn) * v
    corner = np.stack([x, y], axis=-1)
    blocks = []
    for a in range(2 * reach):
        for b in range(2 * reach):
            quad = np.array([corner[a, b], corner[a + 1, b], corner[a + 1, b + 1], corner[a, b + 1]])
            inner = shapely.Polygon(quad).buffer(-HALF_STREET_M, join_style="mitre")
            ring = shapely.get_coordinates(shapely.orient_polygons(inner))[:-1]
            if len(ring) == 4 and inner.area > 1200:
                blocks.append(ring)
    return blocks


def _block_kind(radius_m: float, rng: np.random.Generator) -> str:
    for limit_m, shares in _SHARES:
        if radius_m < limit_m:
            return str(rng.choice(list(shares), p=list(shares.values())))
    return "park"
