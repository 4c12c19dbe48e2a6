"""Draw the miniature: a small town in IGN's own formats, so that the whole pipeline runs without a network.

    python tests/mini/make.py [FOLDER] [--seed SEED]

writes into ``bdtopo/``, ``rgealti/`` and ``lidar/`` beside this file (or in FOLDER):

* BD TOPO footprints as a GeoPackage, layer ``batiment``, with the gaps that the real one has: heights
  that are null or 0, vertices at Z = -1000, repeated and near-collinear vertices, a few multipolygons;
* RGE ALTI terrain as 5 m ASC tiles;
* a *stand-in* for one LiDAR HD tile. Its roofs come from the wings drawn here and not from p2wss, its
  scanner swings like a pendulum, and its buildings have what the training data lacks: dormers, chimneys,
  garages lower than their house, trees. It is no LiDAR HD and no truth comes with it.

Everything follows from ``SEED``; nothing here uses p2wss. Another seed draws another town, on the same ground
without the LiDAR: footprints to train on.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyogrio
import shapely
import shapely.affinity
from pyproj import CRS

SEED = 652
X_MIN, Y_MIN, X_MAX, Y_MAX = 652_000, 6_860_000, 654_000, 6_862_000
CENTRE = np.array([653_000.0, 6_861_000.0])  # the church square, at the corner of the four tiles
LIDAR_X_MIN, LIDAR_Y_MAX = 653_000, 6_861_000  # north-west corner of the LiDAR tile: 0653_6861
LIDAR_TILE = shapely.box(LIDAR_X_MIN, LIDAR_Y_MAX - 1000, LIDAR_X_MIN + 1000, LIDAR_Y_MAX)
LIDAR_RADIUS_M = 370  # the LiDAR tile is built up to here only, to keep its file small
BLOCK_M = (80.0, 62.0)
HALF_STREET_M = 5.0
DATE = date(2026, 1, 15)  # in every header, so that a second run writes the same bytes


@dataclass
class Wing:
    """A piece of roof: eaves along ``slopes`` (edges of ``outline``), gables or walls along the others."""

    outline: np.ndarray  # (n, 2), counter-clockwise
    eave_m: float  # above the ground
    pitch_deg: float
    slopes: tuple[int, ...]  # edge i runs from vertex i to i + 1; none = a flat roof

    def rise_m(self, xy: np.ndarray) -> np.ndarray:
        """Roof above the eave at ``xy`` (n, 2): the lowest of the planes that rise from the eaves."""
        if not self.slopes:
            return np.zeros(len(xy))
        start = self.outline[list(self.slopes)]
        end = np.roll(self.outline, -1, axis=0)[list(self.slopes)]
        along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
        offset = xy[:, None, :] - start
        inside = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
        return np.maximum(inside, 0).min(axis=1) * np.tan(np.radians(self.pitch_deg))


@dataclass
class Building:
    """Wings that touch; their union is the footprint."""

    wings: list[Wing]
    kind: str  # house, row, block, hall, annex
    footprint: shapely.Polygon = field(default_factory=shapely.Polygon)

    def __post_init__(self) -> None:
        # 0.1 m is the resolution of BD TOPO; the tiny opening closes slits between wings
        union = shapely.union_all(
            [shapely.Polygon(wing.outline).buffer(0.01, join_style="mitre") for wing in self.wings]
        )
        union = shapely.set_precision(union.buffer(-0.01, join_style="mitre").simplify(0.03), 0.1)
        self.footprint = shapely.normalize(union)

    @property
    def eave_m(self) -> float:
        """Gutter of the largest wing."""
        return max(self.wings, key=lambda wing: shapely.Polygon(wing.outline).area).eave_m


# --- the ground -------------------------------------------------------------------------------------------


def ground_z_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A hill in the north-west, a valley in the south-east, some waves: 38 to 98 m."""
    u, v = (x - CENTRE[0]) / 1000, (y - CENTRE[1]) / 1000
    hill = 34 * np.exp(-((u + 0.75) ** 2 + (v - 0.6) ** 2) / 0.35)
    valley = -14 * np.exp(-((u - v - 1.1) ** 2) / 0.2)
    waves = 2.2 * np.sin(9 * u + 4 * v) + 1.1 * np.sin(17 * v - 6 * u)
    return 58 + hill + valley + waves + 5 * v


def write_terrain(folder: Path) -> None:
    """One ASC tile per kilometre: cells of 5 m centred on multiples of 5 m, north row first."""
    folder.mkdir(parents=True, exist_ok=True)
    cell, size = 5, 200
    for x_min in range(X_MIN, X_MAX, 1000):
        for y_max in range(Y_MIN + 1000, Y_MAX + 1, 1000):
            x, y = np.meshgrid(x_min + cell * np.arange(size), y_max - cell * np.arange(size))
            rows = [" ".join(f"{z:.2f}" for z in row) for row in ground_z_m(x, y)]
            header = (
                f"ncols        {size}\nnrows        {size}\n"
                f"xllcorner    {x_min - cell / 2:.12f}\n"
                f"yllcorner    {y_max - cell * size + cell / 2:.12f}\n"
                f"cellsize     {cell:.12f}\nNODATA_value  -99999.00\n"
            )
            name = f"RGEALTI_FXX_{x_min // 1000:04d}_{y_max // 1000:04d}_MNT_LAMB93_IGN69.asc"
            (folder / name).write_text(header + "\n".join(rows) + "\n")


# --- the town ---------------------------------------------------------------------------------------------


def draw_town(rng: np.random.Generator) -> list[Building]:
    """Blocks between bent streets: closed blocks in the centre, then rows, then detached houses and halls."""
    town: list[Building] = []
    for block in _blocks(rng):
        centre = block.mean(axis=0)
        radius_m = float(np.hypot(*(centre - CENTRE)))
        kind = _block_kind(radius_m, rng)
        if kind == "closed":
            town += _closed_block(block, rng)
        elif kind == "courtyard":
            town.append(_courtyard_building(block, rng))
        elif kind == "rows":
            town += _rows(block, rng)
        elif kind == "halls":
            town += _halls(block, rng)
        elif kind == "houses":
            town += _houses(block, rng)
    return [building for building in town if _has_room(building.footprint)]


def _has_room(footprint: shapely.Geometry) -> bool:
    """Inside the region; in the LiDAR tile only near the centre and not where its cloud ends."""
    if footprint.geom_type != "Polygon" or not footprint.is_valid:
        return False
    if not shapely.box(X_MIN + 6, Y_MIN + 6, X_MAX - 6, Y_MAX - 6).contains(footprint):
        return False
    if _in_lidar_tile(footprint) and footprint.distance(shapely.Point(CENTRE)) > LIDAR_RADIUS_M:
        return False
    return bool(footprint.distance(LIDAR_TILE.exterior) > 3)


def _in_lidar_tile(geometry: shapely.Geometry) -> bool:
    return bool(LIDAR_TILE.contains(geometry))


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
    found = []
    for a in range(2 * reach):
        for b in range(2 * reach):
            quad = np.array([corner[a, b], corner[a + 1, b], corner[a + 1, b + 1], corner[a, b + 1]])
            inner = shapely.Polygon(quad).buffer(-HALF_STREET_M, join_style="mitre")
            ring = shapely.get_coordinates(shapely.orient_polygons(inner))[:-1]
            if len(ring) == 4 and inner.area > 1200:
                found.append(ring)
    return found


def _block_kind(radius_m: float, rng: np.random.Generator) -> str:
    if radius_m < 190:
        return str(rng.choice(["closed", "courtyard", "rows", "halls"], p=[0.6, 0.15, 0.2, 0.05]))
    if radius_m < 400:
        return str(rng.choice(["closed", "rows", "houses", "halls", "park"], p=[0.1, 0.5, 0.28, 0.05, 0.07]))
    if radius_m < 960:
        return str(rng.choice(["rows", "houses", "halls", "park"], p=[0.08, 0.36, 0.05, 0.51]))
    return "park"


def _edge(block: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Start, direction, inward normal and length of a side of a counter-clockwise block."""
    start, end = block[side], block[(side + 1) % len(block)]
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    return start, along, np.array([-along[1], along[0]]), length


def _frame(
    origin: np.ndarray, along: np.ndarray, inward: np.ndarray, corners: list[tuple[float, float]]
) -> np.ndarray:
    """World coordinates of (distance along, distance inward) pairs."""
    return np.array([origin + a * along + b * inward for a, b in corners])


def _box(u0: float, v0: float, u1: float, v1: float) -> list[tuple[float, float]]:
    return [(u0, v0), (u1, v0), (u1, v1), (u0, v1)]


def _widths(length: float, low: float, high: float, rng: np.random.Generator) -> np.ndarray:
    """Cuts 0 .. length into lots of ``low`` to ``high`` metres."""
    number = max(1, round(length / rng.uniform(low, high)))
    width = rng.uniform(low, high, number)
    return np.concatenate([[0], np.cumsum(width * length / width.sum())])


def _pitch(rng: np.random.Generator) -> float:
    return float(rng.integers(22, 46))


def _closed_block(block: np.ndarray, rng: np.random.Generator) -> list[Building]:
    """Houses around a court: L-shaped ones at the corners, party walls between all of them."""
    depth = rng.uniform(9, 12)
    inner = _inset(block, depth)
    if inner is None:
        return _houses(block, rng)
    storeys = rng.integers(3, 5)
    corner_m = depth + rng.uniform(4, 7)
    found = []
    for side in range(4):
        start, along, inward, length = _edge(block, side)
        before = _edge(block, (side - 1) % 4)
        # the corner house at the start of this side: one wing on each street, mitred
        here = _frame(start, along, inward, [(corner_m, 0), (corner_m, depth)])
        there = _frame(start, -before[1], before[2], [(corner_m, 0), (corner_m, depth)])
        eave = _eave(storeys, rng)
        pitch = _pitch(rng)
        found.append(
            Building(
                [
                    Wing(np.array([start, here[0], here[1], inner[side]]), eave, pitch, (0, 2)),
                    Wing(np.array([there[0], start, inner[side], there[1]]), eave, pitch, (0, 2)),
                ],
                "block",
            )
        )
        cuts = corner_m + _widths(length - 2 * corner_m, 8, 15, rng)
        for u0, u1 in itertools.pairwise(cuts):
            eave = _eave(storeys, rng)
            outline = _frame(start, along, inward, _box(u0, 0, u1, depth))
            wings = [Wing(outline, eave, _pitch(rng), () if rng.random() < 0.15 else (0, 2))]
            if rng.random() < 0.2 and u1 - u0 > 9:  # a lower wing in the court
                back = _frame(start, along, inward, _box(u0, depth, u0 + 0.5 * (u1 - u0), depth + 5))
                wings.append(Wing(back, eave - 2.8, 20, (1,)))
            found.append(Building(wings, "block"))
    return found


def _eave(storeys: int, rng: np.random.Generator) -> float:
    return round(float(storeys * rng.uniform(2.8, 3.2) + rng.uniform(-0.4, 0.6)), 1)


def _inset(block: np.ndarray, distance_m: float) -> np.ndarray | None:
    """The block moved inwards: vertex i belongs to vertex i of ``block``. None if too little is left."""
    inner = shapely.Polygon(block).buffer(-distance_m, join_style="mitre")
    if inner.geom_type != "Polygon" or inner.area < 250:
        return None
    ring = shapely.get_coordinates(shapely.orient_polygons(inner))[:-1]
    if len(ring) != len(block):
        return None
    nearest = np.argmin(((block[:, None] - ring) ** 2).sum(axis=2), axis=1)
    return ring[nearest] if len(set(nearest)) == len(block) else None


def _courtyard_building(block: np.ndarray, rng: np.random.Generator) -> Building:
    """A school or a town hall: one building around its court."""
    outer = _inset(block, rng.uniform(3, 8))
    outer = block if outer is None else outer
    inner = _inset(outer, rng.uniform(8, 10))
    if inner is None:
        return _hall(block, rng)
    eave, pitch = _eave(3, rng), _pitch(rng)
    return Building(
        [
            Wing(np.array([outer[k], outer[(k + 1) % 4], inner[(k + 1) % 4], inner[k]]), eave, pitch, (0, 2))
            for k in range(4)
        ],
        "block",
    )


def _rows(block: np.ndarray, rng: np.random.Generator) -> list[Building]:
    """Row houses along the two long sides: shared side walls, ridges along the street."""
    found = []
    for side in (0, 2):
        start, along, inward, length = _edge(block, side)
        depth, storeys, setback = rng.uniform(8.5, 11), rng.integers(1, 4), rng.uniform(0, 5)
        pitch, eave = _pitch(rng), _eave(storeys, rng)
        cuts = 4 + _widths(length - 8, 6, 9.5, rng)
        for index, (u0, u1) in enumerate(itertools.pairwise(cuts)):
            if rng.random() < 0.3:  # not every house was built at the same time
                pitch, eave = _pitch(rng), _eave(storeys, rng)
            if rng.random() < 0.06:
                continue
            wings = [
                Wing(
                    _frame(start, along, inward, _box(u0, setback, u1, setback + depth)), eave, pitch, (0, 2)
                )
            ]
            if rng.random() < 0.22:
                width = rng.uniform(0.4, 0.6) * (u1 - u0)
                a, b = (u0, u0 + width) if index % 2 else (u1 - width, u1)
                back = _frame(
                    start, along, inward, _box(a, setback + depth, b, setback + depth + rng.uniform(3, 5))
                )
                wings.append(Wing(back, min(eave - 0.4, 2.7), 20, (2,)))
            found.append(Building(wings, "row"))
    return found


def _houses(block: np.ndarray, rng: np.random.Generator) -> list[Building]:
    """Detached houses on lots along all sides that leave room, some with a garage."""
    found: list[Building] = []
    taken: list[shapely.Geometry] = []
    for side in range(4):
        start, along, inward, length = _edge(block, side)
        cuts = _widths(length, 15, 20, rng)
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
            if not shapely.Polygon(block).contains(house.footprint) or any(map(around.intersects, taken)):
                continue
            found.append(house)
            taken.append(house.footprint)
    if rng.random() < 0.5:
        shed = _garden_shed(block, taken, rng)
        found += [shed] if shed else []
    return found


def _house(
    origin: np.ndarray,
    along: np.ndarray,
    inward: np.ndarray,
    width: float,
    depth: float,
    rng: np.random.Generator,
) -> Building:
    """A rectangle, an L, a T, a U, or a house with its garage."""

    def outline(*box: float) -> np.ndarray:
        return _frame(origin, along, inward, _box(*box))

    eave, pitch = _eave(int(rng.integers(1, 3)), rng), _pitch(rng)
    shape = rng.choice(["rectangle", "garage", "L", "T", "U"], p=[0.56, 0.14, 0.18, 0.07, 0.05])
    roof = rng.choice(["gable", "hip", "flat", "shed"], p=[0.6, 0.25, 0.1, 0.05])
    slopes = {"gable": (0, 2), "hip": (0, 1, 2, 3), "flat": (), "shed": (0,)}[roof]
    main = Wing(outline(0, 0, width, depth), eave, pitch, slopes)
    reach, part = rng.uniform(3, 5.5), rng.uniform(0.4, 0.5) * width
    if shape == "garage":
        side = outline(width, 0.5, width + rng.uniform(2.8, 3.6), 0.5 + rng.uniform(5, depth - 1))
        return Building([main, Wing(side, 2.5, 20, ())], "house")
    # a wing reaches half into the main roof, so that its ridge runs into it
    inner = depth / 2
    if shape == "L":
        return Building(
            [main, Wing(outline(width - part, inner, width, depth + reach), eave, pitch, (1, 3))], "house"
        )
    if shape == "T":
        left = (width - part) / 2
        return Building(
            [main, Wing(outline(left, inner, left + part, depth + reach), eave, pitch, (1, 3))], "house"
        )
    if shape == "U":
        ends = [(0, 0.35 * width), (0.65 * width, width)]
        wings = [Wing(outline(a, inner, b, depth + reach), eave, pitch, (1, 3)) for a, b in ends]
        return Building([main, *wings], "house")
    return Building([main], "house")


def _garden_shed(
    block: np.ndarray, taken: list[shapely.Geometry], rng: np.random.Generator
) -> Building | None:
    _, along, inward, _ = _edge(block, 0)
    origin = block.mean(axis=0) + rng.uniform(-8, 8, 2)
    width, depth = rng.uniform(3.5, 6, 2)
    corners = _frame(origin, along, inward, _box(0, 0, width, depth))
    shed = Building([Wing(corners, 2.4, 20, (0,) if rng.random() < 0.5 else ())], "annex")
    if any(map(shed.footprint.buffer(2).intersects, taken)):
        return None
    return shed


def _halls(block: np.ndarray, rng: np.random.Generator) -> list[Building]:
    return [_hall(block, rng)]


def _hall(block: np.ndarray, rng: np.random.Generator) -> Building:
    """A large hall, some with an office in front."""
    _, along, inward, length = _edge(block, 0)
    depth = _edge(block, 1)[3]
    width, deep = rng.uniform(0.5, 0.75) * length, rng.uniform(0.35, 0.55) * depth
    origin = block.mean(axis=0) - width / 2 * along - deep / 2 * inward
    eave = round(float(rng.uniform(5, 9)), 1)
    slopes = () if rng.random() < 0.4 else (0, 2)
    wings = [Wing(_frame(origin, along, inward, _box(0, 0, width, deep)), eave, 20, slopes)]
    if rng.random() < 0.4:
        wings.append(
            Wing(_frame(origin, along, inward, _box(width, 2, width + 8, 2 + 0.6 * deep)), 3.5, 20, ())
        )
    return Building(wings, "hall")


# --- BD TOPO ----------------------------------------------------------------------------------------------

USAGE = {
    "house": "Résidentiel",
    "row": "Résidentiel",
    "block": "Résidentiel",
    "hall": "Industriel",
    "annex": "Annexe",
}


def write_footprints(town: list[Building], path: Path, rng: np.random.Generator) -> None:
    """Layer ``batiment`` with the columns of BD TOPO, and with its gaps and blemishes."""
    rows, shapes = [], []
    tree = shapely.STRtree([building.footprint for building in town])
    for index, building in enumerate(town):
        outline = building.footprint
        corner = shapely.get_coordinates(outline)
        around = ground_z_m(corner[:, 0], corner[:, 1])
        low, high = round(float(around.min()), 1), round(float(around.max()), 1)
        eave = round(building.eave_m, 1)
        ridge = max(
            w.eave_m + w.rise_m(np.vstack([w.outline.mean(axis=0), w.outline])).max() for w in building.wings
        )
        gap = rng.random()
        height = None if gap < 0.08 else 0.0 if gap < 0.09 else eave
        roof_known = (height is not None and height > 0) or rng.random() < 0.4
        floors_known = building.kind in ("house", "row", "block") and rng.random() < 0.7
        flats = {"house": 1, "row": 1, "block": int(rng.integers(4, 12))}.get(building.kind)
        top = -1000.0 if rng.random() < 0.04 else low + eave
        parts = [_with_blemishes(outline, rng)]
        twin = shapely.affinity.translate(outline, 9.0, 4.0)
        if building.kind == "annex" and not len(tree.query(twin, "intersects")) and not _in_lidar_tile(twin):
            parts.append(twin)  # a few records have two parts
        shapes.append(shapely.force_3d(shapely.MultiPolygon(parts), top))
        rows.append(
            {
                "cleabs": f"BATIMENT{2_000_000_000 + 17 * index:016d}",
                "nature": "Industriel, agricole ou commercial"
                if building.kind == "hall"
                else "Indifférenciée",
                "usage_1": USAGE[building.kind],
                "usage_2": None,
                "construction_legere": building.kind == "annex" and rng.random() < 0.5,
                "etat_de_l_objet": "En service",
                "date_creation": None,
                "date_modification": None,
                "date_d_apparition": None,
                "date_de_confirmation": None,
                "sources": None,
                "identifiants_sources": None,
                "methode_d_acquisition_planimetrique": None,
                "methode_d_acquisition_altimetrique": None,
                "precision_planimetrique": 3.0,
                "precision_altimetrique": 1.0,
                "nombre_de_logements": flats,
                "nombre_d_etages": max(1, round(eave / 3)) if floors_known else None,
                "materiaux_des_murs": None,
                "materiaux_de_la_toiture": None,
                "hauteur": height,
                "altitude_minimale_sol": low,
                "altitude_minimale_toit": round(low + eave, 1) if roof_known else None,
                "altitude_maximale_toit": round(low + ridge, 1) if roof_known else None,
                "altitude_maximale_sol": high,
                "origine_du_batiment": "Cadastre",
                "appariement_fichiers_fonciers": None,
                "identifiants_rnb": None,
            }
        )
    frame = gpd.GeoDataFrame(rows, geometry=shapes, crs="EPSG:2154")
    text = [name for name in frame.columns if frame[name].isna().all()]
    frame[text] = frame[text].astype("string")
    frame[["nombre_de_logements", "nombre_d_etages"]] = frame[
        ["nombre_de_logements", "nombre_d_etages"]
    ].astype("Int32")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": f"{DATE.isoformat()}T00:00:00.000Z"})
    pyogrio.write_dataframe(
        frame,
        path,
        layer="batiment",
        driver="GPKG",
        geometry_type="MultiPolygon Z",
        GEOMETRY_NAME="geometrie",
    )


def _with_blemishes(outline: shapely.Polygon, rng: np.random.Generator) -> shapely.Polygon:
    """Some outlines get a vertex in the middle of an edge, or a vertex twice."""
    chance = rng.random()
    if chance > 0.12:
        return outline
    ring = list(map(tuple, shapely.get_coordinates(outline.exterior)[:-1]))
    at = int(rng.integers(len(ring)))
    a, b = np.array(ring[at]), np.array(ring[(at + 1) % len(ring)])
    ring.insert(at + 1, ring[at] if chance < 0.03 else tuple(np.round((a + b) / 2, 1)))
    return shapely.Polygon(ring, [hole.coords for hole in outline.interiors])


# --- the stand-in LiDAR tile ------------------------------------------------------------------------------

CELL_M = 0.1
FLIGHT_M = 850.0  # above the ground
SWING_DEG = 18.0
SWINGS_PER_S = 150.0  # half swings, from one side to the other
SPEED_M_S = 62.0
PULSES_PER_S = 270_000
HEADINGS_DEG = (64.0, 244.0)  # two strips, there and back
AROUND_M = 4.0  # points further from a building are left out, to keep the file small
UNCLASSIFIED, GROUND, TREE, BUILDING = 1, 2, 5, 6


def write_lidar(town: list[Building], path: Path, rng: np.random.Generator) -> None:
    """Scan the buildings of the LiDAR tile into LAZ (LAS 1.4, point format 6), in the order of flight."""
    built = [building for building in town if _in_lidar_tile(building.footprint)]
    surface = _Surface(built, rng)
    trees = _trees(built, rng)
    strips = [_scan(surface, trees, number, rng) for number in range(len(HEADINGS_DEG))]
    points = {name: np.concatenate([strip[name] for strip in strips]) for name in strips[0]}
    keep = surface.near(points["x"], points["y"]) & (points["x"] >= LIDAR_X_MIN) & (points["y"] < LIDAR_Y_MAX)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.01] * 3, [0, 0, 0]
    header.creation_date = DATE
    header.generating_software = "p2wss tests/mini/make.py"
    header.system_identifier = "stand-in, not LiDAR HD"
    header.add_crs(CRS("EPSG:2154"))
    cloud = laspy.LasData(header)
    for name, values in points.items():
        cloud[name] = values[keep]
    path.parent.mkdir(parents=True, exist_ok=True)
    cloud.write(path)


class _Surface:
    """Height of the top surface and its class on a fine raster around the buildings."""

    def __init__(self, built: list[Building], rng: np.random.Generator) -> None:
        outlines = [building.footprint for building in built]
        bounds = shapely.total_bounds(outlines)
        self.x_min, self.y_min = np.floor(bounds[:2]) - 20
        columns, rows = (np.ceil((bounds[2:] + 20 - (self.x_min, self.y_min)) / CELL_M)).astype(int)
        x, y = np.meshgrid(self.x_min + CELL_M * np.arange(columns), self.y_min + CELL_M * np.arange(rows))
        self.z = ground_z_m(x, y)
        self.kind = np.full(self.z.shape, GROUND, np.uint8)
        for building in built:
            corner = shapely.get_coordinates(building.footprint)
            floor = float(np.median(ground_z_m(corner[:, 0], corner[:, 1])))
            for wing in building.wings:
                self._raise(wing.outline, lambda xy, w=wing, f=floor: f + w.eave_m + w.rise_m(xy))
            for outline, top_m in _details(building, rng):
                self._raise(outline, lambda xy, t=floor + top_m: np.full(len(xy), t))
        coarse = max(1, round(0.5 / CELL_M))
        near = shapely.union_all([outline.buffer(AROUND_M) for outline in outlines])
        shapely.prepare(near)
        self.coarse = coarse
        self.mask = shapely.contains_xy(near, x[::coarse, ::coarse], y[::coarse, ::coarse])

    def _raise(self, outline: np.ndarray, height) -> None:
        """Lift the surface to ``height`` inside a convex outline."""
        low = np.floor((outline.min(axis=0) - (self.x_min, self.y_min)) / CELL_M).astype(int)
        high = np.ceil((outline.max(axis=0) - (self.x_min, self.y_min)) / CELL_M).astype(int) + 1
        window = (slice(low[1], high[1]), slice(low[0], high[0]))
        x, y = np.meshgrid(
            self.x_min + CELL_M * np.arange(low[0], high[0]), self.y_min + CELL_M * np.arange(low[1], high[1])
        )
        inside = shapely.contains_xy(shapely.Polygon(outline), x, y)
        top = height(np.column_stack([x[inside], y[inside]]))
        z, kind = self.z[window], self.kind[window]
        z[inside] = np.where(kind[inside] == BUILDING, np.maximum(z[inside], top), top)
        kind[inside] = BUILDING

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


def _details(building: Building, rng: np.random.Generator) -> list[tuple[np.ndarray, float]]:
    """Dormers and chimneys: (outline, top above the ground)."""
    main = building.wings[0]
    if building.kind not in ("house", "row", "block") or len(main.slopes) < 2:
        return []
    start, along, inward, length = _edge(main.outline, main.slopes[0])
    depth = _edge(main.outline, main.slopes[0] + 1)[3]
    tangent = np.tan(np.radians(main.pitch_deg))
    found = []
    if rng.random() < 0.6:
        u = rng.uniform(0.15, 0.75) * length
        outline = _frame(start, along, inward, _box(u, 0.55 * depth, u + 0.7, 0.55 * depth + 0.6))
        found.append((outline, main.eave_m + depth / 2 * tangent + rng.uniform(0.5, 1)))
    if depth / 2 * tangent > 2.4 and rng.random() < 0.45:
        number = int(rng.integers(1, 3))
        for u in (np.arange(number) + 0.5) * length / number - 0.8:
            outline = _frame(start, along, inward, _box(u, 0.7, u + 1.6, 0.7 + 1.6 / tangent))
            found.append((outline, main.eave_m + rng.uniform(1.8, 2.1)))
    return found


def _trees(built: list[Building], rng: np.random.Generator) -> np.ndarray:
    """Crowns beside buildings: x, y, z of the centre, radius, half height. Float array (n, 5)."""
    houses = shapely.union_all([building.footprint for building in built])
    found = []
    for building in built:
        if rng.random() > 0.4:
            continue
        centre, reach = (
            shapely.get_coordinates(building.footprint.centroid)[0],
            np.sqrt(building.footprint.area),
        )
        angle, radius = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 3)
        x, y = centre + (0.6 * reach + radius) * np.array([np.cos(angle), np.sin(angle)])
        here = shapely.Point(x, y)
        if houses.distance(here) < 0.6 * radius or not _in_lidar_tile(here):
            continue
        half = radius * rng.uniform(0.9, 1.5)
        found.append((x, y, float(ground_z_m(x, y)) + 1.6 + half, radius, half))
    return np.array(found).reshape(-1, 5)


def _scan(
    surface: _Surface, trees: np.ndarray, strip: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """One strip: pulses of a mirror that swings to and fro, each followed down to the first surface."""
    heading = np.radians(90 - HEADINGS_DEG[strip])
    forward, right = (
        np.array([np.cos(heading), np.sin(heading)]),
        np.array([np.sin(heading), -np.cos(heading)]),
    )
    rows, columns = surface.z.shape
    size = CELL_M * np.array([columns, rows])
    middle = np.array([surface.x_min, surface.y_min]) + size / 2 + (-1) ** strip * 35 * right
    half_length = np.hypot(*size) / 2 + 30
    time = np.arange(0, 2 * half_length / SPEED_M_S, 1 / PULSES_PER_S)
    angle = np.radians(SWING_DEG) * np.sin(2 * np.pi * SWINGS_PER_S / 2 * time)
    plane_z = float(ground_z_m(*middle)) + FLIGHT_M
    plane_xy = middle + (SPEED_M_S * time - half_length)[:, None] * forward
    sideways = np.tan(angle)[:, None] * right  # horizontal metres per metre of descent
    keep = surface.near(*(plane_xy + FLIGHT_M * sideways).T)
    time, angle, plane_xy, sideways = time[keep], angle[keep], plane_xy[keep], sideways[keep]

    descent, kind = _first_hit(surface, plane_xy, plane_z, sideways)
    in_crown = _crown_hit(trees, plane_xy, plane_z, sideways, descent, rng)
    hit_crown = np.isfinite(in_crown)
    through = hit_crown & (rng.random(len(time)) < 0.35)  # a second return below the crown
    single = np.where(hit_crown, in_crown, descent)
    pulse = np.concatenate([np.arange(len(time)), np.flatnonzero(through)])
    depth = np.concatenate([single, descent[through]])
    classes = np.concatenate([np.where(hit_crown, TREE, kind), kind[through]])
    returns = np.concatenate([np.ones(len(time), np.uint8), np.full(through.sum(), 2, np.uint8)])
    order = np.lexsort([returns, pulse])
    pulse, depth, classes, returns = pulse[order], depth[order], classes[order], returns[order]
    xy = plane_xy[pulse] + depth[:, None] * sideways[pulse] + rng.normal(0, 0.03, (len(pulse), 2))
    return {
        "x": xy[:, 0],
        "y": xy[:, 1],
        "z": plane_z - depth + rng.normal(0, 0.02, len(pulse)),
        "classification": classes.astype(np.uint8),
        "intensity": np.choose(np.searchsorted([1, 2, 5, 6], classes), [700, 1100, 500, 900]).astype(
            np.uint16
        ),
        "return_number": returns,
        "number_of_returns": np.where(through, 2, 1)[pulse].astype(np.uint8),
        "scan_angle": np.rint(np.degrees(angle[pulse]) / 0.006).astype(np.int16),
        "gps_time": 400_000_000.0 + 600 * strip + time[pulse],
        "point_source_id": np.full(len(pulse), strip + 1, np.uint16),
    }


def _first_hit(
    surface: _Surface, plane_xy: np.ndarray, plane_z: float, sideways: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Descent (metres below the aircraft) and class where each pulse meets the surface."""
    step = 0.2
    upper = np.full(len(plane_xy), plane_z - surface.z.max() - step)
    flying = np.ones(len(plane_xy), bool)
    while flying.any():
        at = upper[flying] + step
        z, _ = surface.at(*(plane_xy[flying] + at[:, None] * sideways[flying]).T)
        above = plane_z - at > z
        upper[np.flatnonzero(flying)[above]] = at[above]
        flying[np.flatnonzero(flying)[~above]] = False
    lower = upper + step
    for _ in range(6):
        middle = (upper + lower) / 2
        z, _ = surface.at(*(plane_xy + middle[:, None] * sideways).T)
        above = plane_z - middle > z
        upper, lower = np.where(above, middle, upper), np.where(above, lower, middle)
    z, kind = surface.at(*(plane_xy + lower[:, None] * sideways).T)
    on_wall = (kind == BUILDING) & (z - (plane_z - lower) > 0.6)
    return lower, np.where(on_wall, UNCLASSIFIED, kind)


def _crown_hit(
    trees: np.ndarray,
    plane_xy: np.ndarray,
    plane_z: float,
    sideways: np.ndarray,
    descent: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Descent at which leaves stop a pulse; NaN where none does before ``descent``."""
    result = np.full(len(plane_xy), np.nan)
    chance, inside = rng.random(len(plane_xy)), rng.random(len(plane_xy))
    for x, y, z, radius, half in trees:
        start = plane_xy - (x, y)
        candidates = np.flatnonzero(np.hypot(*(start + (plane_z - z) * sideways).T) < radius + half)
        s, d = start[candidates] / radius, sideways[candidates] / radius
        a = (d**2).sum(axis=1) + 1 / half**2
        b = (s * d).sum(axis=1) - (plane_z - z) / half**2
        c = (s**2).sum(axis=1) + ((plane_z - z) / half) ** 2 - 1
        root = b**2 - a * c
        met = (root > 0) & (chance[candidates] < 0.75)
        first, width = (-b - np.sqrt(np.maximum(root, 0))) / a, 2 * np.sqrt(np.maximum(root, 0)) / a
        leaf = first + width * inside[candidates] ** 2 * 0.6
        met &= leaf < descent[candidates]
        result[candidates[met]] = leaf[met]
    return result


def main(folder: Path, seed: int) -> None:
    rng = np.random.Generator(np.random.PCG64(seed))
    town = draw_town(rng)
    write_terrain(folder / "rgealti")
    write_footprints(town, folder / "bdtopo" / "BDTOPO_mini.gpkg", rng)
    if seed == SEED:
        write_lidar(town, folder / "lidar" / "LHD_FXX_0653_6861_PTS_LAMB93_IGN69.laz", rng)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parent)
    parser.add_argument("--seed", type=int, default=SEED, help="of another town, for a FOLDER of its own")
    options = parser.parse_args()
    main(options.folder, options.seed)
