"""Small scenes for tests: gabled houses, in the columns of the pipeline's files, on terrain from a formula."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from p2wss.data.terrain import Terrain, write_terrain
from p2wss.data.tiling import tile_bounds
from p2wss.storage import files
from p2wss.storage.schemas.buildings import BUILDINGS
from p2wss.storage.schemas.scene import SCENE

TILE, TILE_SIZE_M, MARGIN_M = "0652500_6862000", 100.0, 40.0
GROUND, WALL, ROOF = 0, 1, 2


def ground_m(x, y):
    """A gentle slope with waves, metres above sea level."""
    return 80 + 0.03 * (x - 652_550) + 2 * np.sin(y / 25)


def terrain(tile=TILE, size_m=TILE_SIZE_M, margin_m=MARGIN_M, cell_m=1.0) -> Terrain:
    x_min, _, x_max, y_max = tile_bounds(tile, size_m, margin_m)
    count = round((x_max - x_min) / cell_m)
    steps = (np.arange(count) + 0.5) * cell_m
    height = ground_m((x_min + steps)[None, :], (y_max - steps)[:, None])
    return Terrain(height.astype(np.float32), x_min, y_max, cell_m)


def house(x0, y0, width, length, eave_m, angle_deg, name, tile=TILE, size_m=TILE_SIZE_M):
    """A row of ``BUILDINGS``: a rectangle whose ridge runs along y; edges 1 and 3 carry the roof."""
    corners = np.array([[0, 0], [width, 0], [width, length], [0, length]], float)
    around = ground_m(corners[:, 0] + x0, corners[:, 1] + y0)
    ground, base = float(np.median(around)), float(around.min()) - 0.2
    ridge = eave_m + np.tan(np.radians(angle_deg)) * width / 2
    vertex = [[*c, base - ground] for c in corners] + [[*c, eave_m] for c in corners]
    vertex += [[width / 2, 0, ridge], [width / 2, length, ridge]]
    faces = [
        (GROUND, -1, [(0, 3, 2), (0, 2, 1)]),
        (WALL, 0, [(0, 1, 5), (0, 5, 4), (4, 5, 8)]),
        (WALL, 1, [(1, 2, 6), (1, 6, 5)]),
        (WALL, 2, [(2, 3, 7), (2, 7, 6), (6, 7, 9)]),
        (WALL, 3, [(3, 0, 4), (3, 4, 7)]),
        (ROOF, 1, [(5, 6, 9), (5, 9, 8)]),
        (ROOF, 3, [(7, 4, 8), (7, 8, 9)]),
    ]
    x_min, y_min, x_max, y_max = tile_bounds(tile, size_m)
    middle = x0 + width / 2, y0 + length / 2
    return {
        "building_id": name,
        "tile": tile,
        "in_tile": bool(x_min <= middle[0] < x_max and y_min < middle[1] <= y_max),
        "status": "ok",
        "eave_height_m": eave_m,
        "terrain_z_m": ground,
        "base_z_m": base,
        "roof_type": "gable",
        "angle_deg": [90.0, angle_deg, 90.0, angle_deg],
        "origin_x_m": float(x0),
        "origin_y_m": float(y0),
        "footprint_xy_m": corners.ravel(),
        "ring_offset": [0, 4],
        "vertex_xyz_m": np.array(vertex).ravel(),
        "triangle": np.array([t for _, _, group in faces for t in group]).ravel(),
        "triangle_kind": [kind for kind, _, group in faces for _ in group],
        "triangle_edge": [edge for _, edge, group in faces for _ in group],
    }


def houses(tile=TILE, size_m=TILE_SIZE_M, spacing_m=20.0, seed=0):
    """Rows of ``BUILDINGS`` all over the tile and 30 m around it."""
    rng = np.random.default_rng(seed)
    x_min, y_min, x_max, y_max = tile_bounds(tile, size_m, 30.0)
    rows = []
    for x in np.arange(x_min, x_max - spacing_m + 1, spacing_m):
        for y in np.arange(y_min, y_max - spacing_m + 1, spacing_m):
            width, length = rng.uniform(7, 11), rng.uniform(8, 13)
            at = np.round([x + rng.uniform(0, 8), y + rng.uniform(0, 6)], 2)
            eave, angle = rng.uniform(3, 12), float(rng.integers(20, 46))
            rows.append(house(*at, width, length, eave, angle, f"BATIMENT{len(rows):04d}", tile, size_m))
    return rows


def write_scene(folder: Path, rows=None, dtm=None, tile=TILE, size_m=TILE_SIZE_M) -> tuple[Path, Path, Path]:
    """The files (scene, dtm, buildings); of the scene, the stage scans reads the metadata only."""
    rows = houses(tile, size_m) if rows is None else rows
    facts = files.provenance(tile=tile, tile_size_m=size_m, margin_m=MARGIN_M, crs="EPSG:2154")
    columns = {field.name: [row[field.name] for row in rows] for field in BUILDINGS}
    files.write_table(folder / "buildings.parquet", columns, BUILDINGS, facts)
    columns["eave_height_source"] = ["hauteur"] * len(rows)
    files.write_table(folder / "scene.parquet", {n: columns[n] for n in SCENE.names}, SCENE, facts)
    dtm = terrain(tile, size_m) if dtm is None else dtm
    write_terrain(folder / "dtm.tif", dtm, "EPSG:2154", facts)
    return folder / "scene.parquet", folder / "dtm.tif", folder / "buildings.parquet"


def table(rows):
    """The rows as the table that a stage takes."""
    import pyarrow as pa

    return pa.table(
        {f.name: pa.array([row[f.name] for row in rows], f.type) for f in BUILDINGS}, schema=BUILDINGS
    )


def scans_inputs(scene: Path, dtm: Path, buildings: Path) -> list[str]:
    """Options of ``p2wss scans`` for the files of :func:`write_scene`."""
    return ["--scene", str(scene), "--dtm", str(dtm), "--buildings", str(buildings)]
