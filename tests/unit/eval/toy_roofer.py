"""A toy program in place of Roofer for tests: a box per footprint, from the ground to its highest point."""

import json
import sys
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import shapely

if "--version" in sys.argv:
    print("toy 1.0")
    sys.exit()
cloud, footprints, out = map(Path, sys.argv[-3:])
id_field = sys.argv[sys.argv.index("--id-attribute") + 1]
las = laspy.read(cloud)
frame = gpd.read_file(footprints)
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
for number, row in frame.iterrows():
    near = shapely.dwithin(shapely.points(las.x, las.y), row.geometry, 1.0)
    x0, y0, x1, y1 = row.geometry.bounds
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
        name: {"type": "Building", "attributes": {id_field: row[id_field]}, "children": [f"{name}-0"]},
        f"{name}-0": {"type": "BuildingPart", "parents": [name], "geometry": [part]},
    }
    vertices = np.round((np.array(corners) - [652000, 6861000, 0]) * 1000).astype(int).tolist()
    lines.append({"type": "CityJSONFeature", "id": name, "CityObjects": objects, "vertices": vertices})
out.mkdir(parents=True, exist_ok=True)
(out / "tile.city.jsonl").write_text("\n".join(map(json.dumps, lines)))
