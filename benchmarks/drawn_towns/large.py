"""Towns of large buildings: schools, convents, palaces, factories, churches and round buildings of up to some 50
planes, and complexes of several of them with 50 to 300.

They consist of bodies as in :mod:`drawn_towns.wings`. Trees grow in courts, some roofs have no class or the class of
trees, and the lines of the scanner are far apart. All sizes below are in metres and degrees.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import shapely

from drawn_towns.wings import body, draw_dormers, draw_groups, parapets
from p2wss.towns.buildings import DrawnBuilding, Wing
from p2wss.towns.houses import block_side, to_world
from p2wss.towns.site import BUILDING_CLASS, UNCLASSIFIED_CLASS, VEGETATION_CLASS, ground_z_m

# half swings of the scanner: lines on the ground are 0.9 m apart
LARGE_SWINGS_PER_S = 69.0
_LONGEST_M = 190.0  # so that a complex fits into the LiDAR tile
_SEEN_AS, _SEEN_SHARE = (BUILDING_CLASS, UNCLASSIFIED_CLASS, VEGETATION_CLASS), (0.7, 0.15, 0.15)

Box = tuple[float, float, float, float]
Draw = Callable[[np.random.Generator], list[Wing]]


def draw_large(rng: np.random.Generator) -> list[DrawnBuilding]:
    """Buildings of each shape in turn."""
    return _with_trees(draw_groups(rng, SHAPES, lambda shape, rng: [_SHAPES[shape](rng)]), rng)


def draw_complexes(rng: np.random.Generator) -> list[DrawnBuilding]:
    """Several large buildings that have grown together, of 50 to 300 planes, on ground with gentle slopes."""
    town = draw_groups(rng, rng.permutation(SHAPES).tolist(), lambda shape, rng: [_draw_complex(shape, rng)])
    for building in town:
        building.ground = park_z_m
    return _with_trees(town, rng)


def park_z_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The ground of the other towns with a quarter of its slopes."""
    return 58 + (ground_z_m(x, y) - 58) / 4


def _with_trees(town: list[DrawnBuilding], rng: np.random.Generator) -> list[DrawnBuilding]:
    """The town with trees in courts, and with a class for the points of each building."""
    for building in town:
        seen_as = int(rng.choice(_SEEN_AS, p=_SEEN_SHARE))
        for wing in building.wings:
            wing.seen_as = seen_as
        building.crowns = [
            (x, y, building.floor_m + 7, rng.uniform(2, 4), rng.uniform(2, 4), 0.5)
            for ring in building.footprint.interiors
            for x, y in rng.uniform(ring.bounds[:2], ring.bounds[2:], (3, 2)).tolist()
        ]
    return town


def _draw_complex(shape: str, rng: np.random.Generator) -> list[Wing]:
    """Buildings on both sides of a passage, the first of this shape."""
    wings, ends = list[Wing](), np.zeros(2)
    for name in [shape, *rng.choice(SHAPES, int(rng.integers(1, 6))).tolist()]:
        part, side = _SHAPES[name](rng), int(np.argmin(ends))
        corner = np.concatenate([wing.outline for wing in part]) * (1 - 2 * side)
        low, high = corner.min(axis=0), corner.max(axis=0)
        if ends.any() and ends[side] + high[0] - low[0] > _LONGEST_M:
            continue
        # beside the passage, which it overlaps
        shift = np.round((ends[side] - low[0], 1 - low[1] if side == 0 else -1 - high[1]), 3)
        wings += [replace(wing, outline=wing.outline * (1 - 2 * side) + shift) for wing in part]
        ends[side] += high[0] - low[0] + rng.uniform(4, 8)
    eave, roof = rng.uniform(3.2, 5), str(rng.choice(["flat", "gable"]))
    passage = body((0, 0), 0, (0, -3, float(np.round(ends.max() - 4, 3)), 3), eave, 20, roof)
    return [passage, *wings, *_furniture(wings, rng)]


def _furniture(wings: list[Wing], rng: np.random.Generator) -> list[Wing]:
    """Dormers, set-backs, skylights and parapets, where no higher body is in their way."""
    result, todo = list[Wing](), list(wings)
    for wing in todo:
        length, deep = np.linalg.norm(np.diff(wing.outline[:3], axis=0), axis=1)
        if len(wing.outline) != 4 or deep < 7 or length < 10 or rng.random() < 0.4:
            continue
        if not wing.slopes:
            added = {0: _on_level(length, deep, wing.eave_m, rng)}
        elif {0, 2} <= {*wing.slopes}:
            roof = "gable" if wing.slopes == (0, 2) else "hip"
            # a dormer of draw_dormers is on the south of a body around the axis
            added = {side: draw_dormers(wing, roof, length, deep, rng, 12) for side in (0, 2)}
            for each in (each for bodies in added.values() for each in bodies):
                each.outline = np.add(each.outline, (0, deep / 2))
        else:
            continue
        above = [other for other in [*wings, *result] if other is not wing and other.ridge_m > wing.eave_m]
        taken = shapely.union_all([shapely.Polygon(other.outline) for other in above]).buffer(0.5)
        for side, bodies in added.items():
            start, along, inward, _ = block_side(wing.outline, side)
            for each in bodies:
                each.outline = np.round(to_world(start, along, inward, each.outline.tolist()), 3)
                if not taken.intersects(shapely.Polygon(each.outline)):
                    result.append(each)
                    todo += [each] if each.detail == "" else []
    return result


def _on_level(length: float, deep: float, top: float, rng: np.random.Generator) -> list[Wing]:
    """A set-back, or rows of skylights; perhaps with parapets."""
    edge = parapets((0, 0, length, deep), top + rng.uniform(0.2, 0.8)) if rng.random() < 0.5 else []
    if min(length, deep) > 14 and rng.random() < 0.4:
        back, side = rng.uniform(2.5, 5, 2)
        box = (back, side, length - back, deep - side)
        return [*edge, body((0, 0), 0, box, top + rng.uniform(2.8, 4), 0, "flat")]
    wide, number, rows = rng.uniform(1.6, 3.5), int((length - 2) / rng.uniform(5, 9)), int(deep / 18) + 1
    roof, pitch, curb = str(rng.choice(["gable", "flat", "shed"])), rng.uniform(15, 35), rng.uniform(0.4, 1)
    places = itertools.product((np.arange(number) + 0.5) * length / number, np.arange(rows) * deep / rows)
    return edge + [
        body((u, v), 90, (1.5, -wide / 2, deep / rows - 1.5, wide / 2), top + curb, pitch, roof)
        for u, v in places
    ]


def _ring(
    x: float, y: float, radius: float, num_edges: int, turn_deg: float, span_deg: float = 360.0
) -> np.ndarray:
    """A regular polygon, or with a smaller ``span_deg`` the part of it from the direction ``turn_deg`` on. A part is
    rounded to millimetres, as the body beside it is. A whole polygon is not, so that its planes meet in one point."""
    number = num_edges if span_deg == 360 else num_edges + 1
    angle = np.radians(turn_deg + np.arange(number) * span_deg / num_edges)
    ring = np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle)])
    return ring if span_deg == 360 else np.round(ring, 3)


def _around_court(box: Box, deep: float, eave: float, pitch: float) -> list[Wing]:
    """Four wings with hips where they meet."""
    x0, y0, x1, y1 = box
    return [
        body((0, 0), 0, (x0, y0, x1, y0 + deep), eave, pitch, "hip"),
        body((0, 0), 0, (x0, y1 - deep, x1, y1), eave, pitch, "hip"),
        body((x0 + deep, 0), 90, (y0, 0, y1, deep), eave, pitch, "hip"),
        body((x1, 0), 90, (y0, 0, y1, deep), eave, pitch, "hip"),
    ]


def _tower(x: float, y: float, wide: float, eave: float, rng: np.random.Generator) -> Wing:
    """A square or round tower, with or without a spire."""
    num_edges, turn_deg = (16, 0.0) if rng.random() < 0.4 else (4, 45.0)
    ring = _ring(x, y, wide / 2 / np.cos(np.radians(turn_deg)), num_edges, turn_deg)
    pitch = float(rng.choice([0.0, rng.uniform(25, 65)], p=[0.25, 0.75]))
    return Wing(ring, eave, pitch, tuple(range(len(ring))) if pitch else ())


def _draw_school(rng: np.random.Generator) -> list[Wing]:
    """A long body with wings on both sides like a comb, and stairs higher than the roof where they meet."""
    deep, number = rng.uniform(11, 15), int(rng.integers(4, 9))
    apart = rng.uniform(17, 24)
    length, eave = number * apart, rng.uniform(7, 13)
    is_level = rng.random() < 0.3
    roof, pitch = ("flat", 0.0) if is_level else (str(rng.choice(["gable", "hip"])), rng.uniform(18, 45))
    main = body((0, 0), 0, (0, -deep / 2, length, deep / 2), eave, pitch, roof)
    wings = [main]
    for k in range(number):
        u, side = (k + 0.5) * apart, 1 if k % 2 == 0 or rng.random() < 0.4 else -1
        wide, reach = rng.uniform(8, 11), rng.uniform(18, 32)
        lower = float(rng.choice([0.0, rng.uniform(0.5, 3.5)]))
        box = (0.0, -wide / 2, reach, wide / 2)
        kind = "flat" if is_level or rng.random() < 0.2 else "gable"
        wings.append(body((u, 0), 90 * side, box, eave - lower, pitch, kind))
        if rng.random() < 0.5:
            top = main.ridge_m + rng.uniform(0.6, 2)
            place = (u + wide / 2, side * deep / 2, u + wide / 2 + 4, side * (deep / 2 + 4))
            box = (place[0], min(place[1::2]), place[2], max(place[1::2]))
            wings.append(body((0, 0), 0, box, top, 0, "flat"))
    return wings if is_level else wings + draw_dormers(main, roof, length, deep, rng, 12)


def _draw_convent(rng: np.random.Generator) -> list[Wing]:
    """Courts in a row, with walks around them, and a church on one side."""
    deep, eave, pitch = rng.uniform(8, 11), rng.uniform(6, 11), rng.uniform(22, 42)
    size, wings, x = rng.uniform(34, 48), list[Wing](), 0.0
    for _ in range(int(rng.integers(2, 4))):
        wide = rng.uniform(34, 55)
        wings += _around_court((x, 0, x + wide, size), deep, eave, pitch)
        walk = 3.5
        inner = (x + deep, deep, x + wide - deep, size - deep)
        for side, box in enumerate(_sides(inner, walk)):
            # the high side of a walk is at the wing
            wings.append(_shed(box, side, 3.2, rng.uniform(12, 25)))
        x += wide - deep
    return wings + _church(0.0, size, x, rng)


def _sides(box: Box, deep: float) -> list[Box]:
    x0, y0, x1, y1 = box
    return [
        (x0, y0, x1, y0 + deep),
        (x1 - deep, y0, x1, y1),
        (x0, y1 - deep, x1, y1),
        (x0, y0, x0 + deep, y1),
    ]


def _shed(box: Box, side: int, eave: float, pitch: float) -> Wing:
    """A roof that falls from one side of a box to the opposite one: away from the south, east, north or west side."""
    low = body((0, 0), 0, box, eave, pitch, "shed")
    return replace(low, slopes=((side + 2) % 4,))


def _church(x: float, y: float, length: float, rng: np.random.Generator) -> list[Wing]:
    """A nave between aisles, with a transept, a round end and a tower, to the north of ``y``."""
    wide, eave, pitch = rng.uniform(9, 13), rng.uniform(13, 18), rng.uniform(38, 55)
    aisle = rng.uniform(4, 6)
    middle = y + aisle + wide / 2
    length = min(length, rng.uniform(38, 60))
    low = rng.uniform(5.5, 7)
    nave = body((x, middle), 0, (0, -wide / 2, length, wide / 2), eave, pitch, "gable")
    south = _shed((x, middle - wide / 2 - aisle, x + length, middle - wide / 2), 2, low, rng.uniform(15, 28))
    north = _shed((x, middle + wide / 2, x + length, middle + wide / 2 + aisle), 0, low, rng.uniform(15, 28))
    reach = wide / 2 + aisle + 3
    transept = body(
        (x + 0.7 * length, middle), 90, (-reach, -wide / 2, reach, wide / 2), eave, pitch, "gable"
    )
    apse = _ring(x + length, middle, wide / 2, 8, -90.0, 180.0)
    end = Wing(apse, eave - 3, pitch - 10, tuple(range(8)))
    tower = _tower(x + 2, middle, rng.uniform(6, 8), nave.ridge_m + rng.uniform(4, 15), rng)
    return [nave, south, north, transept, end, tower]


def _draw_church(rng: np.random.Generator) -> list[Wing]:
    return _church(0, 0, 60, rng)


def _draw_palace(rng: np.random.Generator) -> list[Wing]:
    """Wings around a court that is open on one side, with pavilions at the corners and rows of dormers."""
    deep, eave = rng.uniform(11, 14), rng.uniform(9, 14)
    length, reach = rng.uniform(60, 110), rng.uniform(30, 55)
    roof = str(rng.choice(["mansard", "hip"]))
    pitch = rng.uniform(30, 45)
    main = body((0, 0), 0, (0, -deep / 2, length, deep / 2), eave, pitch, roof)
    wings = [main, *draw_dormers(main, "hip", length, deep, rng, 20)]
    for u in (deep / 2, length - deep / 2):
        side = body((u, 0), 90, (0, -deep / 2, reach, deep / 2), eave, pitch, roof)
        wings.append(side)
    wide = deep + rng.uniform(2, 5)
    high = rng.uniform(1, 4)
    for u, v in (
        (deep / 2, 0),
        (length - deep / 2, 0),
        (deep / 2, reach),
        (length - deep / 2, reach),
        (length / 2, 0),
    ):
        ring = _ring(u, v, wide / np.sqrt(2), 4, 45.0)
        wings.append(Wing(ring, eave + high, float(rng.uniform(30, 55)), (0, 1, 2, 3)))
    return wings


def _draw_factory(rng: np.random.Generator) -> list[Wing]:
    """Halls with saw teeth, and level parts of several heights beside them."""
    deep, number, length = rng.uniform(5, 9), int(rng.integers(8, 17)), rng.uniform(30, 65)
    eave, pitch = rng.uniform(5, 8), rng.uniform(16, 32)
    size = number * deep
    wings = [
        body((0, 0), 0, (0, k * deep, length, (k + 1) * deep), eave, pitch, "shed") for k in range(number)
    ]
    x = length
    for _ in range(int(rng.integers(2, 6))):
        wide, low = rng.uniform(10, 25), rng.uniform(0, 0.4) * size
        high = rng.uniform(0.6, 1) * size
        top = rng.uniform(4, 14)
        wings.append(body((0, 0), 0, (x, low, x + wide, high), top, 0, "flat"))
        for _ in range(int(rng.integers(0, 4))):
            u, v = rng.uniform(x + 1, x + wide - 5), rng.uniform(low + 1, high - 5)
            wings.append(body((0, 0), 0, (u, v, u + 4, v + 4), top + rng.uniform(0.8, 3), 0, "flat"))
        x += wide
    return wings


def _draw_round(rng: np.random.Generator) -> list[Wing]:
    """A round hall with a lower ring around it, towers and level wings."""
    radius, eave = rng.uniform(12, 22), rng.uniform(8, 14)
    number = int(rng.choice([16, 24, 32]))
    inner = Wing(_ring(0, 0, radius, number, 0), eave + 4, float(rng.uniform(10, 30)), tuple(range(number)))
    outer = Wing(_ring(0, 0, radius + 6, number, 0), eave - 2, 0.0, ())
    wings = [outer, inner]
    for turn_deg in (0, 90, 180, 270)[: int(rng.integers(2, 5))]:
        # it begins within the hall
        box = (0.7 * radius, -8.0, radius + rng.uniform(15, 35), 8.0)
        kind = str(rng.choice(["gable", "flat", "hip"]))
        wings.append(body((0, 0), turn_deg, box, eave - 3, rng.uniform(15, 35), kind))
    angle = np.radians(45)
    place = (radius + 5) * np.array([np.cos(angle), np.sin(angle)])
    return [
        *wings,
        _tower(float(place[0]), float(place[1]), rng.uniform(5, 8), eave + rng.uniform(6, 15), rng),
    ]


_SHAPES: dict[str, Draw] = {
    "school": _draw_school,
    "convent": _draw_convent,
    "palace": _draw_palace,
    "factory": _draw_factory,
    "church": _draw_church,
    "round": _draw_round,
}
SHAPES: Sequence[str] = tuple(_SHAPES)
