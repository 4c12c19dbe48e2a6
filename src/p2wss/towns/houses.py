"""The buildings of a town block: closed blocks around a court, row houses, detached houses, halls."""

import itertools

import numpy as np
import shapely

from p2wss.towns.buildings import DrawnBuilding, Wing


def draw_closed_block(block: np.ndarray, rng: np.random.Generator) -> list[DrawnBuilding]:
    """Houses around a court: L-shaped ones at the corners, party walls between all of them."""
    depth = rng.uniform(9, 12)
    inner = inset(block, depth)
    if inner is None:
        return draw_houses(block, rng)
    storeys = int(rng.integers(3, 5))
    corner_m = depth + rng.uniform(4, 7)
    buildings = []
    for side in range(4):
        start, along, inward, length = block_side(block, side)
        before = block_side(block, (side - 1) % 4)
        # the corner house at the start of this side: one wing on each street, mitred
        here = to_world(start, along, inward, [(corner_m, 0), (corner_m, depth)])
        there = to_world(start, -before[1], before[2], [(corner_m, 0), (corner_m, depth)])
        eave = draw_eave_m(storeys, rng)
        pitch = draw_pitch_deg(rng)
        buildings.append(
            DrawnBuilding(
                [
                    Wing(np.array([start, here[0], here[1], inner[side]]), eave, pitch, (0, 2)),
                    Wing(np.array([there[0], start, inner[side], there[1]]), eave, pitch, (0, 2)),
                ],
                "block",
            )
        )
        cuts = corner_m + cut_into_lots(length - 2 * corner_m, 8, 15, rng)
        for u0, u1 in itertools.pairwise(cuts):
            eave = draw_eave_m(storeys, rng)
            outline = to_world(start, along, inward, rectangle(u0, 0, u1, depth))
            wings = [Wing(outline, eave, draw_pitch_deg(rng), () if rng.random() < 0.15 else (0, 2))]
            if rng.random() < 0.2 and u1 - u0 > 9:  # a lower wing in the court
                back = to_world(start, along, inward, rectangle(u0, depth, u0 + 0.5 * (u1 - u0), depth + 5))
                wings.append(Wing(back, eave - 2.8, 20, (1,)))
            buildings.append(DrawnBuilding(wings, "block"))
    return buildings


def draw_courtyard_building(block: np.ndarray, rng: np.random.Generator) -> list[DrawnBuilding]:
    """A school or a town hall: one building around its court."""
    outer = inset(block, rng.uniform(3, 8))
    outer = block if outer is None else outer
    inner = inset(outer, rng.uniform(8, 10))
    if inner is None:
        return draw_hall(block, rng)
    eave, pitch = draw_eave_m(3, rng), draw_pitch_deg(rng)
    sides = [np.array([outer[k], outer[(k + 1) % 4], inner[(k + 1) % 4], inner[k]]) for k in range(4)]
    return [DrawnBuilding([Wing(side, eave, pitch, (0, 2)) for side in sides], "block")]


def draw_rows(block: np.ndarray, rng: np.random.Generator) -> list[DrawnBuilding]:
    """Row houses along the two long sides: shared side walls, ridges along the street."""
    buildings = []
    for side in (0, 2):
        start, along, inward, length = block_side(block, side)
        depth, storeys, setback = rng.uniform(8.5, 11), int(rng.integers(1, 4)), rng.uniform(0, 5)
        pitch, eave = draw_pitch_deg(rng), draw_eave_m(storeys, rng)
        cuts = 4 + cut_into_lots(length - 8, 6, 9.5, rng)
        for index, (u0, u1) in enumerate(itertools.pairwise(cuts)):
            if rng.random() < 0.3:  # not every house was built at the same time
                pitch, eave = draw_pitch_deg(rng), draw_eave_m(storeys, rng)
            if rng.random() < 0.06:
                continue
            wings = [
                Wing(
                    to_world(start, along, inward, rectangle(u0, setback, u1, setback + depth)),
                    eave,
                    pitch,
                    (0, 2),
                )
            ]
            if rng.random() < 0.22:
                width = rng.uniform(0.4, 0.6) * (u1 - u0)
                a, b = (u0, u0 + width) if index % 2 else (u1 - width, u1)
                back = to_world(
                    start,
                    along,
                    inward,
                    rectangle(a, setback + depth, b, setback + depth + rng.uniform(3, 5)),
                )
                wings.append(Wing(back, min(eave - 0.4, 2.7), 20, (2,)))
            buildings.append(DrawnBuilding(wings, "row"))
    return buildings


def draw_houses(block: np.ndarray, rng: np.random.Generator) -> list[DrawnBuilding]:
    """Detached houses on lots along all sides that leave room, some with a garage."""
    buildings: list[DrawnBuilding] = []
    neighbours: list[shapely.Geometry] = []
    for side in range(4):
        start, along, inward, length = block_side(block, side)
        cuts = cut_into_lots(length, 15, 20, rng)
        for u0, u1 in itertools.pairwise(cuts):
            lot = u1 - u0
            width, depth = rng.uniform(0.5, 0.72) * lot, rng.uniform(7, 10.5)
            u, v, turn = (
                u0 + rng.uniform(1, lot - width - 0.5),
                rng.uniform(2.5, 7),
                np.radians(rng.normal(0, 3)),
            )
            axis = np.cos(turn) * along + np.sin(turn) * inward
            origin = start + u * along + v * inward
            house = _house(origin, axis, np.array([-axis[1], axis[0]]), width, depth, rng)
            around = house.footprint.buffer(2)
            if not shapely.Polygon(block).contains(house.footprint) or any(
                map(around.intersects, neighbours)
            ):
                continue
            buildings.append(house)
            neighbours.append(house.footprint)
    if rng.random() < 0.5:
        shed = _garden_shed(block, neighbours, rng)
        buildings += [shed] if shed else []
    return buildings


def _house(
    origin: np.ndarray,
    along: np.ndarray,
    inward: np.ndarray,
    width: float,
    depth: float,
    rng: np.random.Generator,
) -> DrawnBuilding:
    """A rectangle, an L, a T, a U, or a house with its garage."""

    def outline(*box: float) -> np.ndarray:
        return to_world(origin, along, inward, rectangle(*box))

    eave, pitch = draw_eave_m(int(rng.integers(1, 3)), rng), draw_pitch_deg(rng)
    shape = rng.choice(["rectangle", "garage", "L", "T", "U"], p=[0.56, 0.14, 0.18, 0.07, 0.05])
    roof = rng.choice(["gable", "hip", "flat", "shed"], p=[0.6, 0.25, 0.1, 0.05])
    slopes = {"gable": (0, 2), "hip": (0, 1, 2, 3), "flat": (), "shed": (0,)}[roof]
    main = Wing(outline(0, 0, width, depth), eave, pitch, slopes)
    reach, part = rng.uniform(3, 5.5), rng.uniform(0.4, 0.5) * width
    if shape == "garage":
        side = outline(width, 0.5, width + rng.uniform(2.8, 3.6), 0.5 + rng.uniform(5, depth - 1))
        return DrawnBuilding([main, Wing(side, 2.5, 20, ())], "house")
    # a wing reaches half into the main roof, so that its ridge runs into it
    inner = depth / 2
    left = (width - part) / 2
    ends = {
        "L": [(width - part, width)],
        "T": [(left, left + part)],
        "U": [(0, 0.35 * width), (0.65 * width, width)],
    }.get(shape, [])
    wings = [Wing(outline(a, inner, b, depth + reach), eave, pitch, (1, 3)) for a, b in ends]
    return DrawnBuilding([main, *wings], "house")


def _garden_shed(
    block: np.ndarray, neighbours: list[shapely.Geometry], rng: np.random.Generator
) -> DrawnBuilding | None:
    _, along, inward, _ = block_side(block, 0)
    origin = block.mean(axis=0) + rng.uniform(-8, 8, 2)
    width, depth = rng.uniform(3.5, 6, 2)
    corners = to_world(origin, along, inward, rectangle(0, 0, width, depth))
    shed = DrawnBuilding([Wing(corners, 2.4, 20, (0,) if rng.random() < 0.5 else ())], "annex")
    if any(map(shed.footprint.buffer(2).intersects, neighbours)):
        return None
    return shed


def draw_hall(block: np.ndarray, rng: np.random.Generator) -> list[DrawnBuilding]:
    """A large hall, some with an office in front."""
    _, along, inward, length = block_side(block, 0)
    depth = block_side(block, 1)[3]
    width, deep = rng.uniform(0.5, 0.75) * length, rng.uniform(0.35, 0.55) * depth
    origin = block.mean(axis=0) - width / 2 * along - deep / 2 * inward
    eave = round(float(rng.uniform(5, 9)), 1)
    slopes = () if rng.random() < 0.4 else (0, 2)
    wings = [Wing(to_world(origin, along, inward, rectangle(0, 0, width, deep)), eave, 20, slopes)]
    if rng.random() < 0.4:
        wings.append(
            Wing(to_world(origin, along, inward, rectangle(width, 2, width + 8, 2 + 0.6 * deep)), 3.5, 20, ())
        )
    return [DrawnBuilding(wings, "hall")]


def block_side(block: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Start, direction, inward normal and length of a side of a counter-clockwise block."""
    start, end = block[side], block[(side + 1) % len(block)]
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    return start, along, np.array([-along[1], along[0]]), length


def to_world(
    origin: np.ndarray, along: np.ndarray, inward: np.ndarray, corners: list[tuple[float, float]]
) -> np.ndarray:
    """World coordinates of (distance along, distance inward) pairs."""
    return np.array([origin + a * along + b * inward for a, b in corners])


def rectangle(u0: float, v0: float, u1: float, v1: float) -> list[tuple[float, float]]:
    """The corners of a rectangle between two opposite ones, counter-clockwise."""
    return [(u0, v0), (u1, v0), (u1, v1), (u0, v1)]


def cut_into_lots(length: float, low: float, high: float, rng: np.random.Generator) -> np.ndarray:
    """Cuts 0 .. length into lots of ``low`` to ``high`` metres."""
    number = max(1, round(length / rng.uniform(low, high)))
    width = rng.uniform(low, high, number)
    return np.concatenate([[0], np.cumsum(width * length / width.sum())])


def draw_pitch_deg(rng: np.random.Generator) -> float:
    """A random roof angle in whole degrees."""
    return float(rng.integers(22, 46))


def draw_eave_m(storeys: int, rng: np.random.Generator) -> float:
    """A random eave height above the ground, to the decimetre."""
    return round(float(storeys * rng.uniform(2.8, 3.2) + rng.uniform(-0.4, 0.6)), 1)


def inset(block: np.ndarray, distance_m: float) -> np.ndarray | None:
    """The block moved inwards: vertex i belongs to vertex i of ``block``. None if too little is left."""
    inner = shapely.Polygon(block).buffer(-distance_m, join_style="mitre")
    if inner.geom_type != "Polygon" or inner.area < 250:
        return None
    ring = shapely.get_coordinates(shapely.orient_polygons(inner))[:-1]
    if len(ring) != len(block):
        return None
    nearest = np.argmin(((block[:, None] - ring) ** 2).sum(axis=2), axis=1)
    return ring[nearest] if len(set(nearest)) == len(block) else None
