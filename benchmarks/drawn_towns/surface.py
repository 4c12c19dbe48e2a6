"""The surface that the stand-in survey scans: ground, roofs, dormers and chimneys on a fine raster, and trees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from p2wss.towns.buildings import DrawnBuilding, Wing
from p2wss.towns.houses import block_side, rectangle, to_world
from p2wss.towns.site import BUILDING_CLASS, GROUND_CLASS, UNCLASSIFIED_CLASS, in_lidar_tile

CELL_M = 0.1
_DENSITY = 0.75  # of crowns
AROUND_M = 4.0  # points further from a building are not written, to keep the file small


class Surface:
    """Height of the top surface and its class on a fine raster around the buildings."""

    def __init__(self, buildings: list[DrawnBuilding], rng: np.random.Generator) -> None:
        outlines = [building.footprint for building in buildings]
        bounds = shapely.total_bounds(outlines)
        self.x_min, self.y_min = np.floor(bounds[:2]) - 20
        columns, rows = (np.ceil((bounds[2:] + 20 - (self.x_min, self.y_min)) / CELL_M)).astype(int)
        x, y = np.meshgrid(self.x_min + CELL_M * np.arange(columns), self.y_min + CELL_M * np.arange(rows))
        self.z = buildings[0].ground(x, y)
        self.kind = np.full(self.z.shape, GROUND_CLASS, np.uint8)
        wings = [
            (wing, building.floor_m)
            for building in buildings
            if building.kind != "gone"
            for wing in [*building.wings, *draw_details(building, rng)]
        ]
        # shafts are open above: after all roofs
        for wing, floor_m in sorted(wings, key=lambda pair: pair[0].detail == "shaft"):
            self._raise(wing, floor_m)
        coarse = max(1, round(0.5 / CELL_M))
        near = shapely.union_all([outline.buffer(AROUND_M) for outline in outlines])
        shapely.prepare(near)
        self.coarse = coarse
        self.mask = shapely.contains_xy(near, x[::coarse, ::coarse], y[::coarse, ::coarse])

    def _raise(self, wing: Wing, floor_m: float) -> None:
        """Lift the surface to the roof of a wing."""
        outline = wing.outline
        low = np.floor((outline.min(axis=0) - (self.x_min, self.y_min)) / CELL_M).astype(int)
        high = np.ceil((outline.max(axis=0) - (self.x_min, self.y_min)) / CELL_M).astype(int) + 1
        window = (slice(low[1], high[1]), slice(low[0], high[0]))
        x, y = np.meshgrid(
            self.x_min + CELL_M * np.arange(low[0], high[0]), self.y_min + CELL_M * np.arange(low[1], high[1])
        )
        inside = shapely.contains_xy(shapely.Polygon(outline), x, y)
        top = floor_m + wing.eave_m + wing.rise_m(np.column_stack([x[inside], y[inside]]))
        z, kind = self.z[window], self.kind[window]
        if wing.detail == "shaft":
            z[inside], kind[inside] = top, GROUND_CLASS if wing.eave_m < 1 else UNCLASSIFIED_CLASS
            return
        z[inside] = np.where(kind[inside] == BUILDING_CLASS, np.maximum(z[inside], top), top)
        kind[inside] = BUILDING_CLASS

    def _cell(self, x: np.ndarray, y: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
        return np.rint((y - self.y_min) / size).astype(int), np.rint((x - self.x_min) / size).astype(int)

    def near(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Whether points are near a building (and on the raster)."""
        row, column = self._cell(x, y, CELL_M * self.coarse)
        inside = (row >= 0) & (column >= 0) & (row < self.mask.shape[0]) & (column < self.mask.shape[1])
        inside[inside] = self.mask[row[inside], column[inside]]
        return inside

    def at(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(z, class) of the nearest cell."""
        row, column = self._cell(x, y, CELL_M)
        row, column = row.clip(0, self.z.shape[0] - 1), column.clip(0, self.z.shape[1] - 1)
        return self.z[row, column], self.kind[row, column]


def draw_details(building: DrawnBuilding, rng: np.random.Generator) -> list[Wing]:
    """The chimney, if there is one, and the dormers of a building, all level."""
    main = building.wings[0]
    if building.kind not in ("house", "row", "block") or len(main.slopes) < 2:
        return []
    start, along, inward, length = block_side(main.outline, main.slopes[0])
    depth = block_side(main.outline, main.slopes[0] + 1)[3]
    tangent = np.tan(np.radians(main.pitch_deg))
    details: list[Wing] = []
    if rng.random() < 0.6:
        u = rng.uniform(0.15, 0.75) * length
        outline = to_world(start, along, inward, rectangle(u, 0.55 * depth, u + 0.7, 0.55 * depth + 0.6))
        top_m = main.eave_m + depth / 2 * tangent + rng.uniform(0.5, 1)
        details.append(Wing(outline, top_m, 0.0, (), detail="chimney"))
    if depth / 2 * tangent > 2.4 and rng.random() < 0.45:
        number = int(rng.integers(1, 3))
        for u in (np.arange(number) + 0.5) * length / number - 0.8:
            outline = to_world(start, along, inward, rectangle(u, 0.7, u + 1.6, 0.7 + 1.6 / tangent))
            details.append(Wing(outline, main.eave_m + rng.uniform(1.8, 2.1), 0.0, (), detail="dormer"))
    return details


def draw_trees(buildings: list[DrawnBuilding], rng: np.random.Generator) -> np.ndarray:
    """Crowns beside and on buildings, float (n, 6): x, y, z of the centre, radius, half height, the share of pulses
    that they stop."""
    houses = shapely.union_all([building.footprint for building in buildings])
    crowns: list[Sequence[float]] = []
    for building in buildings:
        crowns += building.crowns
        if rng.random() > 0.4:
            continue
        centre, reach = (
            shapely.get_coordinates(building.footprint.centroid)[0],
            np.sqrt(building.footprint.area),
        )
        angle, radius = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 3)
        x, y = centre + (0.6 * reach + radius) * np.array([np.cos(angle), np.sin(angle)])
        here = shapely.Point(x, y)
        if houses.distance(here) < 0.6 * radius or not in_lidar_tile(here):
            continue
        half = radius * rng.uniform(0.9, 1.5)
        crowns.append((x, y, float(building.ground(x, y)) + 1.6 + half, radius, half, _DENSITY))
    return np.array(crowns).reshape(-1, 6)
