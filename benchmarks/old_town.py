"""Roofs of an old town, drawn with what makes them hard to find, against the true ones; the last line is JSON.

    python benchmarks/old_town.py [--seed 101] [--save FOLDER]

Needs no data.

Draws the town (``benchmarks/towns.py``), reconstructs it by ``p2wss.reconstruct`` without the network, and
compares heights on a raster with the true heights. No setting was chosen on the default seed.

* A *false slab* is a part of a roof along a neighbour, less than a metre wide and at least a metre long, that is more
  than a metre above the true roof. A part of a wider roof face that is so only at its end is *too long*.
* A roof is *above its support* if, over a disc of a metre, it is half a metre above the true roof and above all points
  within a metre.
* A shaft is found where most of it, less half a metre at its sides, is lower than halfway down. A *false shaft* is a
  place, a metre wide and two metres below the true roof, where there is none.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely
from drawn_towns.files import ROOFS, write_town
from drawn_towns.lidar import LIDAR
from drawn_towns.old import TROUBLES, hillside_z_m
from figures import Figures
from scipy import ndimage
from scipy.spatial import cKDTree

import p2wss
from p2wss.clouds.reading import read_clouds
from p2wss.mesh.surface import topmost
from p2wss.towns import FOOTPRINTS

SEED = 101
CELL_M = 0.25
_ON_PLANE_M = 0.1


def _disc(radius_m: float) -> np.ndarray:
    reach = int(radius_m / CELL_M)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.hypot(x, y) * CELL_M <= radius_m + 1e-9


def _areas(mask: np.ndarray) -> list[np.ndarray]:
    label, count = ndimage.label(mask)
    return [label == number for number in range(1, count + 1)]


def _part(area: np.ndarray, height_m: np.ndarray, xy_m: np.ndarray) -> np.ndarray:
    """The cells around an area whose heights lie on the plane of the area's cells. xy_m: (n, 2), places of all
    cells."""
    place = np.column_stack([xy_m - xy_m[area.ravel()].mean(axis=0), np.ones(len(xy_m))])
    plane = np.linalg.lstsq(place[area.ravel()], height_m[area])[0]
    is_on_plane = np.abs(height_m - (place @ plane).reshape(area.shape)) < _ON_PLANE_M
    return ndimage.binary_propagation(area, mask=area | is_on_plane)


def _is_wide(mask: np.ndarray) -> bool:
    """Whether a disc of a metre fits into the mask."""
    return bool(ndimage.binary_erosion(mask, _disc(0.5)).any())


class Raster:
    """The heights of solids on the cells of a footprint, minus infinity outside."""

    def __init__(self, footprint: shapely.Polygon) -> None:
        low, high = np.array(footprint.buffer(1.0).bounds).reshape(2, 2)
        x, y = np.meshgrid(*(np.arange(a, b, CELL_M) for a, b in zip(low, high, strict=True)))
        self.shape, self.xy_m = x.shape, np.column_stack([x.ravel(), y.ravel()])
        self.inside = shapely.contains_xy(footprint, x, y)

    def heights(self, solid: Any) -> np.ndarray:
        place = np.column_stack([self.xy_m, np.zeros(len(self.xy_m))])
        return topmost(np.ascontiguousarray(solid.corner_m), place)[1].reshape(self.shape)


def compare(building: Any, truth: Any, footprint: Any, beside: Any, point_m: np.ndarray) -> dict[str, Any]:
    """The faults of a building. beside: the neighbours' footprints; point_m: the points within the footprint."""
    raster = Raster(footprint)
    true = raster.heights(truth.solid)
    is_true = np.isfinite(true)
    row: dict[str, Any] = {"kind": truth.attributes["shape"], **building.attributes}
    true_z = true[is_true]
    lowest_z = np.quantile(true_z[true_z > true_z.min() + 0.3] if row["kind"] == "shaft" else true_z, 0.1)
    row["ground above roof"] = building.attributes["ground_z_m"] > lowest_z - 0.5
    row["ground_m"] = (
        building.attributes["ground_z_m"] - hillside_z_m(*shapely.get_coordinates(footprint).T).mean()
    )
    row["shafts"] = row["found"] = row["false shafts"] = row["slabs"] = row["too long"] = row["above"] = 0
    # leaves out the cells at walls, which the map has elsewhere
    inner = raster.inside & ndimage.binary_erosion(is_true, _disc(0.5))
    shaft = np.zeros(raster.shape, bool)
    if row["kind"] == "shaft":
        shaft = is_true & (true < true_z.min() + 0.3)
    found = raster.heights(building.solid) if building.solid is not None else np.full(raster.shape, np.nan)
    row["error_m"] = float(np.nanmedian(np.abs(found - true)[inner])) if inner.any() else np.nan
    if row["kind"] == "gone" or building.solid is None:
        return row
    highest = ndimage.maximum_filter(true, footprint=_disc(1.0))
    if len(point_m):
        near = cKDTree(point_m[:, :2]).query_ball_point(raster.xy_m, 1.0)
        top = np.array([point_m[some, 2].max() if some else -np.inf for some in near]).reshape(raster.shape)
    else:
        top = np.full(raster.shape, -np.inf)
    row["above"] = sum(map(_is_wide, _areas(raster.inside & (found > np.maximum(highest, top) + 0.5))))
    at_border = shapely.dwithin(beside, shapely.points(raster.xy_m), 0.6).reshape(raster.shape)
    for area in _areas(raster.inside & (found > highest + 1.0)):
        length_m = np.hypot(*np.ptp(raster.xy_m[area.ravel()], axis=0))
        if length_m >= 1 and not _is_wide(area) and (area & at_border).any():
            row["too long" if _is_wide(_part(area, found, raster.xy_m)) else "slabs"] += 1
    if shaft.sum() * CELL_M**2 >= 4.0:
        around = float(np.median(true[is_true & ~shaft]))
        well = ndimage.binary_erosion(shaft, _disc(0.5))
        row["shafts"] = 1
        row["found"] = int(np.mean(found[well] < (around + true_z.min()) / 2) > 0.5)
    lowest = ndimage.minimum_filter(np.where(is_true, true, np.inf), footprint=_disc(0.75))
    low = inner & (found < lowest - 2.0) & ~ndimage.binary_dilation(shaft, _disc(0.75))
    row["false shafts"] = (
        sum(map(_is_wide, _areas(low))) if row["kind"] not in ("changed", "many-levels") else 0
    )
    return row


def measured(seed: int, folder: Path) -> list[dict[str, Any]]:
    """A row per building of a town."""
    if not (folder / ROOFS).exists():
        write_town(folder, seed, "old")
    truth = p2wss.read(folder / ROOFS)
    scene = p2wss.reconstruct(folder / LIDAR, folder / FOOTPRINTS, model="none", progress=False)
    scene.write(folder / "out", formats=["cityjsonseq", "gpkg"])
    shapes = np.asarray(shapely.force_2d(gpd.read_file(folder / FOOTPRINTS).geometry.to_numpy()))
    tree = shapely.STRtree(shapes)
    cloud = read_clouds([folder / LIDAR])
    points = shapely.STRtree(np.asarray(shapely.points(cloud.x_m, cloud.y_m)))
    z_m = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])
    rows = []
    for number, (building_id, true) in enumerate(truth.items()):
        near = tree.query(shapes[number], "dwithin", 0.5)
        beside = shapely.union_all(shapes[near[near != number]])
        point_m = z_m[points.query(shapes[number], "contains")]
        rows.append(compare(scene[building_id], true, shapes[number], beside, point_m) | {"id": building_id})
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=SEED, help=f"of the town; default: {SEED}")
    parser.add_argument(
        "--save", type=Path, help="folder to keep the town and its reconstruction in, or that has the town"
    )
    arguments = parser.parse_args()
    with contextlib.ExitStack() as stack:
        folder = arguments.save or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        rows = measured(arguments.seed, folder)
    figures = Figures()
    titles = ("slabs", "too long", "above", "ground above roof", "shafts", "found", "false shafts")
    groups = {"all": rows} | {kind: [row for row in rows if row["kind"] == kind] for kind in TROUBLES}
    print(
        "".ljust(16)
        + "buildings, not ok, not representable, not reliable, "
        + ", ".join(titles)
        + ", error m, rms of ground m"
    )
    for name, members in groups.items():
        values = {
            "buildings": len(members),
            "not ok": sum(row["status"] != "ok" for row in members),
            "not representable": sum(bool(row["not_representable"]) for row in members),
            "not reliable": sum(not row["is_reliable"] for row in members),
            **{title: int(sum(row[title] for row in members)) for title in titles},
            "error, m": float(np.nanmedian([row["error_m"] for row in members])),
            "ground, m": float(np.sqrt(np.nanmean([row["ground_m"] ** 2 for row in members]))),
        }
        print(name.ljust(16) + "".join(f"{value:8.3g}" for value in values.values()))
        figures.row(name, values)
    whole = {title: sum(row[title] for row in rows) for title in titles}
    for title in ("slabs", "too long", "above", "ground above roof", "false shafts"):
        print(f"{title}:", " ".join(row["id"][-6:] for row in rows if row[title])[:120])
    print("not found:", " ".join(row["id"][-6:] for row in rows if row["shafts"] > row["found"])[:120])
    seen = [row for row in rows if row["visible_share"] is not None and row["visible_share"] >= 0.6]
    figures.at_most("false slabs, of 1,000 buildings", 1000 * whole["slabs"] / len(rows), 0)
    figures.at_least("shafts found", whole["found"] / whole["shafts"], 0.9)
    figures.at_most(
        "false shafts", whole["false shafts"] / max(whole["found"] + whole["false shafts"], 1), 0.02
    )
    figures.at_most(
        "not representable where seen", float(np.mean([bool(row["not_representable"]) for row in seen])), 0.08
    )
    figures.at_most("roofs above their support", whole["above"], 0)
    figures.at_most("ground above the own roof", whole["ground above roof"], 0)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
