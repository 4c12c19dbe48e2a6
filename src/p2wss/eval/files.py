"""Measures of the buildings of any CityJSON file against point clouds: ``p2wss evaluate``.

The footprints decide which points belong to which building, so that files of several programs can be compared.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyproj
import shapely
from scipy.spatial import cKDTree

from p2wss.clouds.cropping import crop_points
from p2wss.config import Config
from p2wss.data import polygon_arrays
from p2wss.data.crs import MetricCrs
from p2wss.data.las_classes import BUILDING_CLASS, class_set
from p2wss.eval.metrics import chamfer_distance_m, mesh_facts
from p2wss.footprints.cleaning import read_footprints
from p2wss.footprints.schemas import GENERIC
from p2wss.formats import cityjson_read
from p2wss.formats.cityjson_read import ReadSolid
from p2wss.mesh import Mesh
from p2wss.mesh.topology import doubled_areas
from p2wss.reconstruction.inputs import CloudInput, FootprintInput, as_footprints, read_cloud_of
from p2wss.reconstruction.scene import Scene, bounds_of
from p2wss.skeleton.types import FaceKind
from p2wss.storage.messages import InputError, log

# points up to this distance from the footprint belong to the building
BUFFER_M = 1.0
# least number of points near a building to measure it, and of points on it to measure its roof
MIN_POINTS, MIN_ROOF_POINTS = 50, 10
# largest number of points of a building that are used, and number of samples on meshes and on roofs
NUM_SAMPLES = 2048
# number of samples of the mesh to which distances of points are measured
NUM_DENSE_SAMPLES = 40_000
MEASURES = ("cd_m", "roof_cd_m", "points_to_mesh_m", "num_triangles")


def evaluate(
    buildings: str | Path | Scene | Sequence[ReadSolid],
    footprints: FootprintInput,
    clouds: CloudInput,
    config: Config | None = None,
    *,
    id_field: str | None = None,
    crs: str | None = None,
    seed: int = 0,
) -> pd.DataFrame:
    """One row per footprint, by building id, with the measures of its mesh.

    buildings: a CityJSON file or text sequence, a scene, or solids. If they state no CRS, they are taken to be in the
    CRS of a run on the clouds. A building belongs to the footprint whose id is its name or its attribute ``id_field``,
    if it touches that footprint; else to the footprint that it overlaps most. Clouds are read as
    :func:`p2wss.reconstruct` reads them: measures are in metres, whatever the units of files. id_field: column of the
    ids of the footprints; None: the one of ``config``, or recognised. crs: of clouds whose headers state none. config:
    the classes of clouds and the unit of their heights, and the layer of the footprints.

    Columns: ``status`` (``ok``, or without measures ``no mesh`` or ``too few points``); ``num_points`` up to 1 m from
    the footprint; ``cd_m``, the Chamfer distance between at most 2048 of these points and as many samples of the mesh;
    ``roof_cd_m``, the same between the points of class 6 inside the footprint and the faces of the roof;
    ``points_to_mesh_m``, the mean distance of the latter points to 40,000 samples of the mesh; ``num_triangles``;
    ``is_watertight``, whether each of its solids is. Raises :class:`InputError` for a file that is missing or broken.
    """
    config = config or Config()
    settings, classes = config.reconstruct, class_set(**config.region.classes.model_dump())
    id_field = id_field or settings.id_field or None
    solids, scene_crs = _solids(buildings)
    name = str(buildings) if isinstance(buildings, str | Path) else "buildings"
    bounds = bounds_of([each.mesh for each in solids])
    cloud, conversion = read_cloud_of(scene_crs, bounds, name, clouds, crs, settings.height_unit, classes)
    if conversion is not None:
        solids = [replace(each, mesh=conversion.mesh(each.mesh)) for each in solids]
    frame = _footprints(footprints, id_field, cloud.crs, settings.footprint_layer)
    by_id = _matched(solids, frame.geometry, id_field)
    parts = frame.geometry.explode()
    point, inside, offset = crop_points(
        cloud.x_m, cloud.y_m, polygon_arrays.to_polygons(parts.values), BUFFER_M
    )
    xyz_m = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])
    crops = defaultdict(list)
    for name, pairs in zip(parts.index, map(slice, offset[:-1], offset[1:]), strict=True):
        crops[name].append((point[pairs], point[pairs][inside[pairs]]))
    if len(point) and not (cloud.classification[point[inside]] == BUILDING_CLASS).any():
        log.warning(
            "warning: no point on the footprints has class 6 (building): there are no distances to roofs"
        )
    rows = []
    for name in frame.index:
        near, within = (np.unique(np.concatenate(members)) for members in zip(*crops[name], strict=True))
        on_building = within[cloud.classification[within] == BUILDING_CLASS]
        rows.append(
            {"num_points": len(near)} | _measures(xyz_m[near], xyz_m[on_building], by_id.get(name), seed)
        )
    return pd.DataFrame(rows, frame.index, ["status", "num_points", *MEASURES, "is_watertight"])


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Mean, quartiles and standard deviation (of the population) of each measure, over the buildings with a mesh."""
    values = table.loc[table["status"] == "ok", list(MEASURES)].astype(float)
    statistics = values.quantile([0.25, 0.5, 0.75]).set_axis(["q1", "median", "q3"])
    return pd.concat([values.mean().to_frame("mean").T, statistics, values.std(ddof=0).to_frame("std").T])


def _footprints(
    footprints: FootprintInput, id_field: str | None, crs: pyproj.CRS | None, layer: str
) -> gpd.GeoDataFrame:
    """The polygons by id, in the CRS of the clouds if both are known."""
    metric = None if crs is None else MetricCrs(crs, crs)
    features = read_footprints(
        as_footprints(footprints), id_field, needs_crs=False, metric=metric, layer=layer
    )
    frame = features.to_frame().set_index("building_id")
    return frame[~frame.geometry.is_empty & frame.geom_type.isin(("Polygon", "MultiPolygon"))]


def _solids(
    buildings: str | Path | Scene | Sequence[ReadSolid],
) -> tuple[Sequence[ReadSolid], pyproj.CRS | None]:
    """(the solids of buildings, their CRS if it is stated)."""
    if isinstance(buildings, str | Path):
        objects, crs = cityjson_read.read_city(buildings)
        return [each for each in objects if each.is_building], crs
    if isinstance(buildings, Scene):
        solids = [
            ReadSolid(each.building_id, each.solid, {})
            for each in buildings.values()
            if each.solid is not None
        ]
        return solids, buildings.crs
    if not isinstance(buildings, list | tuple) or not all(isinstance(each, ReadSolid) for each in buildings):
        raise InputError(f"buildings: state a scene or a CityJSON file, not a {type(buildings).__name__}")
    return buildings, None


def _matched(
    solids: Sequence[ReadSolid], footprints: gpd.GeoSeries, id_field: str | None
) -> dict[str, ReadSolid]:
    """The solid of each footprint that has one. Several solids of one footprint, such as those of its parts, are
    joined."""
    known: defaultdict[str, list[ReadSolid]] = defaultdict(list)
    unknown: defaultdict[str, list[ReadSolid]] = defaultdict(list)
    num_elsewhere = 0
    for solid in solids:
        if not len(solid.mesh.triangle):
            continue
        values = [solid.building_id, *(solid.attributes.get(name) for name in (id_field or "", *GENERIC.ids))]
        named = [str(value) for value in values if str(value) in footprints.index]
        # an id that another program has given may be the id of another footprint
        xy_m = solid.mesh.vertex_m[:, :2]
        around = shapely.box(*xy_m.min(axis=0), *xy_m.max(axis=0))
        ids = [name for name in named if footprints[name].intersects(around)]
        num_elsewhere += bool(named) and not ids
        if ids:
            known[ids[0]].append(solid)
        elif (nearest := _most_overlapped(solid, footprints)) is not None:
            unknown[nearest].append(solid)
    if num_elsewhere:
        log.warning(
            "warning: buildings that are not on the footprint of their id: %d; each counts for one that it overlaps",
            num_elsewhere,
        )
    return {
        name: replace(members[0], mesh=Mesh.joined([each.mesh for each in members]), part=_parts(members))
        for name, members in (unknown | known).items()
    }


def _parts(members: Sequence[ReadSolid]) -> np.ndarray:
    """For each triangle of the joined solids of ``members``, the number of its solid, from 1; 0 for triangles in no
    solid."""
    count, parts = 0, []
    for each in members:
        part = np.ones(len(each.mesh.triangle), int) if each.part is None else each.part
        parts.append(np.where(part > 0, part + count, 0))
        count += int(part.max())
    return np.concatenate(parts)


def _most_overlapped(solid: ReadSolid, footprints: gpd.GeoSeries) -> str | None:
    """The id of the footprint that overlaps most with the plan of a solid; None if none does."""
    on_ground = solid.mesh.kind == FaceKind.GROUND
    corner_m = solid.mesh.corner_m[on_ground] if on_ground.any() else solid.mesh.corner_m
    plan = shapely.union_all(shapely.make_valid(shapely.polygons(corner_m[:, :, :2])))
    touched = footprints.iloc[footprints.sindex.query(plan, predicate="intersects")]
    areas_m2 = touched.intersection(plan).area
    return None if not (areas_m2 > 0).any() else str(areas_m2.idxmax())


def _measures(
    near_m: np.ndarray, on_building_m: np.ndarray, solid: ReadSolid | None, seed: int
) -> dict[str, Any]:
    """The columns of a building other than its number of points. Random draws depend on the seed alone."""
    if len(near_m) < MIN_POINTS:
        return {"status": "too few points"}
    if solid is None:
        return {"status": "no mesh"}
    draw, mesh, part = np.random.default_rng(seed), solid.mesh, _parts([solid])
    if len(near_m) > NUM_SAMPLES:
        near_m = near_m[np.sort(draw.choice(len(near_m), NUM_SAMPLES, replace=False))]
    row = {
        "status": "ok",
        "cd_m": chamfer_distance_m(near_m, _samples(mesh.corner_m, NUM_SAMPLES, draw)),
        "num_triangles": len(mesh.triangle),
        # solids that touch have edges in common
        "is_watertight": all(
            mesh_facts(mesh.vertex_m, mesh.triangle[part == number]).watertight
            for number in np.unique(part).tolist()
        ),
    }
    roof_m = _samples(mesh.corner_m[np.isin(mesh.kind, (FaceKind.ROOF, FaceKind.FLAT))], NUM_SAMPLES, draw)
    if len(on_building_m) >= MIN_ROOF_POINTS:
        dense_m = _samples(mesh.corner_m, NUM_DENSE_SAMPLES, draw)
        row["points_to_mesh_m"] = cKDTree(dense_m).query(on_building_m)[0].mean()
        row["roof_cd_m"] = chamfer_distance_m(on_building_m, roof_m)
    return row


def _samples(corner_m: np.ndarray, count: int, draw: np.random.Generator) -> np.ndarray:
    """Points drawn uniformly by area over triangles (t, 3, 3): (count, 3), or (0, 3) without area.

    They are drawn as in the independent script with which the figures must agree (tests/unit/eval/test_files.py);
    elsewhere trimesh draws samples.
    """
    area_m2 = np.linalg.norm(doubled_areas(corner_m), axis=1)
    if not area_m2.sum() > 0:
        return np.zeros((0, 3))
    a, b, c = corner_m[draw.choice(len(corner_m), count, p=area_m2 / area_m2.sum())].swapaxes(0, 1)
    from_a, from_b = np.sqrt(draw.random((count, 1))), draw.random((count, 1))
    return a + from_a * (b - a + from_b * (c - b))
