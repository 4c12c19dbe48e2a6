"""A toy program in place of Roofer for tests: a box per footprint, from the ground to its highest point."""

import json
import sqlite3
import sys
from pathlib import Path

if "--version" in sys.argv:
    print("toy 1.0")
    sys.exit()

import laspy
import numpy as np
import shapely

cloud, footprints, out = map(Path, sys.argv[-3:])
id_field = sys.argv[sys.argv.index("--id-attribute") + 1]
las = laspy.read(cloud)
# a GeoPackage is a database; what reads it otherwise takes longer to import than all else here
database = sqlite3.connect(footprints)
((layer, column),) = database.execute("select table_name, column_name from gpkg_geometry_columns")
rows = database.execute(f'select "{column}", "{id_field}" from "{layer}"')
# before each geometry is a header, as long as its bounds
BOUNDS_BYTES = [0, 32, 48, 48, 64]
buildings = [(shapely.from_wkb(blob[8 + BOUNDS_BYTES[blob[3] >> 1 & 7] :]), name) for blob, name in rows]
ground = float(np.asarray(las.z)[np.asarray(las.classification) == 2].min())
lines = [
    {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.001] * 3, "translate": [652000, 6861000, 0]},
        "CityObjects": {},
        "vertices": [],
    }
]
SHELL = [[[0, 3, 2, 1]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]
for number, (shape, name_of_building) in enumerate(buildings):
    near = shapely.dwithin(shapely.points(las.x, las.y), shape, 1.0)
    x0, y0, x1, y1 = shape.bounds
    top = float(np.asarray(las.z)[near].max())
    corners = [[x, y, z] for z in (ground, top) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    part = {
        "type": "Solid",
        "lod": "2.2",
        "boundaries": [SHELL],
        "semantics": {
            "surfaces": [{"type": "GroundSurface"}, {"type": "RoofSurface"}, {"type": "WallSurface"}],
            "values": [[0, 1, 2, 2, 2, 2]],
        },
    }
    name = f"NL.{number}"
    objects = {
        name: {"type": "Building", "attributes": {id_field: name_of_building}, "children": [f"{name}-0"]},
        f"{name}-0": {"type": "BuildingPart", "parents": [name], "geometry": [part]},
    }
    vertices = np.round((np.array(corners) - [652000, 6861000, 0]) * 1000).astype(int).tolist()
    lines.append({"type": "CityJSONFeature", "id": name, "CityObjects": objects, "vertices": vertices})
out.mkdir(parents=True, exist_ok=True)
(out / "tile.city.jsonl").write_text("\n".join(map(json.dumps, lines)))
