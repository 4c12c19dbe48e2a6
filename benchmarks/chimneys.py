"""Chimneys at `reconstruct.detail: high` on simulated towns, whose chimneys are known; the last line is JSON.

    python benchmarks/chimneys.py [--seed 652]                  # the miniature; may be repeated

Needs no data.

What is measured is the difference between two meshes of a building, with and without chimneys, on a raster of 10 cm:
each of its connected regions is a chimney that was built. It is right if its centre lies over a chimney that the town
has, and that chimney then counts as detected. The price in `p2wss.fit.settings` was chosen on the towns of
the seeds 1 and 2, and the figures of the miniature were seen when its rules were written; the other seeds are the test.
"""

from __future__ import annotations

import argparse
import copy
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from figures import Figures
from real import read_files
from scipy import ndimage

from p2wss.config import Config
from p2wss.data.building import Building, Reconstruction
from p2wss.fit import fitting
from p2wss.fit.settings import Chimneys, Thresholds
from p2wss.mesh.surface import topmost
from p2wss.towns import FOOTPRINTS, LIDAR, MINIATURE_SEED, draw_town, write_footprints, write_lidar
from p2wss.towns.site import in_lidar_tile
from p2wss.towns.surface import draw_details

CELL_M = 0.1
# the two meshes differ where they are this far apart
_HIGHER_M = 0.2
# returns from the top lie this near to it
_ON_TOP_M = 0.1
# a centre may lie this far beside a chimney
_BESIDE_M = 0.2
MIN_RETURNS = 4
BARS = {"recall": 0.9, "share of false ones": 0.05, "median offset of the centre, m": 0.15}


class Chimney(NamedTuple):
    """A chimney that a town has. outline: in the CRS. num_returns: on its top."""

    outline: shapely.Polygon
    num_returns: int


class Region(NamedTuple):
    """Where a mesh has become higher. centre_m: (2,), in the CRS."""

    centre_m: np.ndarray
    area_m2: float


def town(seed: int, folder: Path) -> tuple[list[Building], list[Chimney]]:
    """The buildings of a town within its LiDAR, and all of its chimneys there."""
    rng = np.random.Generator(np.random.PCG64(seed))
    drawn = draw_town(rng)
    write_footprints(drawn, folder / FOOTPRINTS, rng)
    of_details = copy.deepcopy(rng)
    write_lidar(drawn, folder / LIDAR, rng)
    buildings = read_files(folder / FOOTPRINTS, [folder / LIDAR], "town", Config())
    xyz = np.concatenate([each.point_m + each.position_m for each in buildings])
    chimneys = []
    for building in drawn:
        if not in_lidar_tile(building.footprint):
            continue
        for detail in draw_details(building, of_details):
            if detail.detail == "chimney":
                outline = shapely.Polygon(detail.outline)
                z = np.unique(xyz[shapely.contains_xy(outline, *xyz[:, :2].T)], axis=0)[:, 2]
                chimneys.append(Chimney(outline, int((z > z.max(initial=-np.inf) - _ON_TOP_M).sum())))
    return buildings, chimneys


def higher_regions(before: Reconstruction, after: Reconstruction) -> list[Region]:
    """Where the second mesh of a building is higher than the first one."""
    if len(before.mesh.triangle) == len(after.mesh.triangle):
        return []
    low, high = after.mesh.vertex_m[:, :2].min(axis=0), after.mesh.vertex_m[:, :2].max(axis=0)
    x, y = np.meshgrid(*(np.arange(low[k] + CELL_M / 2, high[k], CELL_M) for k in range(2)))
    place = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    heights = [
        topmost(np.ascontiguousarray(each.mesh.vertex_m[each.mesh.triangle]), place)[1]
        for each in (before, after)
    ]
    with np.errstate(invalid="ignore"):
        label, count = ndimage.label((heights[1] - heights[0] > _HIGHER_M).reshape(x.shape), np.ones((3, 3)))
    regions = []
    for k in range(1, count + 1):
        cells = place[(label == k).ravel(), :2]
        regions.append(Region(cells.mean(axis=0) + after.origin_xy_m, len(cells) * CELL_M**2))
    return regions


def measured(seed: int) -> dict[str, Any]:
    """The row of a town."""
    with tempfile.TemporaryDirectory() as folder:
        buildings, chimneys = town(seed, Path(folder))
    config = Config().reconstruct.model_copy(update={"detail": "high"})
    none = Thresholds(chimneys=Chimneys(price_m=np.inf))
    before, after = fitting.fit(buildings, config, thresholds=none), fitting.fit(buildings, config)
    regions = [region for pair in zip(before, after, strict=True) for region in higher_regions(*pair)]
    detected, offset_m, area_ratio, num_false = set(), [], [], 0
    tree = shapely.STRtree([chimney.outline for chimney in chimneys])
    for region in regions:
        near = tree.query(shapely.Point(region.centre_m), "dwithin", _BESIDE_M)
        if len(near):
            outline = chimneys[near[0]].outline
            detected.add(int(near[0]))
            offset_m.append(
                float(np.hypot(*(shapely.get_coordinates(outline.centroid)[0] - region.centre_m)))
            )
            area_ratio.append(region.area_m2 / outline.area)
        else:
            num_false += 1
    shown = [k for k, chimney in enumerate(chimneys) if chimney.num_returns >= MIN_RETURNS]
    num_meshes = len([each for each in after if each.has_mesh])
    return {
        "buildings": len(buildings),
        "chimneys": len(chimneys),
        f"with {MIN_RETURNS} returns": len(shown),
        "built": len(regions),
        "recall": len(detected.intersection(shown)) / len(shown),
        "recall of all": len(detected) / len(chimneys),
        "share of false ones": num_false / max(len(regions), 1),
        "median offset of the centre, m": float(np.median(offset_m)),
        "median area over the true one": float(np.median(area_ratio)),
        "closed": sum(each.mesh.is_closed for each in after if each.has_mesh) / num_meshes,
        "triangles before": sum(len(each.mesh.triangle) for each in before) / num_meshes,
        "triangles": sum(len(each.mesh.triangle) for each in after) / num_meshes,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, action="append", help="of a town; default: that of the miniature")
    arguments = parser.parse_args()
    figures = Figures()
    for seed in arguments.seed or [MINIATURE_SEED]:
        row = measured(seed)
        figures.row(f"seed {seed}", row)
        print(f"seed {seed}: " + ", ".join(f"{key} {value:.3g}" for key, value in row.items()), flush=True)
        figures.at_least(f"seed {seed}, recall", row["recall"], BARS["recall"])
        for key in ("share of false ones", "median offset of the centre, m"):
            figures.at_most(f"seed {seed}, {key}", row[key], BARS[key])
        figures.at_least(f"seed {seed}, closed", row["closed"], 1.0)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
