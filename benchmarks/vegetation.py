"""Trees found in the simulated surveys of the miniature, against the drawn trees; the last line is JSON.

    python benchmarks/vegetation.py [--without-classes]

Needs no data but the files of ``tests/mini``.

Makes scenes, buildings and surveys by the stages of the workflow with the defaults, and looks for plants by
:func:`p2wss.reconstruction.outputs.vegetation.plants`. The rules were chosen on the first tile, and looked at on the
others. A tree is found if the middle of a crown of its own is within its radius; other crowns are false. The height of
a tree is that of its highest leaf above the terrain, the height of a crown that of its highest point above the ground
of the points. Trees below 4 m or in the margin are not counted, but may have a crown. ``--without-classes``: only
points of ground and buildings keep their class.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from pathlib import Path

import numpy as np
from figures import Figures
from scipy.spatial import cKDTree

from p2wss.cli import main as command
from p2wss.clouds.reading import Cloud
from p2wss.config import Scans
from p2wss.data import polygon_arrays
from p2wss.data.las_classes import UNCLASSIFIED_CLASS, VEGETATION_CLASS
from p2wss.data.terrain import Terrain, read_terrain
from p2wss.data.tiling import grown, tile_bounds
from p2wss.reconstruction.outputs.vegetation import Plant, plants
from p2wss.reconstruction.points.cloud_index import CloudIndex
from p2wss.scans import scan as scans
from p2wss.scans.clutter import beside_walls
from p2wss.scans.scan import build_surface, local_buildings
from p2wss.scans.surface import las_classes
from p2wss.storage import files
from p2wss.storage.schemas.buildings import BUILDINGS

TALL_M = 4.0
TILES = ("0652_6862", "0653_6862", "0652_6861")


def drawn(table, terrain: Terrain, origin_m: np.ndarray, settings: Scans) -> np.ndarray:
    """(trees, 5): x and y of the middle, z of the highest leaf, height above the terrain, radius."""
    surface = build_surface(table, terrain, origin_m, settings)
    buildings = local_buildings(table, origin_m, settings.seed)
    leaves = beside_walls.trees(surface.terrain, buildings, settings.clutter.trees_per_building)
    rows = []
    for number in np.unique(leaves.number):
        corner_m = leaves.vertex_m[leaves.number == number].reshape(-1, 3) + origin_m
        low, high = corner_m.min(axis=0), corner_m.max(axis=0)
        x, y = (low[:2] + high[:2]) / 2
        ground_m = terrain.interpolated(np.array([x]), np.array([y]))[0]
        rows.append([x, y, high[2], high[2] - ground_m, (high - low)[:2].mean() / 2])
    return np.array(rows)


def matched(crown_xy: np.ndarray, tree: np.ndarray) -> dict[int, int]:
    """The crown of each tree that has one, as indices; the nearest pairs are matched first."""
    distance_m, number = cKDTree(tree[:, :2]).query(crown_xy, k=min(8, len(tree)), distance_upper_bound=10)
    pairs = sorted(
        (d, crown, t)
        for crown, row in enumerate(zip(distance_m, number, strict=True))
        for d, t in zip(*row, strict=True)
        if np.isfinite(d) and d <= tree[t, 4]
    )
    result: dict[int, int] = {}
    taken: set[int] = set()
    for _, crown, t in pairs:
        if crown not in taken and t not in result:
            result[int(t)] = crown
            taken.add(crown)
    return result


def survey(tile: str, folder: Path) -> tuple[Cloud, np.ndarray, np.ndarray]:
    """(the points, the footprints, the drawn trees) of a tile of the miniature."""
    paths = {name: str(folder / name) for name in ("f.gpkg", "d.tif", "s.parquet", "t.tif", "b.parquet")}
    for words in (
        ["fetch", "footprints", "--out", paths["f.gpkg"]],
        ["fetch", "dtm", "--tile", tile, "--out", paths["d.tif"]],
        ["scenes", "cut", "--tile", tile, "--footprints", paths["f.gpkg"], "--dtm", paths["d.tif"],
         "--out", paths["s.parquet"], "--out-dtm", paths["t.tif"]],
        ["buildings", "--scene", paths["s.parquet"], "--out", paths["b.parquet"]],
    ):  # fmt: skip
        if command(words):
            sys.exit(2)
    table, (terrain, _) = files.read_table(folder / "b.parquet", BUILDINGS), read_terrain(folder / "t.tif")
    settings = Scans()
    scan = scans.simulate(table, terrain, tile, 1000.0, settings, threads=2)
    x_m, y_m, z_m = (scan.points.xyz_mm / 1000 + scan.origin_m).T
    footprints = polygon_arrays.to_geometries(polygon_arrays.in_crs(table))
    return (
        Cloud(x_m, y_m, z_m, las_classes(scan.points.face), None),
        footprints,
        drawn(table, terrain, scan.origin_m, settings),
    )


def measured(tile: str, has_classes: bool) -> dict[str, np.ndarray]:
    """For trees above 4 m: whether each is found, and errors of height and width of the found ones. For crowns: whether
    each belongs to a tree, and whether it is closed. Points per square metre."""
    bounds = tile_bounds(tile, 1000)
    with tempfile.TemporaryDirectory() as folder:
        cloud, footprints, tree = survey(tile, Path(folder))
        if not has_classes:
            cloud.classification[cloud.classification == VEGETATION_CLASS] = UNCLASSIFIED_CLASS
        with CloudIndex(np.array([grown(bounds, 20)]), Path(folder)) as index:
            index.append(cloud)
            found: list[Plant] = plants(index, grown(bounds, 5), footprints)
    crown_xy = np.array([plant.mesh.vertex_m[plant.mesh.vertex_m[:, 2].argmax(), :2] for plant in found])
    crown_of = matched(crown_xy, tree)

    def in_tile(xy: np.ndarray) -> np.ndarray:
        return np.all((xy >= bounds[:2]) & (xy < bounds[2:]), axis=1)

    tall = np.flatnonzero(in_tile(tree[:, :2]) & (tree[:, 3] > TALL_M))
    own = [t for t in tall.tolist() if t in crown_of]
    return {
        "is_found": np.isin(tall, own),
        "height_m": np.array([found[crown_of[t]].height_m - tree[t, 3] for t in own]),
        "width_m": np.array([found[crown_of[t]].width_m - 2 * tree[t, 4] for t in own]),
        "is_true": np.isin(np.flatnonzero(in_tile(crown_xy)), list(crown_of.values())),
        "is_closed": np.array([plant.mesh.is_closed and plant.mesh.volume_m3 > 0 for plant in found]),
        "per_m2": np.array([len(cloud) / 1e6]),
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--without-classes", action="store_true")
    arguments = parser.parse_args()
    logging.disable(logging.INFO)
    results = {tile: measured(tile, not arguments.without_classes) for tile in TILES}
    columns = "tile        points/m2  trees  found  crowns  false  height: mean |error|  within 0.5 m  median  width"
    print(columns)
    for tile, of in results.items():
        error_m = of["height_m"]
        print(
            f"{tile}  {of['per_m2'][0]:11.1f}  {len(of['is_found']):5}  {of['is_found'].mean():5.1%}"
            f"  {len(of['is_true']):6}  {1 - of['is_true'].mean():5.1%}  {np.abs(error_m).mean():19.2f} m"
            f"  {np.mean(np.abs(error_m) <= 0.5):12.0%}  {np.median(error_m):+.2f}m  {np.median(of['width_m']):+.2f}m"
        )
    whole = {name: np.concatenate([of[name] for of in results.values()]) for name in results[TILES[0]]}
    figures = Figures()
    figures.at_least("trees above 4 m found", whole["is_found"].mean(), 0.9)
    figures.at_most("false crowns", 1 - whole["is_true"].mean(), 0.1)
    figures.at_most("mean absolute error of heights, m", np.abs(whole["height_m"]).mean(), 0.5)
    figures.at_least("closed volumes", whole["is_closed"].mean(), 1)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
