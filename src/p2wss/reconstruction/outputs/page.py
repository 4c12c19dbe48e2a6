"""The HTML page of a run or of CityJSON files: the buildings in 3D and in a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import cycle, pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pyproj
import shapely

from p2wss.clouds.cropping import crop_points
from p2wss.data import polygon_arrays, reasons
from p2wss.data.building import Reconstruction
from p2wss.data.las_classes import BUILDING_CLASS, PERHAPS_ROOF_CLASS, has_class
from p2wss.data.points import stride
from p2wss.formats import viewer
from p2wss.formats.materials import materials_of
from p2wss.formats.viewer import OUTLINES, Layer, Place, Shown
from p2wss.mesh import Mesh
from p2wss.mesh.surface import distance_to_mesh
from p2wss.reconstruction.outputs.attributes import attributes, with_columns
from p2wss.reconstruction.registration.register import summary as registration_summary
from p2wss.reconstruction.result import Result, summary
from p2wss.skeleton.types import FaceKind
from p2wss.storage.las_crs import horizontal

if TYPE_CHECKING:
    from p2wss.clouds.reading import Cloud
    from p2wss.data.terrain import Terrain
    from p2wss.reconstruction.scene import Scene, SceneBuilding

# most buildings with attributes, further buildings as mere shapes, points and plants: more would make a page slow
MAX_BUILDINGS, MAX_OTHERS, MAX_POINTS, MAX_PLANTS = 2000, 18_000, 300_000, 5000
GROUND_MARGIN_M, NUM_GROUND_CELLS = 25.0, 80
_ABOVE_GROUND_M = 0.5
# the distances of at most this many places to all buildings are in memory at once
_MAX_TOGETHER = 500
_OURS = "p2wss"
# the heights of the ground at places (n, 2)
Heights: TypeAlias = Callable[[np.ndarray], np.ndarray]


def page_of_run(
    results: Sequence[Result],
    stem: str,
    crs: pyproj.CRS,
    facts: Mapping[str, Any],
    keep_columns: Sequence[str],
    plants: Sequence[Mesh] = (),
    terrain: Terrain | None = None,
) -> str:
    """The HTML of a run. stem: the stem of the run's file names. facts: the provenance. keep_columns: the columns of
    the footprints to show; materials are taken from all columns. plants, terrain: in ``crs``."""
    worst = np.argsort([-np.nan_to_num(result.residual_m, nan=-1.0) for result in results], kind="stable")
    chosen = [results[number] for number in np.sort(worst[:MAX_BUILDINGS])]
    rest = (results[number].reconstruction for number in worst[MAX_BUILDINGS:][:MAX_OTHERS])
    others = [each.placed_mesh for each in rest if each.has_mesh]
    position_m = [result.reconstruction.position_m for result in chosen]
    origin_m, heights = _origin_m(position_m), _heights(position_m, terrain)
    every = stride(sum(len(result.sample_m) for result in chosen), MAX_POINTS)
    buildings = [_shown(result, origin_m, every, heights, keep_columns) for result in chosen]
    sentences = [summary(results), *_left_out(len(results)), _origin(facts)]
    registrations = [result.registration for result in results if result.registration is not None]
    off = "registration: off, or footprints are outlines of the points"
    sentences.insert(1, registration_summary(registrations) if registrations else off)
    layers = [Layer(_OURS, "Meshes", "#c8603a", is_ours=True)]
    if any(OUTLINES.key in each.meshes for each in buildings):
        layers.append(OUTLINES)
    place = _place(plants, others, buildings, origin_m, heights, horizontal(crs).name)
    return viewer.scene_page(stem, sentences, buildings, layers, place)


def page_of_scenes(title: str, scenes: Mapping[str, Scene], cloud: Cloud | None) -> str:
    """The HTML of the buildings of one or several files. Buildings of the same id are shown together.

    scenes: by the names of the files. cloud: points in the same CRS, or None. Their distances to the buildings of the
    first file are shown; the mean becomes ``residual_m`` of a building without this attribute.
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
        each: viewer.number(of_id[first].attributes, "residual_m")
        for each, of_id in by_id.items()
        if first in of_id
    }
    worst = sorted(by_id, key=lambda each: -(residual_m.get(each) or 0.0))
    chosen = {building_id: by_id[building_id] for building_id in worst[:MAX_BUILDINGS]}
    rest = (by_id[each].get(first) for each in worst[MAX_BUILDINGS:][:MAX_OTHERS])
    others = [each.solid for each in rest if each is not None and each.solid is not None]
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
            stated = (
                stated
                if "residual_m" in stated
                else {**stated, "residual_m": round(float(distance_m.mean()), 3)}
            )
        placed = {name: mesh.translated(-origin_m) for name, mesh in meshes.items()}
        buildings.append(Shown(building_id, placed, point_m - origin_m, distance_m, stated))
    sentences = [f"{name}: {scene.summary}" for name, scene in scenes.items()]
    sentences += _left_out(len(by_id))
    plants = [plant for scene in scenes.values() for plant in scene.plants.values()]
    position_m = [
        np.array([*solid.vertex_m.mean(axis=0)[:2], solid.vertex_m[:, 2].min()])
        for members in solids
        for solid in members
    ]
    crs, heights = scenes[first].crs, _heights(position_m, None)
    place = _place(plants, others, buildings, origin_m, heights, "" if crs is None else horizontal(crs).name)
    return viewer.scene_page(title, sentences, buildings, layers, place)


def _origin(facts: Mapping[str, Any]) -> str:
    """A sentence that tells the version of p2wss and the input files; "" if the files are unknown."""
    names = [*facts.get("clouds", []), *filter(None, [facts.get("footprints"), facts.get("terrain")])]
    return f"Made by p2wss {facts.get('version', '')} from {', '.join(names)}." if names else ""


def _place(
    plants: Sequence[Mesh],
    others: Sequence[Mesh],
    buildings: Sequence[Shown],
    origin_m: np.ndarray,
    heights: Heights,
    crs: str,
) -> Place:
    """The surroundings of the buildings on a page: plants, other buildings and ground. crs: the name of the CRS."""
    crowns = [plant.translated(-origin_m) for plant in plants[:: stride(len(plants), MAX_PLANTS)]]
    shapes = [other.translated(-origin_m) for other in others]
    meshes = [*shapes, *(mesh for building in buildings for mesh in building.meshes.values())]
    corner_m = [mesh.vertex_m[:, :2] for mesh in meshes]
    ground = (
        _ground(np.concatenate(corner_m) + origin_m[:2], heights).translated(-origin_m) if corner_m else None
    )
    return Place(crowns, shapes, ground, crs, reasons.MEANINGS | reasons.FLAGS)


def _heights(position_m: Sequence[np.ndarray], terrain: Terrain | None) -> Heights:
    """A function that returns the height of the ground at places (n, 2): the terrain, and where it is unknown, a mean
    of the ground of buildings, weighted by nearness. position_m: (3,) each, a place of each building on the ground."""
    known = np.array([each for each in position_m if np.isfinite(each).all()]).reshape(-1, 3)

    def of_buildings(plan_m: np.ndarray) -> np.ndarray:
        x_m, y_m = (plan_m[:, axis, None] - known[:, axis] for axis in (0, 1))
        away_m2 = x_m**2 + y_m**2
        weight = 1 / (away_m2 + 1.0) ** 2
        return (weight @ known[:, 2]) / weight.sum(axis=1)

    def of(plan_m: np.ndarray) -> np.ndarray:
        parts = np.array_split(plan_m, len(plan_m) // _MAX_TOGETHER + 1)
        z_m = np.concatenate([of_buildings(part) for part in parts])
        if terrain is None:
            return z_m
        heights_m = terrain.interpolated(*plan_m.T)
        return np.where(np.isfinite(heights_m), heights_m, z_m)

    return of


def _ground(plan_m: np.ndarray, heights: Heights) -> Mesh:
    """The ground around places (n, 2), as a grid of squares."""
    low, high = plan_m.min(axis=0) - GROUND_MARGIN_M, plan_m.max(axis=0) + GROUND_MARGIN_M
    step_m = max(float((high - low).max()) / NUM_GROUND_CELLS, 1.0)
    x_m, y_m = np.meshgrid(*(np.arange(a, b + step_m, step_m) for a, b in zip(low, high, strict=True)))
    node_m = np.column_stack([x_m.ravel(), y_m.ravel()])
    number = np.arange(len(node_m)).reshape(x_m.shape)
    a, b, c, d = (
        each.ravel() for each in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    )
    triangle = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return _flat(np.column_stack([node_m, heights(node_m)]), triangle)


def _flat(vertex_m: np.ndarray, triangle: np.ndarray) -> Mesh:
    kind, label = np.full(len(triangle), FaceKind.GROUND, np.uint8), np.zeros(len(triangle), np.int32)
    return Mesh(vertex_m, triangle.astype(np.int32), kind, label)


def _outline(reconstruction: Reconstruction, heights: Heights) -> dict[str, Mesh]:
    """The footprint of a building without a mesh as a flat mesh a little above the ground; empty without a footprint or
    ground."""
    if not reconstruction.rings or not np.isfinite(reconstruction.position_m).all():
        return {}
    polygon = shapely.Polygon(reconstruction.rings[0], reconstruction.rings[1:])
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    corner_m = (
        shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)
        + reconstruction.origin_xy_m
    )
    vertex_m = np.column_stack([corner_m, heights(corner_m) + _ABOVE_GROUND_M])
    return {OUTLINES.key: _flat(vertex_m, np.arange(len(vertex_m)).reshape(-1, 3))}


def _points_of(plans: Sequence[shapely.Geometry], cloud: Cloud | None) -> list[np.ndarray]:
    """The points (n, 3) over each plan, evenly thinned; only points of roofs if the cloud has such points."""
    if cloud is None:
        return [np.zeros((0, 3)) for _ in plans]
    areas = [plan if isinstance(plan, shapely.Polygon) else shapely.Polygon() for plan in plans]
    polygons = polygon_arrays.to_polygons(np.array(areas, dtype=object))
    among = has_class(cloud.classification, (BUILDING_CLASS, PERHAPS_ROOF_CLASS))
    point, _, offset = crop_points(cloud.x_m, cloud.y_m, polygons, 0.0, among if among.any() else None)
    every = stride(len(point), MAX_POINTS)
    xyz_m = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])
    return [xyz_m[point[start:end:every]] for start, end in pairwise(offset)]


def _left_out(num_buildings: int) -> list[str]:
    if num_buildings <= MAX_BUILDINGS:
        return []
    sentence = f"The {MAX_BUILDINGS} buildings that are the farthest from their points can be chosen here; "
    num_without = max(num_buildings - MAX_BUILDINGS - MAX_OTHERS, 0)
    return [sentence + ("the others are grey." if not num_without else f"{num_without} are left out.")]


def _origin_m(position_m: Sequence[np.ndarray]) -> np.ndarray:
    """(3,), whole metres: the origin of the coordinates of a page, as coordinates of a graphics card have 24 bits."""
    finite = [each for each in position_m if np.isfinite(each).all()]
    return np.floor(np.mean(finite, axis=0)) if finite else np.zeros(3)


def _shown(
    result: Result, origin_m: np.ndarray, every: int, heights: Heights, keep_columns: Sequence[str]
) -> Shown:
    reconstruction = result.reconstruction
    meshes = (
        {_OURS: reconstruction.placed_mesh} if reconstruction.has_mesh else _outline(reconstruction, heights)
    )
    meshes = {key: mesh.translated(-origin_m) for key, mesh in meshes.items()}
    sample_m = result.sample_m[::every].astype(float)
    return Shown(
        reconstruction.building_id,
        meshes,
        sample_m[:, :3] + reconstruction.position_m - origin_m,
        sample_m[:, 3],
        attributes(with_columns(result, keep_columns)),
        materials=materials_of(result.columns),
    )
