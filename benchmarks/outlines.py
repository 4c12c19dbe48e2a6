"""Outlines from points alone against a map and their bars; the last line is JSON.

    python benchmarks/outlines.py --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py
    .. --picture outlines.png     # the outlines of Delft over the map (needs matplotlib)
    .. --forests forest.laz ..    # how many outlines clouds without buildings give, whatever their classes but ground

Delft west: 74 houses of the map, whose roofs are in a cloud of 15 points/m2. Settings were chosen on the western half
(houses whose centre lies west of the median), so the eastern half is the test, as are the other two places. The map
lacks some buildings of the cloud, which may touch its houses. So the surroundings of building points more than 1.5 m
outside the map are not judged, nor is anything more than 2 m from a house. A house above 30 m2 is found if at least
half of it is within outlines. IoU and vertices compare a block, houses of the map that touch, with the union of the
outlines around it, for blocks above 30 m2. Houses without points of any class are left out. "IoU with unmapped" also
counts what the map lacks, within these 2 m. Points to mesh: of the outlines above 30 m2 that are at least half on
houses of the map; the other outlines, many of them cut by the edge of the cloud, are in the row "p2m".
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyproj
import shapely
from figures import Figures, cpu_seconds
from real_places import Place, judged_rows, places

from p2wss.clouds import reading as clouds
from p2wss.clouds.reading import Cloud
from p2wss.config import Config
from p2wss.data.las_classes import BUILDING_CLASS, UNCLASSIFIED_CLASS, VEGETATION_CLASS
from p2wss.footprints.cleaning import clean_footprints
from p2wss.reconstruction.area import footprint_settings
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.points import unclassified
from p2wss.reconstruction.result import Result
from p2wss.reconstruction.tracing.outlines import crowns, in_tiles, outline_features, outlines_and_crowns
from p2wss.storage.features import Features

MIN_AREA_M2 = 30.0
# houses at most this far apart touch
TOUCH_M = 0.1
# vertices nearer than this to the line between their neighbours do not count, in the map and in outlines
STRAIGHT_M = 0.05
# outlines are judged this far around a block
AROUND_M = 2.0
# building points at least this far from the map belong to buildings that the map lacks
UNMAPPED_M = 1.5
BARS = {"found": 0.95, "iou": 0.88, "vertices": 1.3, "p2m": 0.18}


def joined(shapes: np.ndarray) -> np.ndarray:
    """The unions of polygons that touch."""
    closed = shapely.union_all(shapely.buffer(shapes, TOUCH_M / 2, join_style="mitre"))
    return shapely.get_parts(shapely.buffer(closed, -TOUCH_M / 2, join_style="mitre"))


def vertices(shape: shapely.Geometry) -> np.ndarray:
    """Vertices where the outline turns, (n, 2)."""
    rings = shapely.get_rings(shapely.get_parts(shapely.simplify(shape, STRAIGHT_M)))
    return np.vstack([shapely.get_coordinates(ring)[1:] for ring in rings])


def unmapped(houses: np.ndarray, cloud: Cloud) -> shapely.Geometry:
    """The areas of buildings in the cloud that the map lacks, with their surroundings."""
    is_roof = cloud.classification == BUILDING_CLASS
    xy_m = np.column_stack([cloud.x_m[is_roof], cloud.y_m[is_roof]])
    everything = shapely.union_all(houses)
    shapely.prepare(everything)
    point = np.asarray(shapely.points(xy_m))
    beyond = point[~shapely.dwithin(everything, point, UNMAPPED_M)]
    # areas at least 1 m wide with points less than 1 m apart
    area = shapely.union_all(shapely.buffer(beyond, 0.6, quad_segs=2)).buffer(-0.6).buffer(-0.4).buffer(0.4)
    return area.buffer(UNMAPPED_M + 0.2).difference(everything)


def compared(houses: np.ndarray, outlines: np.ndarray, ignored: shapely.Geometry) -> list[dict[str, Any]]:
    """One row per house above 30 m2 and one per block above 30 m2, with the x of its centre."""
    blocks = joined(houses)
    rows: list[dict[str, Any]] = []
    everything = shapely.union_all(outlines)
    for house in houses[shapely.area(houses) > MIN_AREA_M2]:
        share = house.intersection(everything).area / house.area
        rows.append({"kind": "house", "x": house.centroid.x, "found": share >= 0.5})
    for index, block in enumerate(blocks):
        if block.area > MIN_AREA_M2:
            others = shapely.union_all(np.delete(blocks, index))
            window = block.buffer(AROUND_M, join_style="mitre")
            whole = everything.intersection(window).difference(others)
            shape = whole.difference(ignored)
            vertex = shapely.points(vertices(everything))
            counts = (shapely.distance(vertex, block) <= AROUND_M) & ~shapely.dwithin(vertex, ignored, 0.01)
            rows.append(
                {
                    "kind": "block",
                    "x": block.centroid.x,
                    "area": round(block.area, 1),
                    "iou": shape.intersection(block).area / shape.union(block).area,
                    "iou of whole outlines": _of_whole_outlines(block, outlines),
                    "iou with unmapped": whole.intersection(block).area / whole.union(block).area,
                    "map vertices": len(vertices(block)),
                    "vertices": int(counts.sum()),
                }
            )
    return rows


def _of_whole_outlines(block: shapely.Geometry, outlines: np.ndarray) -> float:
    """IoU of a block and the union of the outlines that lie on it by at least half, including their parts far from the
    block."""
    share = shapely.area(shapely.intersection(outlines, block)) / shapely.area(outlines)
    union = shapely.union_all(outlines[share >= 0.5])
    return float(union.intersection(block).area / union.union(block).area)


def measures(rows: list[dict[str, Any]]) -> dict[str, float]:
    """found, iou, vertices and so on of these rows."""
    blocks = [row for row in rows if row["kind"] == "block"]
    houses = [row for row in rows if row["kind"] == "house"]
    return {
        "houses": len(houses),
        "blocks": len(blocks),
        "found": float(np.mean([row["found"] for row in houses])),
        "iou": float(np.mean([row["iou"] for row in blocks])),
        "iou of whole outlines": float(np.mean([row["iou of whole outlines"] for row in blocks])),
        "iou with unmapped": float(np.mean([row["iou with unmapped"] for row in blocks])),
        "vertices": sum(row["vertices"] for row in blocks) / sum(row["map vertices"] for row in blocks),
    }


def judged(features: Features, cloud: Cloud, place: Place, judge: Path, houses: np.ndarray) -> dict[str, Any]:
    """Solids on the outlines: their number, how many are closed, points to mesh by the judge."""
    config = Config()
    cleaned = clean_footprints(features, footprint_settings(config))
    results = run(cleaned, cloud, None, "tile", config.reconstruct)
    with tempfile.TemporaryDirectory() as folder:
        outlines = Path(folder) / "outlines.gpkg"
        features.to_frame().to_file(outlines)
        rows = judged_rows(judge, results, place, outlines)
    shapes = dict(zip(features["building_id"], features.geometry, strict=True))
    everything = shapely.union_all(houses)
    on_map = [
        row["p2m"]
        for row in rows
        if "p2m" in row
        and shapes[row["id"]].area > MIN_AREA_M2
        and shapes[row["id"]].intersection(everything).area >= 0.5 * shapes[row["id"]].area
    ]
    closed = [result for result in results if result.reconstruction.has_mesh and is_closed(result)]
    return {
        "outlines": len(features),
        "closed": len(closed) / len(results),
        "flat": sum(result.status == "flat" for result in results),
        "p2m": float(np.mean([row["p2m"] for row in rows if "p2m" in row])),
        "on map": len(on_map),
        "p2m on map": float(np.mean(on_map)),
        "roof": float(np.mean([row["roof"] for row in rows if "roof" in row])),
    }


def is_closed(result: Result) -> bool:
    """Whether each edge of the mesh is in two triangles, in opposite directions."""
    triangle = result.reconstruction.placed_mesh.triangle
    edges = np.concatenate([triangle[:, [0, 1]], triangle[:, [1, 2]], triangle[:, [2, 0]]])
    forward, count = np.unique(edges, axis=0, return_counts=True)
    backward = np.unique(edges[:, ::-1], axis=0)
    return bool(len(triangle)) and np.array_equal(forward, backward) and bool((count == 1).all())


def without_classes(cloud: Cloud) -> Cloud:
    """The cloud with building and vegetation points unclassified, then classified by ourselves."""
    classes = cloud.classification.copy()
    classes[np.isin(classes, (BUILDING_CLASS, VEGETATION_CLASS, 3, 4))] = UNCLASSIFIED_CLASS
    bare = Cloud(cloud.x_m, cloud.y_m, cloud.z_m, classes, cloud.crs, cloud.day)
    return unclassified.with_classes(bare)[0]


def picture(path: Path, houses: np.ndarray, outlines: np.ndarray, cloud: Cloud) -> None:
    """The outlines over the map and the points on roofs."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(16, 18))
    roof = cloud.classification == BUILDING_CLASS
    axes.scatter(cloud.x_m[roof], cloud.y_m[roof], s=0.4, color="0.75")
    gpd.GeoSeries(houses).boundary.plot(ax=axes, color="tab:red", linewidth=1.2)
    gpd.GeoSeries(outlines).boundary.plot(ax=axes, color="tab:blue", linewidth=1.6)
    axes.set_aspect("equal")
    figure.savefig(path, dpi=75, bbox_inches="tight")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--judge", type=Path, default=None, help="without it, outlines are not reconstructed")
    parser.add_argument("--places", nargs="+", default=["delft", "lidar hd", "bresse"])
    parser.add_argument("--picture", type=Path, default=None)
    parser.add_argument("--forests", type=Path, nargs="+", default=[], help="clouds without buildings")
    parser.add_argument("--rows", action="store_true", help="also print the rows of the blocks")
    arguments = parser.parse_args()
    figures = Figures()
    settings = Config().reconstruct.outlines
    for name in arguments.places:
        place = places(arguments.data)[name]
        houses = gpd.read_file(place.footprints).geometry.to_numpy()
        cloud, _ = unclassified.with_missed_buildings(clouds.read_clouds(place.clouds))
        shapely.prepare(houses)
        near = [shapely.contains_xy(house, cloud.x_m, cloud.y_m).any() for house in houses]
        houses = houses[np.array(near)]
        crs = pyproj.CRS.from_epsg(place.epsg)
        features = outline_features(outlines_and_crowns(cloud, settings)[0], crs)
        ignored = unmapped(houses, cloud)
        rows = compared(houses, features.geometry, ignored)
        if arguments.rows:
            for row in rows:
                print(row)
        totals = measures(rows)
        print(name, json.dumps(totals), flush=True)
        figures.row(name, totals)
        if name == "delft":
            middle = float(np.median([row["x"] for row in rows if row["kind"] == "house"]))
            for half, is_west in (("west (chosen on)", True), ("east (test)", False)):
                some = measures([row for row in rows if (row["x"] < middle) == is_west])
                print(f"{name}, {half}", json.dumps(some), flush=True)
                figures.row(f"{name}, {half}", some)
            figures.at_least("houses found", totals["found"], BARS["found"])
            figures.at_least("IoU with blocks of the map", totals["iou"], BARS["iou"])
            figures.at_most("vertices by those of the map", totals["vertices"], BARS["vertices"])
            seconds = cpu_seconds(partial(outlines_and_crowns, cloud, settings), 1)
            figures.row("cpu", {"ms per outline": 1000 * seconds / len(features)})
        bare, _ = outlines_and_crowns(without_classes(cloud), settings, is_classified=False)
        unclassified_totals = measures(compared(houses, bare, ignored))
        print(f"{name}, without classes", json.dumps(unclassified_totals), flush=True)
        figures.row(f"{name}, without classes", unclassified_totals)
        if arguments.picture is not None and name == arguments.places[0]:
            picture(arguments.picture, houses, features.geometry, cloud)
        if arguments.judge is not None:
            solids = judged(features, cloud, place, arguments.judge, houses)
            print(f"{name}, solids", json.dumps(solids), flush=True)
            figures.row(f"{name}, solids", solids)
            if name == "delft":
                figures.at_least("share of outlines with a closed solid", solids["closed"], 1.0)
                figures.at_most("points to mesh on the map [m]", solids["p2m on map"], BARS["p2m"])
    for path in arguments.forests:
        bare_cloud = without_classes(clouds.read_clouds([path]))
        found = in_tiles(bare_cloud, settings)
        is_crown = np.concatenate([crowns(part, shapes, raster) for part, raster, shapes in found])
        counts = {"outlines": int((~is_crown).sum()), "left out as crowns": int(is_crown.sum())}
        print(path.name, json.dumps(counts), flush=True)
        figures.row(path.name, counts)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
