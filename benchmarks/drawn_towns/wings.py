"""A town of houses whose roofs consist of several bodies, and their true roofs.

Each body has a convex outline and planes that rise from its edges, so that its solid is exactly the intersection of
half-spaces; a building is the union of its bodies. Details (parapets and camber of level roofs, chimneys) are surveyed,
but do not belong to the true roof. All sizes below are in metres and degrees.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import shapely
from manifold3d import CrossSection, Manifold, OpType

from p2wss.towns.buildings import DrawnBuilding, Wing
from p2wss.towns.houses import draw_eave_m, rectangle, to_world
from p2wss.towns.site import LIDAR_RADIUS_M, LIDAR_X_MIN, LIDAR_Y_MAX

SHAPES = ("plain", "L", "T", "U", "cross", "oblique", "manor", "flat", "sheds", "hall", "row")
_GAP_M = 8.0
_MARGIN_M = 12.0
_MANSARD_DEG = 65.0
_SIMPLIFY_M = 0.002
_INNER = ("gable", "hip", "half-hip")  # roofs whose ridge is in the middle


def draw_wings(rng: np.random.Generator, shapes: Sequence[str] = SHAPES) -> list[DrawnBuilding]:
    """Groups of these ``shapes``. A row or terrace is a group of several buildings, any other shape a group of one."""
    return draw_groups(rng, shapes, _draw_group)


def draw_groups(
    rng: np.random.Generator,
    shapes: Sequence[str],
    draw: Callable[[str, np.random.Generator], list[list[Wing]]],
) -> list[DrawnBuilding]:
    """Groups of these ``shapes`` in turn, each turned at random, in lines within the LiDAR tile. draw: a function of a
    shape that gives the bodies of each building of a group, in the group's own frame."""
    town: list[DrawnBuilding] = []
    x, y, depth = LIDAR_X_MIN + _MARGIN_M, LIDAR_Y_MAX - _MARGIN_M, 0.0
    for shape in itertools.cycle(shapes):
        group = draw(shape, rng)
        turn = rng.uniform(0, 2 * np.pi)
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        corner = np.concatenate([wing.outline for wings in group for wing in wings]) @ rotation
        low, size = corner.min(axis=0), np.ptp(corner, axis=0)
        if x + size[0] > LIDAR_X_MIN + LIDAR_RADIUS_M:
            x, y, depth = LIDAR_X_MIN + _MARGIN_M, y - depth - _GAP_M, 0.0
        if y - size[1] < LIDAR_Y_MAX - LIDAR_RADIUS_M:
            return town
        for wings in group:
            for wing in wings:
                wing.outline = wing.outline @ rotation + (x, y - size[1]) - low
        buildings = [DrawnBuilding(wings, shape) for wings in group]
        _map(buildings, rng)
        town += buildings
        x, depth = x + size[0] + _GAP_M, max(depth, size[1])
    return town


def draw_terraces(rng: np.random.Generator) -> list[DrawnBuilding]:
    """Rows of houses with parts behind them."""
    return draw_wings(rng, ("terrace",))


def _map(buildings: list[DrawnBuilding], rng: np.random.Generator) -> None:
    """Give a group of buildings the footprints of a map: outlines of the eaves or of the walls behind them, simplified.
    The errors are smooth over a few metres, so that neighbours keep their common corners."""
    steepest = max(wing.pitch_deg for building in buildings for wing in building.wings)
    overhang = rng.uniform(0, 0.35) * np.cos(np.radians(steepest)) if rng.random() < 0.4 else 0.0
    wave, phase = rng.normal(0, 1, (2, 2)), rng.uniform(0, 2 * np.pi, 2)
    error = rng.uniform(0, 0.12)
    for building in buildings:
        back = overhang if len(buildings) == 1 else 0.0
        walls = shapely.set_precision(building.footprint, 0.0).buffer(-back, join_style="mitre")
        mapped = shapely.transform(walls.simplify(0.25), lambda xy: xy + error * np.sin(xy @ wave + phase))
        building.footprint = cast(shapely.Polygon, shapely.normalize(shapely.set_precision(mapped, 0.1)))


def body(
    origin: Sequence[float],
    turn_deg: float,
    box: tuple[float, float, float, float],
    eave: float,
    pitch: float,
    roof: str,
    ends: tuple[int, ...] = (1, 3),
) -> Wing:
    """A body in a rectangle whose ridge runs along its first axis. ends: the ends with a hip: 1 where the ridge ends, 3
    where it starts."""
    along = np.array([np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))])
    inward = np.array([-along[1], along[0]])
    outline = np.round(to_world(np.array(origin), along, inward, rectangle(*box)), 3)
    half, tangent = (box[3] - box[1]) / 2, np.tan(np.radians(pitch))
    if roof == "mansard":
        upper, break_m = 0.4 * pitch, min(half / 2, 1.5)
        above = break_m * (np.tan(np.radians(_MANSARD_DEG)) - np.tan(np.radians(upper)))
        return Wing(outline, eave, _MANSARD_DEG, (0, 2), ((0, above, upper), (2, above, upper)))
    if roof == "half-hip":
        return Wing(outline, eave, pitch, (0, 2), tuple((end, 0.55 * half * tangent, pitch) for end in ends))
    if roof == "uneven":
        return Wing(outline, eave, pitch, (0,), ((2, 0.0, 0.6 * pitch),))
    slopes = {"gable": (0, 2), "hip": (0, 2, *ends), "shed": (0,), "flat": ()}[roof]
    return Wing(outline, eave, pitch, slopes)


def _draw_group(shape: str, rng: np.random.Generator) -> list[list[Wing]]:
    """The bodies of each building of a group, in the group's own frame."""
    if shape == "row":
        return _draw_row(rng)
    if shape == "terrace":
        return _draw_terrace(rng)
    if shape == "flat":
        return [_draw_flat(rng)]
    if shape == "sheds":
        number, depth, pitch = int(rng.integers(2, 6)), rng.uniform(5, 10), rng.uniform(3, 25)
        length, eave = rng.uniform(8, 40), rng.uniform(2.8, 6)
        boxes = [(0, k * depth, length, (k + 1) * depth) for k in range(number)]
        return [[body((0, 0), 0, box, eave, pitch, "shed") for box in boxes]]
    if shape == "hall":
        length, width = rng.uniform(20, 60), rng.uniform(12, 30)
        roof = str(rng.choice(["gable", "hip", "uneven", "shed"], p=[0.6, 0.15, 0.15, 0.1]))
        main = body(
            (0, 0), 0, (0, -width / 2, length, width / 2), rng.uniform(4, 8), rng.uniform(2, 14), roof
        )
        return [[main, *_annex(main, length, width, rng)]]
    width = rng.uniform(6, 12)
    length = width * rng.uniform(1.2, 2.4)
    low = rng.random() < 0.2
    pitch = rng.uniform(4, 15) if low else rng.uniform(20, 55)
    eave = float(np.clip(draw_eave_m(int(rng.integers(1, 4)), rng), 2.5, 12))
    roof = str(rng.choice([*_INNER, "uneven", "mansard"], p=[0.45, 0.25, 0.1, 0.1, 0.1]))
    main = body((0, 0), 0, (0, -width / 2, length, width / 2), eave, pitch, roof)
    wings = [main]
    across = min(rng.uniform(0.45, 0.8) * width, 0.35 * length)
    skew = rng.choice([0, rng.uniform(-35, 35)])
    # where wings leave the axis of the main body, and in which direction
    places: list[tuple[float, float]] = {
        "L": [(length - across / 2, 90)],
        "T": [(rng.uniform(0.35, 0.65) * length, 90)],
        "U": [(across / 2, 90), (length - across / 2, 90)],
        "cross": [(rng.uniform(0.35, 0.65) * length, 90 + skew)],
        "oblique": [(rng.uniform(0.3, 0.7) * length, 90 + rng.choice([-1, 1]) * rng.uniform(12, 40))],
        "manor": [(across / 2, 90), (length - across / 2, rng.choice([-90, 90])), (length / 2, -90 + skew)],
    }.get(shape, [])
    for u, turn_deg in places:
        lift = rng.choice([0.0, -rng.uniform(0.4, 3), rng.uniform(0.4, 1.5)], p=[0.6, 0.25, 0.15])
        wing_pitch = pitch * rng.choice([1.0, rng.uniform(0.7, 1.2)], p=[0.6, 0.4])
        wing_roof = "gable" if roof not in _INNER or rng.random() < 0.4 else roof
        reach = width / 2 / np.sin(np.radians(abs(turn_deg))) + rng.uniform(2.5, 8)
        box = (-reach if shape == "cross" else 0.0, -across / 2, reach, across / 2)
        wings.append(_wing(main, u, turn_deg, box, max(eave + lift, 2.3), wing_pitch, wing_roof))
    if rng.random() < 0.3:
        wings += _annex(main, length, width, rng)
    if roof in _INNER and rng.random() < 0.5:
        wings += draw_dormers(main, roof, length, width, rng)
    if rng.random() < 0.5:
        u, v = rng.uniform(0.1, 0.9) * length, rng.uniform(-0.2, 0.2) * width
        chimney = body((u, v), 0, (0, 0, 0.7, 0.6), main.ridge_m + rng.uniform(0.3, 1), 0, "flat")
        wings.append(replace(chimney, detail="chimney"))
    return [wings]


def _wing(
    main: Wing,
    u: float,
    turn_deg: float,
    box: tuple[float, float, float, float],
    eave: float,
    pitch: float,
    roof: str,
) -> Wing:
    """A body across the main body, from ``u`` on its axis. If the main roof does not hide its start, it begins at the
    far side of the main body."""
    wing = body((u, 0), turn_deg, box, eave, pitch, roof, (1,) if box[0] == 0 else (1, 3))
    start = np.vstack([wing.outline[[0, 3]], [[u, 0.0]]])
    is_hidden = main.eave_m + main.rise_m(start) >= wing.eave_m + wing.rise_m(start) + 0.05
    if box[0] < 0 or is_hidden.all():
        return wing
    back = float(np.ptp(main.outline[:, 1])) / 2
    return _wing(main, u, turn_deg, (-back, *box[1:]), eave, pitch, roof)


def _annex(main: Wing, length: float, width: float, rng: np.random.Generator) -> list[Wing]:
    """A garage or an extension at the end of the main body; none if the main body is too low."""
    eave, deep = rng.uniform(2.3, 2.8), rng.uniform(3, 6.5)
    if main.eave_m < eave + 0.3:
        return []
    low, high = sorted(rng.uniform(-width / 2, width / 2, 2))
    if high - low < 3:
        low, high = -width / 2, width / 2
    roof = str(rng.choice(["flat", "shed", "gable"], p=[0.5, 0.3, 0.2]))
    # the low side of a shed is away from the main body
    origin, turn_deg, box = ((length, 0), 0, (0, low, deep, high))
    if roof == "shed":
        origin, turn_deg, box = (length + deep, 0), 90, (low, 0, high, deep)
    return [body(origin, turn_deg, box, eave, rng.uniform(5, 20), roof)]


def draw_dormers(
    main: Wing, roof: str, length: float, width: float, rng: np.random.Generator, most: int = 3
) -> list[Wing]:
    """Equal dormers on one side, from the ridge to a wall behind the eave."""
    wide, back, wall = rng.uniform(1.4, 2.6), rng.uniform(0.4, 1.2), rng.uniform(1.0, 1.5)
    kind = str(rng.choice(["gable", "shed", "flat"], p=[0.5, 0.25, 0.25]))
    margin = wide / 2 + (width / 2 if roof != "gable" else 0.8)
    number = min(int(rng.integers(1, most + 1)), max(int((length - 2 * margin) / (wide + 0.8) + 1), 0))
    deep = width / 2 - back
    eave = main.eave_m + back * np.tan(np.radians(main.pitch_deg)) + wall
    places = (np.arange(number) + 0.5) / number * (length - 2 * margin) + margin
    bodies = [
        body((u + wide / 2, -width / 2 + back), 0, (-wide, 0, 0, deep), eave, main.pitch_deg / 4, "shed")
        if kind == "shed"
        else body((u, 0), -90, (0, -wide / 2, deep, wide / 2), eave, main.pitch_deg, kind)
        for u in places
    ]
    return [body for body in bodies if body.ridge_m < main.ridge_m - 0.1]


def _draw_flat(rng: np.random.Generator) -> list[Wing]:
    """Level or slightly cambered bodies of one or several heights, some with parapets."""
    length, width, eave = rng.uniform(10, 45), rng.uniform(8, 25), rng.uniform(3, 12)
    cut = rng.uniform(0.3, 0.7) * length
    step = rng.choice([-1, 1]) * rng.uniform(0.4, 3.2)
    boxes = [(0.0, 0.0, length, width, eave)]
    if rng.random() < 0.7:
        side = rng.uniform(-0.3, 0.3) * width
        boxes = [
            (0.0, 0.0, cut, width, eave),
            (cut, side, length, width + side, max(float(eave + step), 2.5)),
        ]
    camber = rng.uniform(0.3, 1.2) if rng.random() < 0.5 else 0.0
    high = rng.uniform(0.2, 0.8) if rng.random() < 0.5 else 0.0
    wings, details = [], []
    for x0, y0, x1, y1, top in boxes:
        wings.append(body((0, 0), 0, (x0, y0, x1, y1), top, 0, "flat"))
        details.append(body((0, 0), 0, (x0, y0, x1, y1), top, camber, "hip"))
        if high:
            details += parapets((x0, y0, x1, y1), top + high)
    return wings + [replace(detail, detail="parapet or camber") for detail in details]


def parapets(box: tuple[float, float, float, float], top_m: float) -> list[Wing]:
    """Parapets along the sides of a level roof."""
    x0, y0, x1, y1 = box
    strips = [
        (x0, y0, x1, y0 + 0.3),
        (x0, y1 - 0.3, x1, y1),
        (x0, y0, x0 + 0.3, y1),
        (x1 - 0.3, y0, x1, y1),
    ]
    return [replace(body((0, 0), 0, strip, top_m, 0, "flat"), detail="parapet") for strip in strips]


def _draw_row(rng: np.random.Generator) -> list[list[Wing]]:
    """Similar houses with party walls; at one of them the heights may step."""
    wide, width, eave, pitch = (
        round(rng.uniform(5, 8), 3),
        rng.uniform(8, 11),
        rng.uniform(4.5, 8),
        rng.uniform(25, 48),
    )
    roof = str(rng.choice(["gable", "uneven", "mansard"], p=[0.7, 0.15, 0.15]))
    house = [body((0, 0), 0, (0, -width / 2, wide, width / 2), eave, pitch, roof)]
    if roof == "gable" and rng.random() < 0.5:
        house += draw_dormers(house[0], roof, wide, width, rng)
    if rng.random() < 0.5:
        box = (0, width / 2, rng.uniform(0.4, 0.6) * wide, width / 2 + rng.uniform(2.5, 4.5))
        house.append(body((0, 0), 0, box, 2.7, 0, "flat"))
    number = int(rng.integers(3, 8))
    step_m = (np.arange(number) >= rng.integers(number)) * rng.choice([0, rng.uniform(0.3, 2)])
    return [
        [
            replace(wing, outline=np.add(wing.outline, (k * wide, 0)), eave_m=wing.eave_m + step_m[k])
            for wing in house
        ]
        for k in range(number)
    ]


def _draw_terrace(rng: np.random.Generator) -> list[list[Wing]]:
    """Houses wall to wall under one roof. Most have a lower part of their own behind it, often as wide as the house, so
    that the footprint does not show it."""
    wide, width = round(rng.uniform(4.5, 8), 3), rng.uniform(6.5, 10.5)
    eave, pitch = rng.uniform(2.8, 8), rng.uniform(22, 58)
    roof = str(rng.choice(["gable", "uneven", "mansard", "flat"], p=[0.65, 0.1, 0.05, 0.2]))
    with_dormers = roof == "gable" and rng.random() < 0.5
    houses = []
    for u in wide * np.arange(rng.integers(2, 8)):
        main = body((u, 0), 0, (0, -width / 2, wide, width / 2), eave, pitch, roof)
        house = [main]
        if with_dormers and rng.random() < 0.7:
            house += draw_dormers(main, roof, wide, width, rng)
            house[1:] = [replace(each, outline=np.add(each.outline, (u, 0))) for each in house[1:]]
        for side in (1, -1):
            if rng.random() < (0.75 if side == 1 else 0.15):
                deep, share = rng.uniform(1.2, 6), 1.0 if rng.random() < 0.6 else rng.uniform(0.35, 0.8)
                low_m = rng.uniform(2.2, min(eave + 0.5, 3.3 if rng.random() < 0.7 else 8))
                # the low side of a shed is away from the main body
                turn_deg, start = (180, u + share * wide) if side == 1 else (0, u)
                origin = (start, side * (width / 2 + deep))
                kind = "flat" if rng.random() < 0.65 else "shed"
                box = (0, 0, share * wide, deep)
                house.append(body(origin, turn_deg, box, low_m, rng.uniform(5, 25), kind))
        houses.append(house)
    return houses


def true_solids(town: Sequence[DrawnBuilding]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each building, the union of its bodies without its shafts, on the ground: vertices (v, 3) in the CRS,
    triangles (t, 3)."""
    for building in town:
        # in the frame of the drawing, rounded to 0.1 um, so that bodies side by side have the same coordinates
        origin, rotation = building.wings[0].outline[0], _axes(building.wings[0])
        bodies = [_prism(wing, origin, rotation) for wing in building.wings if not wing.detail]
        solid = Manifold.batch_boolean(bodies, OpType.Add)
        for wing in building.wings:
            if wing.detail == "shaft":
                above = _prism(replace(wing, eave_m=100.0), origin, rotation)
                solid -= above - _prism(wing, origin, rotation)
        mesh = solid.as_original().simplify(_SIMPLIFY_M).to_mesh64()
        vertex_m = np.add(mesh.vert_properties[:, :3], (0.0, 0.0, building.floor_m))
        vertex_m[:, :2] = vertex_m[:, :2] @ rotation.T + origin
        yield vertex_m, mesh.tri_verts.astype(np.int32)


def _axes(wing: Wing) -> np.ndarray:
    """The rotation (2, 2) by which rows in the CRS are multiplied to get the frame of a body."""
    along = wing.outline[1] - wing.outline[0]
    x, y = along / np.linalg.norm(along)
    return np.array([[x, -y], [y, x]])


def _prism(wing: Wing, origin: np.ndarray, rotation: np.ndarray) -> Manifold:
    """The solid of a body above z = 0, in the frame of its building."""
    turned = replace(wing, outline=np.round((wing.outline - origin) @ rotation, 7))
    solid = Manifold.extrude(CrossSection([turned.outline]), 100.0)
    for start, along, above_m, tangent in zip(*turned.planes(), strict=True):
        normal = np.array([-along[1] * tangent, along[0] * tangent, -1.0])
        offset = normal[:2] @ start - wing.eave_m - above_m
        solid = solid.trim_by_plane(normal, offset / np.linalg.norm(normal))
    return solid
