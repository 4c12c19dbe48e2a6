"""The files of a drawn town, with its true roofs; which points its survey records."""

from __future__ import annotations

from itertools import starmap
from pathlib import Path

import numpy as np
import shapely

from drawn_towns.large import LARGE_SWINGS_PER_S, draw_complexes, draw_large
from drawn_towns.lidar import LIDAR, SWINGS_PER_S, scan_town, write_points
from drawn_towns.old import draw_old
from drawn_towns.planes import mesh_of
from drawn_towns.wings import draw_terraces, draw_wings, true_solids
from p2wss.formats.cityjson import Metadata, Solid, lines
from p2wss.storage import files
from p2wss.towns import FOOTPRINTS, TERRAIN, draw_town
from p2wss.towns.buildings import DrawnBuilding
from p2wss.towns.ign import building_id, write_footprints, write_terrain
from p2wss.towns.site import BUILDING_CLASS, CRS, GROUND_CLASS, UNCLASSIFIED_CLASS, in_lidar_tile

ROOFS = "roofs/roofs.city.jsonl"
# wings: houses whose roofs consist of several bodies; terraces: rows of such houses; old: tall houses wall to wall;
# large: schools, convents, factories, .. of up to some 50 planes; complexes: several large buildings grown together, of
# 50 to 300 planes; streets: the towns of p2wss towns
KINDS = {
    "wings": draw_wings,
    "terraces": draw_terraces,
    "old": draw_old,
    "large": draw_large,
    "complexes": draw_complexes,
    "streets": draw_town,
}
MINIATURE_SEED = 652  # the town of streets under tests/mini
# area of p2wss demo: rows and detached houses between the centre and the edge of the miniature's town
_DEMO = shapely.box(653_150, 6_860_690, 653_270, 6_860_790)
# share of the towns of complexes without classes; their surveys have last returns only
WITHOUT_CLASSES = 1 / 3


def write_town(folder: Path, seed: int, kind: str, with_lidar: bool = True) -> list[DrawnBuilding]:
    """Draw the town of ``seed`` of a kind of :data:`KINDS`, write its files and true roofs (no roofs for streets) into
    ``folder`` and return its buildings. Footprints, terrain and roofs are the same with and without the LiDAR."""
    rng = np.random.Generator(np.random.PCG64(seed))
    town = KINDS[kind](rng)
    write_terrain(folder / TERRAIN, town[0].ground)
    write_footprints(town, folder / FOOTPRINTS, rng)
    if with_lidar:
        points, is_near = scan_town(
            town, rng, LARGE_SWINGS_PER_S if kind in ("large", "complexes") else SWINGS_PER_S
        )
        is_recorded = recorded([each for each in town if in_lidar_tile(each.footprint)], points, rng)
        if kind == "complexes":
            is_recorded &= points["return_number"] == points["number_of_returns"]
            if rng.random() < WITHOUT_CLASSES:
                points["classification"][:] = 0
        write_points(points, is_near & is_recorded, folder / LIDAR)
    if kind == "streets":
        return town
    solids = [
        Solid(building_id(index), mesh.vertex_m, mesh.surfaces, {"shape": building.kind})
        for index, (building, mesh) in enumerate(zip(town, starmap(mesh_of, true_solids(town)), strict=True))
    ]
    metadata = Metadata(int(CRS.removeprefix("EPSG:")))
    files.write_text(folder / ROOFS, "\n".join(lines(solids, metadata)) + "\n")
    return town


def write_demo(folder: Path) -> None:
    """Write the files of ``p2wss demo``: a few streets of the miniature's town, and LiDAR of them."""
    rng = np.random.Generator(np.random.PCG64(MINIATURE_SEED))
    streets = [building for building in draw_town(rng) if _DEMO.contains(building.footprint)]
    write_footprints(streets, folder / "footprints.gpkg", rng)
    write_points(*scan_town(streets, rng), folder / "lidar.laz")


def recorded(
    buildings: list[DrawnBuilding], points: dict[str, np.ndarray], rng: np.random.Generator
) -> np.ndarray:
    """bool (n,): the points that the scanner records. Changes the classes of points on roofs that are hard to
    classify."""
    keep, classes = np.ones(len(points["x"]), bool), points["classification"]
    areas = [
        (wing.outline, BUILDING_CLASS, wing.seen_as, wing.seen_share)
        for building in buildings
        for wing in building.wings
        if (wing.seen_as, wing.seen_share) != (BUILDING_CLASS, 1)
    ]
    near = [
        each.footprint.buffer(each.hidden_ground_m).exterior.coords
        for each in buildings
        if each.hidden_ground_m
    ]
    areas += [(np.array(ring), GROUND_CLASS, UNCLASSIFIED_CLASS, 1.0) for ring in near]
    if not areas:
        return keep
    tree = shapely.STRtree(np.asarray(shapely.points(points["x"], points["y"])))
    for ring, number, seen_as, share in areas:
        inside = tree.query(shapely.Polygon(ring), "contains")
        inside = inside[classes[inside] == number]
        keep[inside] = rng.random(len(inside)) < share
        classes[inside] = seen_as
    return keep
