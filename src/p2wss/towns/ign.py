"""A town as IGN would deliver it: BD TOPO footprints with their gaps, RGE ALTI terrain as ASC tiles."""

from collections.abc import Callable
from datetime import date
from io import BytesIO
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyogrio
import shapely
import shapely.affinity

from p2wss.storage import files
from p2wss.towns.buildings import DrawnBuilding
from p2wss.towns.site import CRS, X_MAX, X_MIN, Y_MAX, Y_MIN, ground_z_m, in_lidar_tile

DATE = date(2026, 1, 15)  # in every header, so that a second run writes the same bytes
USAGE = {
    "house": "Résidentiel",
    "row": "Résidentiel",
    "block": "Résidentiel",
    "hall": "Industriel",
    "annex": "Annexe",
}

# probabilities: a height is null; a height is 0; a building without a height states the heights of its roof; a building
# with storeys states their number; its vertices have no Z; an annex is of light construction
_WITHOUT_HEIGHT, _ZERO_HEIGHT, _ROOF_WITHOUT_HEIGHT = 0.08, 0.01, 0.4
_WITH_FLOORS, _WITHOUT_Z, _LIGHT = 0.7, 0.04, 0.5


def write_footprints(town: list[DrawnBuilding], path: Path, rng: np.random.Generator) -> None:
    """Write a GeoPackage: layer ``batiment`` with the columns of BD TOPO, and with its gaps and defects.

    Heights are null or 0 here and there, some vertices are at Z = -1000, repeated or near-collinear, and a few
    records have two parts.
    """
    rows, shapes = [], []
    tree = shapely.STRtree([building.footprint for building in town])
    for index, building in enumerate(town):
        row, roof_m = _row(index, building, rng)
        top = -1000.0 if rng.random() < _WITHOUT_Z else roof_m
        parts = [_with_blemishes(building.footprint, rng)]
        twin = shapely.affinity.translate(building.footprint, 9.0, 4.0)
        if building.kind == "annex" and not len(tree.query(twin, "intersects")) and not in_lidar_tile(twin):
            parts.append(twin)  # a few records have two parts
        shapes.append(shapely.force_3d(shapely.MultiPolygon(parts), top))
        row["construction_legere"] = building.kind == "annex" and rng.random() < _LIGHT
        rows.append(row)
    frame = gpd.GeoDataFrame(rows, geometry=shapes, crs=CRS)
    text = [name for name in frame.columns if frame[name].isna().all()]
    frame[text] = frame[text].astype("string")
    frame[["nombre_de_logements", "nombre_d_etages"]] = frame[
        ["nombre_de_logements", "nombre_d_etages"]
    ].astype("Int32")
    file = BytesIO()
    with files.gdal_options(OGR_CURRENT_DATE=f"{DATE.isoformat()}T00:00:00.000Z"):
        pyogrio.write_dataframe(
            frame,
            file,
            layer="batiment",
            driver="GPKG",
            geometry_type="MultiPolygon Z",
            GEOMETRY_NAME="geometrie",
        )
    files.write_bytes(path, file.getvalue())


def building_id(index: int) -> str:
    """The identifier of a building in BD TOPO, ``cleabs``. index: of the building in its town."""
    return f"BATIMENT{2_000_000_000 + 17 * index:016d}"


def _row(index: int, building: DrawnBuilding, rng: np.random.Generator) -> tuple[dict[str, Any], float]:
    """The columns of a building, and the height of its eaves above sea level. index: of the building in its town."""
    corner = shapely.get_coordinates(building.footprint)
    around = building.ground(corner[:, 0], corner[:, 1])
    low, high = round(float(around.min()), 1), round(float(around.max()), 1)
    eave = round(building.eave_m, 1)
    ridge = max(wing.ridge_m for wing in building.wings)
    gap = rng.random()
    height = None if gap < _WITHOUT_HEIGHT else 0.0 if gap < _WITHOUT_HEIGHT + _ZERO_HEIGHT else eave
    roof_known = (height is not None and height > 0) or rng.random() < _ROOF_WITHOUT_HEIGHT
    floors_known = building.kind in ("house", "row", "block") and rng.random() < _WITH_FLOORS
    flats = {"house": 1, "row": 1, "block": int(rng.integers(4, 12))}.get(building.kind)
    row = {
        "cleabs": building_id(index),
        "nature": "Industriel, agricole ou commercial" if building.kind == "hall" else "Indifférenciée",
        "usage_1": USAGE.get(building.kind, "Indifférencié"),
        "usage_2": None,
        "construction_legere": False,
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
    return row, low + eave


def _with_blemishes(outline: shapely.Polygon, rng: np.random.Generator) -> shapely.Polygon:
    """The outline; for some buildings with an additional vertex in the middle of an edge, or with a repeated vertex."""
    chance = rng.random()
    if chance > 0.12:
        return outline
    ring = list(map(tuple, shapely.get_coordinates(outline.exterior)[:-1]))
    at = int(rng.integers(len(ring)))
    a, b = np.array(ring[at]), np.array(ring[(at + 1) % len(ring)])
    ring.insert(at + 1, ring[at] if chance < 0.03 else tuple(np.round((a + b) / 2, 1)))
    return shapely.Polygon(ring, [hole.coords for hole in outline.interiors])


def write_terrain(folder: Path, ground: Callable[[np.ndarray, np.ndarray], np.ndarray] = ground_z_m) -> None:
    """Write one ASC tile per kilometre: cells of 5 m centred on multiples of 5 m, north row first."""
    cell, size = 5, 200
    for x_min in range(X_MIN, X_MAX, 1000):
        for y_max in range(Y_MIN + 1000, Y_MAX + 1, 1000):
            x, y = np.meshgrid(x_min + cell * np.arange(size), y_max - cell * np.arange(size))
            rows = [" ".join(f"{z:.2f}" for z in row) for row in ground(x, y)]
            header = (
                f"ncols        {size}\nnrows        {size}\n"
                f"xllcorner    {x_min - cell / 2:.12f}\n"
                f"yllcorner    {y_max - cell * size + cell / 2:.12f}\n"
                f"cellsize     {cell:.12f}\nNODATA_value  -99999.00\n"
            )
            name = f"RGEALTI_FXX_{x_min // 1000:04d}_{y_max // 1000:04d}_MNT_LAMB93_IGN69.asc"
            files.write_text(folder / name, header + "\n".join(rows) + "\n")
