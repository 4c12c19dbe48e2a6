"""Inputs of a reconstruction, checked by names, signatures and headers of the files. So an error is reported before
anything slow is read."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import laspy
import numpy as np
import pyproj
import shapely

from p2wss.clouds import reading
from p2wss.clouds.reading import Cloud, CloudHeader
from p2wss.config import Config, Reconstruct
from p2wss.data.crs import (
    STATE_CRS,
    MetricCrs,
    check_crs,
    common_crs,
    doubtful_place,
    horizontal,
    metric_crs,
    odd_place,
    same_crs,
)
from p2wss.data.las_classes import BUILDING_CLASS, LAS, ClassSet, class_set
from p2wss.data.listing import VECTOR
from p2wss.data.terrain import UNITS_M, Terrain, read_terrain
from p2wss.data.tiling import Bounds, are_near, bounds_of_points, grown
from p2wss.footprints import vector_files
from p2wss.nets.weights_file import NO_NETWORK, read_metadata, weights_to_use
from p2wss.reconstruction.roof_lines import read_lines
from p2wss.storage.features import Features
from p2wss.storage.las_crs import UNKNOWN, placed, stated_crs, unit_m, with_heights
from p2wss.storage.messages import InputError, first_of, log

if TYPE_CHECKING:
    import geopandas as gpd

CloudInput: TypeAlias = "str | Path | Sequence[str | Path] | np.ndarray | laspy.LasData | Cloud"
FootprintInput: TypeAlias = (
    "str | Path | gpd.GeoDataFrame | gpd.GeoSeries | shapely.Geometry | Sequence[shapely.Geometry]"
)
LineInput: TypeAlias = FootprintInput
# international and survey feet are the same here
_SAME_UNIT = 1e-5
# files of one run are hardly farther apart
_FAR_M = 100_000.0
# LAS 1.4 names fewer than 20 classes, and surveys add a few
_MAX_CLASSES = 32
# heights of a large raster are read this far around footprints, plus the margin of the triangulated terrain
_GROUND_M = 100.0
# length of a radian on the ground
_RADIAN_M = 6.4e6
# the name of points without a file, in messages and outputs
_CLOUD = Path("cloud")


@dataclass(frozen=True)
class Inputs:
    """The checked inputs of a run.

    name: the name of the outputs, from the first cloud. headers: of the clouds, files of folders included. points: the
    cloud if it is in memory, else None. footprints: None where they are derived from the points. metric: the CRS of the
    run, ``crs``, and the conversion from the CRS of the clouds. terrain: the heights in the CRS of the run, and their
    file. weights: of Point2WSS; None: no such network. completion: whether another network may complete roofs of few
    points. lines: roof lines, float64 (l, 2, 2), in the CRS of the run, and the name of their file; None without.
    """

    name: str

    headers: Sequence[CloudHeader]
    points: Cloud | None
    footprints: Path | gpd.GeoDataFrame | None
    metric: MetricCrs
    terrain: tuple[Terrain, Path] | None
    weights: Path | None
    completion: bool
    lines: tuple[np.ndarray, str] | None = None

    @property
    def crs(self) -> pyproj.CRS:
        """The CRS of the run, in metres."""
        return self.metric.crs

    @property
    def footprints_name(self) -> Path:
        """The file of the footprints, for messages."""
        return Path(vector_files.file_of(self.footprints))

    def chunks(self, window: Bounds, classes: ClassSet) -> Iterator[Cloud]:
        """The points in a window, about half a million at a time; points and window in the CRS of the run."""
        if self.points is not None:
            yield self.points.in_classes(classes).in_metres(self.metric)
            return
        window = self.metric.window_of_clouds(window)
        near = [header.path for header in self.headers if header.overlaps(window)]
        for chunk in reading.read_in_chunks(near, window, classes):
            yield chunk.in_metres(self.metric)

    def overlap(self, window: Bounds) -> bool:
        """Whether a cloud may have points in a window in the CRS of the run."""
        window = self.metric.window_of_clouds(window)
        return any(header.overlaps(window) for header in self.headers)


def check_inputs(
    cloud: CloudInput,
    footprints: FootprintInput | None,
    config: Config,
    crs: str | None = None,
    terrain: str | Path | None = None,
    model: str | Path | None = None,
    may_be_empty: bool = False,
    lines: LineInput | None = None,
) -> Inputs:
    """The inputs of a run, cheap checks first.

    crs: of the clouds, as the user states it. terrain: a raster of heights. model: a file of weights of Point2WSS,
    "point2wss" for the weights of the package, "none" for no network at all: roofs of few points are not completed
    either. may_be_empty: whether clouds and footprints may be without content, as in a tile. lines: roof lines of a
    map.

    Raises :class:`InputError`, in one line, for an input that cannot work. Logs a note for what is assumed.
    """
    weights = weights_to_use(None if model is None else Path(model))
    if weights is not None:
        read_metadata(weights, "model")
    footprints = None if footprints is None else as_footprints(footprints)
    lines = None if lines is None else as_footprints(lines, "lines")
    for path in (
        [cloud] if isinstance(cloud, str | Path) else cloud if isinstance(cloud, list | tuple) else []
    ):
        if str(path).lower().endswith(VECTOR):
            raise InputError(f"{path}: is a vector file, no point cloud; the order is: clouds, footprints")
    for path in (footprints, terrain, lines):
        if isinstance(path, str | Path) and not Path(path).exists():
            raise InputError(f"{path}: no such file")
    headers, points = open_clouds(cloud)
    header = reading.common_header(headers) or headers[0]
    names, footprints_crs = (str(header.path), vector_files.file_of(footprints)), None
    if footprints is None and header.crs is None and crs is None:
        raise InputError(f"{header.path} does not state its CRS; {STATE_CRS}")
    if footprints is not None:
        settings = config.reconstruct
        columns = [settings.id_field, settings.height_field]
        columns += [name for name in settings.keep_columns if name != "all"]
        footprints_crs = _check_footprints(footprints, columns, may_be_empty, settings.footprint_layer)
    source, note = common_crs(header.crs, footprints_crs, crs, names, header.bounds)
    if footprints is not None and footprints_crs is None:
        log.info("note: %s does not state its CRS; assuming %s as that of the clouds", names[1], source.name)
    _check_places(headers, header, source)
    metric, note_of_units = _metric(source, headers, points, config.reconstruct.height_unit)
    for text in filter(None, (note, note_of_units)):
        log.info("note: %s", text)
    if not may_be_empty and not any(each.num_points for each in headers):
        raise InputError(f"{headers[0].path}: has no points")
    raster = None
    if terrain is not None:
        windows = partial(_windows, footprints, footprints_crs or source, headers, metric, config.reconstruct)
        heights, heights_crs = read_terrain(
            terrain, metric.source.to_wkt(), config.reconstruct.terrain_unit, metric.unstated_m, windows
        )
        raster = (metric.terrain(heights, heights_crs, terrain), Path(terrain))
        boxes = [metric.bounds_of_run(each.bounds) for each in headers if each.bounds is not None]
        if boxes and not any(raster[0].cut(box).height_m.size for box in boxes):
            raise InputError(
                f"{terrain}: is in {heights_crs.name}, and has no cell at {names[0]}: is that its CRS?"
            )
    name = lines.name if isinstance(lines, Path) else "lines"
    of_roofs = None if lines is None else (read_lines(lines, metric), name)
    completion = str(model) != NO_NETWORK
    return Inputs(_name(cloud), headers, points, footprints, metric, raster, weights, completion, of_roofs)


def _windows(
    footprints: Path | gpd.GeoDataFrame | None,
    crs: pyproj.CRS,
    headers: Sequence[CloudHeader],
    metric: MetricCrs,
    settings: Reconstruct,
    terrain_crs: pyproj.CRS,
) -> list[Bounds]:
    """Windows in ``terrain_crs`` in which heights of the terrain are needed: around the footprints, and around the
    clouds. crs: of the footprints."""
    to_run, to_terrain = (
        pyproj.Transformer.from_crs(horizontal(source), horizontal(target), always_xy=True)
        for source, target in ((crs, metric.crs), (metric.crs, terrain_crs))
    )
    everywhere = (-np.inf, -np.inf, np.inf, np.inf)
    boxes = [everywhere if each.bounds is None else metric.bounds_of_run(each.bounds) for each in headers]
    clouds, bounds = (*np.min(boxes, axis=0)[:2].tolist(), *np.max(boxes, axis=0)[2:].tolist()), None
    if isinstance(footprints, Path):
        bounds = vector_files.layer_info(footprints, settings.footprint_layer, with_bounds=True)[
            "total_bounds"
        ]
    elif footprints is not None:
        bounds = footprints.total_bounds
    windows = [clouds] if bounds is None else [to_run.transform_bounds(*bounds), clouds]
    # footprints all over the world have no finite window in a projection, or one far away
    windows = [each for each in windows if np.isfinite(each).all() and are_near(each, clouds, 0)]
    margin_m = settings.terrain_margin_m + _GROUND_M
    return [to_terrain.transform_bounds(*grown(each, margin_m)) for each in windows]


def _metric(
    source: pyproj.CRS, headers: Sequence[CloudHeader], points: Cloud | None, unit: str
) -> tuple[MetricCrs, str | None]:
    """The CRS of a run on clouds in ``source``, and a note if it differs. The headers may state a CRS of the heights
    apart. unit: of the heights, as the user states it, or empty."""
    _check_heights(headers, unit)
    heights = next((each.heights for each in headers if each.heights is not None), None)
    if heights is not None:
        source = with_heights(source, heights)
    bounds = headers[0].bounds if points is not None else reading.extent(headers)
    return metric_crs(source, bounds, str(headers[0].path), UNITS_M.get(unit))


def _check_heights(headers: Sequence[CloudHeader], unit: str) -> None:
    """Raise :class:`InputError` if files state different units of heights, unless the user states a ``unit``. Warn if
    files state different height datums."""
    stated = {each.heights: each.path for each in reversed(headers) if each.heights is not None}
    if not stated:
        return
    *others, (first, of_first) = stated.items()
    for heights, path in others:
        words = (
            f"{path}: heights are in {heights.name}, in units of {unit_m(heights):.10g} m, but those of {of_first} in"
            f" {first.name}, in units of {unit_m(first):.10g} m"
        )
        if not unit and not np.isclose(unit_m(heights), unit_m(first), rtol=_SAME_UNIT):
            raise InputError(f"{words}; convert one of them, or state --height-unit if one is wrong")
        if UNKNOWN not in (heights.name, first.name) and heights.name != first.name:
            log.warning("warning: %s; none is converted", words)


def _check_places(headers: Sequence[CloudHeader], known: CloudHeader, crs: pyproj.CRS) -> None:
    """Warn of coordinates that cannot be right in ``crs``, the CRS of the clouds: the coordinates of ``known``, which
    states the CRS, and of each file that is far from it. Warn of far files that state no CRS."""
    unit_m = crs.axis_info[0].unit_conversion_factor * (_RADIAN_M if crs.is_geographic else 1.0)
    far = [
        each
        for each in headers
        if each.bounds and known.bounds and not are_near(each.bounds, known.bounds, _FAR_M / unit_m)
    ]
    for level, word, doubt_of in (
        (logging.WARNING, "warning", odd_place),
        (logging.INFO, "note", doubtful_place),
    ):
        doubts: dict[str, list[str]] = {}
        for each in [known, *far]:
            if each.bounds and (doubt := doubt_of(crs, each.bounds)):
                doubts.setdefault(doubt, []).append(str(each.path))
        for doubt, paths in doubts.items():
            log.log(level, "%s: %s: %s", word, first_of(paths), doubt)
    if unstated := [str(each.path) for each in far if each.crs is None]:
        log.warning(
            "warning: %s: states no CRS, and would be more than %g km from %s; if it is in another CRS, reproject it",
            first_of(unstated),
            _FAR_M / 1000,
            known.path,
        )


def read_cloud(
    headers: Sequence[CloudHeader], points: Cloud | None, metric: MetricCrs | None, classes: ClassSet = LAS
) -> Cloud:
    """All points, in the CRS of the run. headers, points: as :func:`open_clouds` returns them. metric: None leaves the
    points in the CRS of the clouds."""
    if points is None:
        chunks = reading.read_in_chunks([each.path for each in headers], None, classes)
        return reading.joined(chunks if metric is None else (each.in_metres(metric) for each in chunks))
    points = points.in_classes(classes)
    return points if metric is None else points.in_metres(metric)


def read_cloud_of(
    scene: pyproj.CRS | None,
    bounds: Bounds | None,
    name: str,
    clouds: CloudInput,
    crs: str | None = None,
    height_unit: str = "",
    classes: ClassSet = LAS,
) -> tuple[Cloud, MetricCrs | None]:
    """(all points of clouds, to compare with the buildings of a file, the conversion of the buildings to their CRS).

    Points are in metres; they stay in their units where neither clouds, user nor buildings state a CRS. The conversion
    is None where the buildings need none. scene: the CRS of the buildings; None: they are taken to be in the CRS of a
    run on the clouds. bounds: of the buildings. name: of their file. crs, height_unit: of the clouds, as the user
    states them. Raises :class:`InputError` for clouds of another CRS than the buildings.
    """
    headers, points = open_clouds(clouds)
    header = reading.common_header(headers) or headers[0]
    if header.crs is None and crs is None and scene is None:
        return read_cloud(headers, points, None, classes), None
    source, note = common_crs(header.crs, scene, crs, (str(header.path), name), header.bounds)
    metric, note_of_units = _metric(source, headers, points, height_unit)
    for text in filter(None, (note, note_of_units)):
        log.info("note: %s", text)
    if scene is None:
        return read_cloud(headers, points, metric, classes), None
    of_scene, _ = metric_crs(scene, bounds, name)
    if metric.horizontal_m is None and not same_crs(metric.crs, of_scene.crs):
        metric = replace(metric, crs=of_scene.crs)  # another zone than the clouds alone would be in
    check_crs(metric.crs, of_scene.crs, header.path, f"{name} is", "reproject one of them")
    return read_cloud(headers, points, metric, classes), None if of_scene.is_source else of_scene


def read_outlines(inputs: Inputs, config: Config) -> tuple[Cloud, Features, bool]:
    """(the whole cloud, the outlines of its buildings as footprints, whether only p2wss has given class building)."""
    # compiled code, which is slow to load
    from p2wss.reconstruction.points import unclassified
    from p2wss.reconstruction.tracing.outlines import outline_features, outlines_and_crowns, with_plants

    classes = class_set(**config.region.classes.model_dump())
    cloud = read_cloud(inputs.headers, inputs.points, inputs.metric, classes)
    is_classified = bool((cloud.classification == BUILDING_CLASS).any())
    unknown = unclassified.warnings_of_unknown(np.bincount(cloud.classification, minlength=256))
    cloud, warnings = unclassified.with_classes(cloud)
    warnings += unknown
    if is_classified:
        cloud, missed_m2 = unclassified.with_missed_buildings(cloud)
        if missed_m2:
            warnings.append(
                f"{missed_m2:.0f} m2 of unclassified points on planes 2 m above the ground, without class 6: they have"
                " outlines, as of buildings that the producer missed"
            )
    for warning in warnings:
        log.warning("warning: %s", warning)
    shapes, crowns = outlines_and_crowns(cloud, config.reconstruct.outlines, is_classified)
    return with_plants(cloud, crowns), outline_features(shapes, inputs.crs), not is_classified


def output_stem(cloud: Path) -> str:
    """The name of the outputs: the name of the folder, or of the cloud's file without its endings.

    >>> output_stem(Path("in/Semis_2021.copc.laz"))
    'Semis_2021'
    """
    return cloud.resolve().name if cloud.is_dir() else cloud.stem.removesuffix(".copc")


def _name(cloud: CloudInput) -> str:
    first = cloud[0] if isinstance(cloud, list | tuple) else cloud
    return output_stem(Path(first)) if isinstance(first, str | Path) else _CLOUD.name


def as_footprints(footprints: FootprintInput, name: str = "footprints") -> Path | gpd.GeoDataFrame:
    """The file or the table of footprints, or of roof lines, that a user gives. Bare geometries are numbered.

    name: "footprints" or "lines". Raises :class:`InputError` for what is neither a path nor geometries.
    """
    if isinstance(footprints, str | Path):
        if name == "footprints" and Path(footprints).suffix.lower() in (".json", ".jsonl"):
            from p2wss.formats.cityjson_read import is_cityjson, plans

            if is_cityjson(footprints):
                table = plans(footprints)
                table.attrs[vector_files.FILE] = str(footprints)
                return table
        return Path(footprints)
    import geopandas as gpd

    try:
        if not isinstance(footprints, gpd.GeoDataFrame):
            alone = [footprints] if isinstance(footprints, shapely.Geometry) else footprints
            footprints = gpd.GeoSeries(alone).to_frame("geometry")
        footprints.geometry  # noqa: B018
        names = [each for each in footprints.index.names if each is not None and each not in footprints]
        if names:  # named levels of the index, such as ids after set_index
            footprints = footprints.reset_index(names)
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"the {name} are a {type(footprints).__name__}; give a vector file, a GeoDataFrame or"
            + (" polygons, after the cloud" if name == "footprints" else " LineStrings")
        ) from error
    return footprints


def open_clouds(cloud: CloudInput) -> tuple[Sequence[CloudHeader], Cloud | None]:
    """(headers of the files, None), or for a cloud in memory ([its header], its points). A warning says what is wrong
    with a stated CRS."""
    files = [cloud] if isinstance(cloud, str | Path) else cloud
    points: Cloud | None = None
    if isinstance(files, list | tuple) and files and all(isinstance(each, str | Path) for each in files):
        headers = reading.read_headers(reading.list_clouds([Path(path) for path in files]))
    else:
        points = _in_memory(cloud)
        # an empty header states nothing
        stated = stated_crs(cloud.header if isinstance(cloud, laspy.LasData) else laspy.LasHeader())
        bounds = bounds_of_points(points.x_m, points.y_m)
        headers = [CloudHeader(_CLOUD, len(points), points.crs, bounds, stated.heights, stated.doubts)]
    for doubt in dict.fromkeys(doubt for each in headers for doubt in each.doubts):
        log.warning("warning: %s: %s", next(each.path for each in headers if doubt in each.doubts), doubt)
    return headers, points


def _in_memory(cloud: CloudInput) -> Cloud:
    if isinstance(cloud, Cloud):
        return cloud
    if isinstance(cloud, laspy.LasData):
        return reading.cloud_of(cloud)
    try:
        # a table's columns are taken by name, whatever their order, and whatever other columns there are
        table: Any = cloud
        names = getattr(table, "columns", ())
        if isinstance(cloud, np.ndarray) and cloud.dtype.names:
            names = cloud.dtype.names
            if any(cloud.dtype[name].kind != "f" for name in names if name.lower() in ("x", "y", "z")):
                raise InputError(
                    "the cloud's X, Y and Z are whole numbers, as in LAS before scale and offset; give the"
                    " laspy.LasData, or coordinates"
                )
        named = {str(name).lower(): name for name in names}
        if {"x", "y", "z"} <= named.keys():
            chosen = [named[name] for name in ("x", "y", "z", "classification") if name in named]
            table = np.column_stack([_numbers(table[name], name) for name in chosen])
        points: np.ndarray = np.ma.asarray(table, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"the cloud is a {type(cloud).__name__}; give LAS files or points, before the footprints"
        ) from error
    if points.ndim != 2 or points.shape[1] not in (3, 4):
        raise InputError(
            f"the cloud has shape {points.shape}; give points as (n, 3), or (n, 4) with LAS classes"
        )
    whole: np.ndarray = np.ma.compress_rows(points)
    if len(whole) < len(points):
        log.info("note: %d points of the cloud are masked, and left out", len(points) - len(whole))
    points = whole
    # 1: unclassified
    classes = points[:, 3] if points.shape[1] == 4 else np.ones(len(points))
    is_class = (classes >= 0) & (classes < 256) & (classes % 1 == 0)
    if not np.isfinite(points).all() or not is_class.all():
        raise InputError(
            "the cloud has coordinates that are not finite, or classes that are not whole, 0 to 255"
        )
    if len(np.unique(classes)) > _MAX_CLASSES:
        raise InputError(
            f"the fourth column of the cloud has more than {_MAX_CLASSES} values, as intensities have; it counts as LAS"
            " classes: give points as (n, 3) without them"
        )
    x_m, y_m, z_m = np.ascontiguousarray(points[:, :3].T)
    return Cloud(x_m, y_m, z_m, classes.astype(np.uint8), None)


def _numbers(column: Any, name: str) -> np.ndarray:
    """A column of the cloud. Raises :class:`InputError` if it has values that are no numbers."""
    try:
        return np.asarray(column, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"the cloud's column {name} is not of numbers: {error}") from error


def _check_footprints(
    footprints: Path | gpd.GeoDataFrame, columns: Sequence[str], may_be_empty: bool, layer: str
) -> pyproj.CRS | None:
    """The CRS that the footprints state, or None. Raises :class:`InputError` if they have no polygons, lack one of the
    ``columns``, or are empty unless ``may_be_empty``."""
    name = vector_files.file_of(footprints)
    if isinstance(footprints, Path):
        info = vector_files.layer_info(footprints, layer)
    else:
        info = {
            "features": len(footprints),
            "geometry_type": " ".join(footprints.geom_type.dropna().unique()) or "Unknown",
            "fields": [each for each in footprints.columns if each != footprints.geometry.name],
            "crs": footprints.crs,
        }
    if not info["features"] and not may_be_empty:
        raise InputError(f"{name}: has no features")
    geometry = info["geometry_type"]
    if geometry is None:
        raise InputError(f"{name}: {vector_files.no_geometry(name)}")
    if info["features"] and not any(
        kind in geometry for kind in ("Polygon", "Surface", "Collection", "Unknown")
    ):
        others = (
            f"; its other layers are {', '.join(info['other_layers'])}" if info.get("other_layers") else ""
        )
        raise InputError(f"{name}: {vector_files.NO_POLYGONS}{others}")
    fields = list(map(str, info["fields"]))
    for column in filter(None, columns):
        if column not in fields:
            raise InputError(f"{name}: has no column {column}; its columns are {', '.join(fields) or 'none'}")
    return None if info["crs"] is None else placed(pyproj.CRS.from_user_input(info["crs"]))
