"""An old town: tall houses wall to wall on a hillside, and what makes the roofs there hard to find.

Roofs reach over the border of lower neighbours, shafts are within houses, plants grow on them and trees over them,
sheet metal sends little back, and hardly any ground is seen between. The map is older than the cloud: some of its
houses are gone or changed. What troubles a house is its kind; its true roof is the roof of its bodies without shafts.
All sizes below are in metres and degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely

from p2wss.towns.buildings import DrawnBuilding, Wing
from p2wss.towns.houses import cut_into_lots, draw_eave_m, rectangle, to_world
from p2wss.towns.site import (
    GROUND_CLASS,
    LIDAR_RADIUS_M,
    LIDAR_X_MIN,
    LIDAR_Y_MAX,
    UNCLASSIFIED_CLASS,
    ground_z_m,
)

# what troubles a house, with its probability; because of the first ones, a house cannot be represented
TROUBLES = {
    "vegetation-over": 0.04,
    "neighbour-over": 0.03,
    "gone": 0.03,
    "changed": 0.03,
    "many-levels": 0.02,
    "few-points": 0.03,
    "shaft": 0.12,
    "creeper": 0.08,
    "sheet": 0.12,
    "roof as ground": 0.03,
    "unclassified": 0.03,
    "plain": 0.44,
}
_MARGIN_M, _LANE_M = 12.0, (1.8, 3.5)
# houses stand only where the ground falls by less than this within a lot
_MAX_FALL_M = 3.5
_SMALL = ("vegetation-over", "neighbour-over")


def hillside_z_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The ground of the other towns, on a slope with two rocks."""
    down = 0.8 * (LIDAR_Y_MAX - y) + 0.6 * (x - LIDAR_X_MIN)
    rocks = sum(4.5 * (1 - np.tanh(down - at_m)) for at_m in (150.0, 300.0))
    return np.asarray(ground_z_m(x, y) - 0.16 * down + rocks)


def draw_old(rng: np.random.Generator) -> list[DrawnBuilding]:
    """Rows of houses back to back between lanes, in the LiDAR tile."""
    town: list[DrawnBuilding] = []
    half = LIDAR_RADIUS_M / 2
    centre = np.array([LIDAR_X_MIN + half, LIDAR_Y_MAX - half])
    turn = np.radians(rng.uniform(-25, 25))
    along = np.array([np.cos(turn), np.sin(turn)])
    inward = np.array([-along[1], along[0]])
    within = shapely.box(*(centre - half + _MARGIN_M), *(centre + half - _MARGIN_M))
    error_m, wave, phase = rng.uniform(0, 0.2), rng.normal(0, 0.3, (2, 2)), rng.uniform(0, 2 * np.pi, 2)
    v = -1.4 * half
    while v < 1.4 * half:
        depth = rng.uniform(8, 14)
        u = -1.4 * half + rng.uniform(0, 20)
        while u < 1.4 * half:
            # a row of houses between two lanes
            length = rng.uniform(25, 70)
            cuts = u + cut_into_lots(length, 5, 10, rng)
            row: list[DrawnBuilding] = []
            for u0, u1 in pairwise(cuts):
                corners = to_world(centre, along, inward, rectangle(u0, v, u1, v + depth))
                lot = shapely.Polygon(corners)
                if within.contains(lot) and np.ptp(hillside_z_m(*corners.T)) < _MAX_FALL_M:
                    row.append(
                        _draw_house(
                            corners, row[-1] if row and row[-1].footprint.distance(lot) < 0.01 else None, rng
                        )
                    )
            town += row
            u += length + rng.uniform(*_LANE_M)
        v += depth + (rng.uniform(*_LANE_M) if rng.random() < 0.5 else 0)
    for building in town:
        mapped = shapely.transform(building.footprint, lambda xy: xy + error_m * np.sin(xy @ wave + phase))
        building.footprint = shapely.normalize(shapely.set_precision(mapped, 0.1))
    return town


def _draw_house(corners: np.ndarray, before: DrawnBuilding | None, rng: np.random.Generator) -> DrawnBuilding:
    """A house on a lot (4, 2), whose edge 3 is the wall to the house ``before`` it in the row."""
    trouble = str(rng.choice(list(TROUBLES), p=list(TROUBLES.values())))
    floors = int(rng.integers(1, 3)) if trouble in (*_SMALL, "roof as ground") else int(rng.integers(1, 8))
    eave = draw_eave_m(floors, rng)
    if trouble in _SMALL:
        corners = corners[0] + (corners - corners[0]) * 0.55
    sides = np.diff(corners[[0, 1, 2]], axis=0)
    width, depth = np.hypot(*sides.T)
    along, inward = sides / [[width], [depth]]
    roof = (
        "flat"
        if trouble == "roof as ground"
        else str(rng.choice(["gable", "shed", "flat"], p=[0.55, 0.2, 0.25]))
    )
    pitch = rng.uniform(3, 9) if trouble == "sheet" or roof == "shed" else rng.uniform(15, 40)
    slopes = {"gable": (0, 2), "shed": (0,), "flat": ()}[roof]
    house = Wing(corners, eave, pitch, slopes)
    wings = [house]

    def box(*sides_m: float) -> np.ndarray:
        return to_world(corners[0], along, inward, rectangle(*sides_m))

    crowns: list[Sequence[float]] = []
    ground = float(hillside_z_m(*corners.mean(axis=0)))
    if trouble == "changed":
        wings = [Wing(box(0, 0, width, rng.uniform(0.3, 0.5) * depth), eave, 0.0, ())]
    elif trouble == "many-levels":
        cuts = [cut_into_lots(size, 1.5, 2.5, rng) for size in (width, depth)]
        wings = [
            Wing(box(a, c, b, d), eave + rng.uniform(-2, 2), 0.0, ())
            for a, b in pairwise(cuts[0])
            for c, d in pairwise(cuts[1])
        ]
    elif trouble == "shaft":
        size = np.minimum(rng.uniform(1.8, 3.2, 2), [width - 2.1, depth - 2.1])
        u, v = rng.uniform(1.0, [width - size[0] - 1.0, depth - size[1] - 1.0])
        wings.append(
            Wing(box(u, v, u + size[0], v + size[1]), rng.choice([0.6, eave / 2]), 0.0, (), detail="shaft")
        )
    elif trouble in ("creeper", "vegetation-over"):
        radius, dense = (
            (0.55 * max(width, depth) + 1, 0.97) if trouble == "vegetation-over" else (rng.uniform(1, 2), 0.9)
        )
        place = corners.mean(axis=0) if trouble == "vegetation-over" else corners[int(rng.integers(4))]
        half = radius if trouble == "vegetation-over" else 0.4
        top = ground + house.eave_m + float(house.rise_m(place[None])[0])
        crowns.append((*place, top + half - (0 if dense > 0.95 else 0.3), radius, half, dense))
    if trouble in ("few-points", "sheet"):
        house.seen_share = 0.03 if trouble == "few-points" else rng.uniform(0.1, 0.6)
    house.seen_as = {"roof as ground": GROUND_CLASS, "unclassified": UNCLASSIFIED_CLASS}.get(
        trouble, house.seen_as
    )
    if trouble == "neighbour-over":
        if (
            before is None
            or before.wings[0].eave_m < eave + 4
            or before.kind in ("gone", "changed", "many-levels")
        ):
            trouble = "plain"
        else:
            before.wings.append(_reaching(before.wings[0], 0.0, 0.8 * width, 0.0))
    if trouble != "gone":
        over = rng.uniform(0.1, 0.6, 3)
        wings += [_reaching(wing, *over) for wing in wings if not wing.detail]
    building = DrawnBuilding(wings, trouble, ground=hillside_z_m, crowns=crowns)
    building.hidden_ground_m = 5.0 if rng.random() < 0.7 else 0.0
    building.footprint = shapely.Polygon(corners)
    return building


def _reaching(wing: Wing, eave_m: float, right_m: float, left_m: float) -> Wing:
    """The roof of a body with its planes continued beyond its walls, at the eaves and at both ends."""
    outline = wing.outline
    along, inward = (
        (outline[k + 1] - outline[k]) / np.linalg.norm(outline[k + 1] - outline[k]) for k in (0, 1)
    )
    eave_m = eave_m if wing.slopes else 0.0
    back_m = eave_m if 2 in wing.slopes else 0.0
    moved = (
        outline
        + np.outer([-left_m, right_m, right_m, -left_m], along)
        + np.outer([-eave_m, -eave_m, back_m, back_m], inward)
    )
    drop_m = eave_m * np.tan(np.radians(wing.pitch_deg)) if wing.slopes else 0.0
    return Wing(moved, wing.eave_m - drop_m, wing.pitch_deg, wing.slopes, detail="eaves")
