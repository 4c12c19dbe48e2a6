"""The page of a run: its buildings in 3D and in a table, and a map of how its footprints were moved. Also that of any
CityJSON files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle, pairwise
from typing import TYPE_CHECKING

import numpy as np
import pyproj
import shapely

from p2wss.clouds.cropping import crop_points
from p2wss.data import polygon_arrays
from p2wss.data.crs import horizontal
from p2wss.data.las_classes import BUILDING_CLASS
from p2wss.data.points import stride
from p2wss.formats import shift_map, viewer
from p2wss.formats.shift_map import Block, Footprint
from p2wss.formats.viewer import Layer, Shown
from p2wss.mesh import Mesh
from p2wss.mesh.surface import distance_to_mesh
from p2wss.reconstruct.attributes import attributes
from p2wss.reconstruct.registration import NOTHING, Registration
from p2wss.reconstruct.registration import summary as registration_summary
from p2wss.reconstruct.result import Result, summary

if TYPE_CHECKING:
    from p2wss.clouds.reading import Cloud
    from p2wss.reconstruct.scene import Scene, SceneBuilding

# more would make a page slow: the others are in the table of the run
MAX_BUILDINGS, MAX_POINTS, MAX_PLANTS = 2000, 300_000, 5000
_OURS = "p2wss"


def page_of_run(results: Sequence[Result], stem: str, crs: pyproj.CRS, plants: Sequence[Mesh] = ()) -> str:
    """The HTML of a run. stem: of the names of its files. plants: in the CRS."""
    worst = np.argsort([-np.nan_to_num(result.residual_m, nan=-1.0) for result in results], kind="stable")
    chosen = [results[number] for number in np.sort(worst[:MAX_BUILDINGS])]
    origin_m = _origin_m([result.reconstruction.position_m for result in chosen])
    every = stride(sum(len(result.sample_m) for result in chosen), MAX_POINTS)
    buildings = [_shown(result, origin_m, every) for result in chosen]
    sentences = [summary(results), *_left_out(len(results))]
    rows, footprints, blocks = _moved(results)
    off = "registration: off, or the cloud has no points of class building"
    sentences.append(registration_summary(rows) if rows else off)
    shifts = shift_map.content(horizontal(crs).name, footprints, blocks) if rows else None
    layer = Layer(_OURS, "Meshes", "#c8603a", is_ours=True)
    return viewer.scene_page(stem, sentences, buildings, [layer], shifts, _placed(plants, origin_m))


def page_of_scenes(title: str, scenes: Mapping[str, Scene], cloud: Cloud | None) -> str:
    """The HTML of the buildings of one or several files by their names; those of the same id are shown together.

    cloud: points in the same CRS, or None. Their distances are those to the first file, and become its ``residual_m``
    where it states none.
    """
    first, colors = next(iter(scenes)), ("#c8603a", *viewer.OTHER_COLORS)
    layers = [
        Layer(name, name, color, name == first) for name, color in zip(scenes, cycle(colors), strict=False)
    ]
    by_id: dict[str, dict[str, SceneBuilding]] = {}
    for name, scene in scenes.items():
        for building in scene.values():
            by_id.setdefault(building.building_id, {})[name] = building
    residual_m = {
        each: of_id[first].attributes.get("residual_m") for each, of_id in by_id.items() if first in of_id
    }
    worst = sorted(by_id, key=lambda each: -(residual_m.get(each) or 0.0))[:MAX_BUILDINGS]
    chosen = {building_id: by_id[building_id] for building_id in worst}
    solids = [[each.solid for each in of.values() if each.solid is not None] for of in chosen.values()]
    origin_m = _origin_m([solid.vertex_m.min(axis=0) for members in solids for solid in members])
    plans = [
        shapely.MultiPoint(np.concatenate([m.vertex_m[:, :2] for m in of] or [np.zeros((0, 2))]))
        for of in solids
    ]
    points = _points_of([plan.convex_hull for plan in plans], cloud)
    buildings = []
    for (building_id, of), point_m in zip(chosen.items(), points, strict=True):
        meshes = {name: each.solid for name, each in of.items() if each.solid is not None}
        stated = next(iter(of.values())).attributes
        distance_m = np.zeros(len(point_m))
        if first in meshes and len(point_m):
            distance_m = distance_to_mesh(point_m, meshes[first].vertex_m, meshes[first].triangle)
            stated = {"residual_m": round(float(distance_m.mean()), 3), **stated}
        placed = {name: mesh.translated(-origin_m) for name, mesh in meshes.items()}
        buildings.append(Shown(building_id, placed, point_m - origin_m, distance_m, stated))
    sentences = [f"{name}: {scene.summary}" for name, scene in scenes.items()]
    sentences += _left_out(len(by_id))
    plants = _placed([plant for scene in scenes.values() for plant in scene.plants], origin_m)
    return viewer.scene_page(title, sentences, buildings, layers, plants=plants)


def _placed(plants: Sequence[Mesh], origin_m: np.ndarray) -> list[Mesh]:
    return [plant.translated(-origin_m) for plant in plants[:: stride(len(plants), MAX_PLANTS)]]


def _points_of(plans: Sequence[shapely.Geometry], cloud: Cloud | None) -> list[np.ndarray]:
    """For each plan the points (n, 3) over it, evenly thinned: of the building class where there are any."""
    if cloud is None:
        return [np.zeros((0, 3)) for _ in plans]
    areas = [plan if isinstance(plan, shapely.Polygon) else shapely.Polygon() for plan in plans]
    polygons = polygon_arrays.to_polygons(np.array(areas, dtype=object))
    among = cloud.classification == BUILDING_CLASS
    point, _, offset = crop_points(cloud.x_m, cloud.y_m, polygons, 0.0, among if among.any() else None)
    every = stride(len(point), MAX_POINTS)
    xyz_m = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])
    return [xyz_m[point[start:end:every]] for start, end in pairwise(offset)]


def _left_out(num_buildings: int) -> list[str]:
    if num_buildings <= MAX_BUILDINGS:
        return []
    return [f"This page shows {MAX_BUILDINGS} buildings, those that are the farthest from their points."]


def _origin_m(position_m: Sequence[np.ndarray]) -> np.ndarray:
    """(3,), whole metres: coordinates of a page are relative to it, since those of a graphics card have 24 bits."""
    finite = [each for each in position_m if np.isfinite(each).all()]
    return np.floor(np.mean(finite, axis=0)) if finite else np.zeros(3)


def _shown(result: Result, origin_m: np.ndarray, every: int) -> Shown:
    reconstruction = result.reconstruction
    meshes = {_OURS: reconstruction.placed_mesh.translated(-origin_m)} if reconstruction.has_mesh else {}
    sample_m = result.sample_m[::every].astype(float)
    return Shown(
        reconstruction.building_id,
        meshes,
        sample_m[:, :3] + reconstruction.position_m - origin_m,
        sample_m[:, 3],
        attributes(result),
    )


def _moved(results: Sequence[Result]) -> tuple[list[Registration], list[Footprint], dict[str, Block]]:
    """The registrations, the footprints with a block, and what was done with each block; results are read once."""
    rows, footprints, blocks = [], [], {}
    for result in results:
        row, reconstruction = result.registration, result.reconstruction
        if row is not None:
            rows.append(row)
        if row is None or not row.block or not reconstruction.rings:
            continue
        rings = [ring + reconstruction.origin_xy_m for ring in reconstruction.rings]
        used = shapely.Polygon(rings[0], rings[1:])
        evidence = (row.flags, row.ground_inside_m2, row.roof_outside_m2)
        footprints.append(
            Footprint(reconstruction.building_id, row.block, row.input_polygon, used, *evidence)
        )
        blocks[row.block] = Block(_action(row), *row.shift_m, row.shift_sd_m, row.overhang_m)
    return rows, footprints, blocks


def _action(row: Registration) -> str:
    if row.source == NOTHING:
        return shift_map.UNKNOWN
    if row.shift_m == (0.0, 0.0):
        return shift_map.STAYED
    return shift_map.MOVED
