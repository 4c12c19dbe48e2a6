"""What can be wrong with the arguments of ``p2wss reconstruct`` is reported before anything slow is imported or read:
from names, signatures and headers of the files."""

from __future__ import annotations

import json
import os
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from p2wss.cli.common import bounds_of_tile, log
from p2wss.config import TABLES_AND_MODELS, Config
from p2wss.errors import InputError
from p2wss.nets import weights_file

if TYPE_CHECKING:
    import pyproj

    from p2wss.clouds.reading import CloudHeader
    from p2wss.data.metric_crs import MetricCrs
    from p2wss.data.terrain import Terrain
    from p2wss.nets.compute import DeviceName


class Request(NamedTuple):
    """The files and choices of the command line. footprints: None for outlines derived from the points."""

    clouds: list[Path]
    footprints: Path | None
    out: Path
    crs: str | None
    terrain: Path | None
    model: Path | None
    device: DeviceName
    tile: str | None


@dataclass(frozen=True)
class Inputs:
    """The checked inputs. clouds: files, those of folders included. weights: None for no network. metric: the CRS of
    the run, ``crs``, and that of the clouds. terrain: in the CRS of the run."""

    clouds: list[CloudHeader]
    weights: Path | None
    metric: MetricCrs
    terrain: Terrain | None

    @property
    def crs(self) -> pyproj.CRS:
        """The CRS of the run, in metres."""
        return self.metric.crs


def check(request: Request, config: Config) -> Inputs:
    """The inputs of ``p2wss reconstruct``, cheap checks first.

    Raises :class:`InputError`, in one line, for an argument that cannot work; logs a warning for one without effect.
    """
    _check_outputs(request, config)
    if request.tile is not None:
        bounds_of_tile(request.tile, config)
    weights = weights_file.weights_to_use(request.model, config.reconstruct)
    if weights is not None:
        weights_file.read_metadata(weights, "model")
        _check_device(request.device)
    for path in filter(None, (request.footprints, request.terrain)):
        if not path.exists():
            raise InputError(f"{path}: no such file")

    from p2wss.clouds import reading as clouds
    from p2wss.data import metric_crs

    if request.footprints is None:
        headers, metric = check_clouds(request.clouds, request.crs)
        return Inputs(headers, weights, metric, _terrain(request, metric))
    headers = clouds.read_headers(clouds.list_clouds(request.clouds))
    # a tile may be empty
    may_be_empty = request.tile is not None
    columns = [config.reconstruct.id_field, config.reconstruct.height_field]
    columns += [name for name in config.reconstruct.keep_columns if name != "all"]
    footprints_crs = _check_footprints(request.footprints, columns, may_be_empty)
    stated = clouds.common_header(headers)
    cloud = headers[0] if stated is None else stated
    names = (str(cloud.path), str(request.footprints))
    crs, note = metric_crs.common_crs(cloud.crs, footprints_crs, request.crs, names)
    metric, note_of_units = metric_crs.metric_crs(crs, cloud.bounds, names[0])
    for text in filter(None, (note, note_of_units)):
        log.info("note: %s", text)
    if not may_be_empty and not any(header.num_points for header in headers):
        raise InputError(f"{request.clouds[0]}: has no points")
    return Inputs(headers, weights, metric, _terrain(request, metric))


def check_clouds(paths: Sequence[Path], stated_crs: str | None) -> tuple[list[CloudHeader], MetricCrs]:
    """The clouds without footprints and the CRS of the run. Raises :class:`InputError` if nobody states their CRS."""
    from p2wss.clouds import reading as clouds
    from p2wss.data import metric_crs

    headers = clouds.read_headers(clouds.list_clouds(paths))
    cloud = clouds.common_header(headers) or headers[0]
    if cloud.crs is None and stated_crs is None:
        raise InputError(f"{cloud.path} does not state its CRS; state it with --crs, such as EPSG:28992")
    if not any(header.num_points for header in headers):
        raise InputError(f"{paths[0]}: has no points")
    crs, _ = metric_crs.common_crs(cloud.crs, None, stated_crs, (str(cloud.path), ""))
    metric, note = metric_crs.metric_crs(crs, cloud.bounds, str(cloud.path))
    if note:
        log.info("note: %s", note)
    return headers, metric


def _terrain(request: Request, metric: MetricCrs) -> Terrain | None:
    if request.terrain is None:
        return None
    from p2wss.data.terrain import read_terrain

    terrain, terrain_crs = read_terrain(request.terrain, metric.source.to_wkt())
    return metric.terrain(terrain, terrain_crs, request.terrain)


def _check_outputs(request: Request, config: Config) -> None:
    _check_folder(request.out)
    outputs = config.reconstruct.outputs
    if any(name not in TABLES_AND_MODELS for name in outputs):
        return
    names = ", ".join(outputs)
    if request.terrain is not None:
        raise InputError(
            f"--terrain {request.terrain}: {names} cannot hold a terrain; add a mesh format to --outputs, such as"
            " glb, or omit --terrain"
        )
    if config.reconstruct.per_building:
        log.warning("warning: --per-building has no effect: none of %s is a mesh format", names)


def _check_folder(out: Path) -> None:
    """Raise :class:`InputError` if ``out`` is not a folder, or no file can be written there."""
    folder = existing_folder(out)
    if not folder.is_dir():
        raise InputError(f"{out}: not written: {folder} is a file; name a folder for the outputs")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{out}: not written: {error.strerror or error}") from error


def existing_folder(out: Path) -> Path:
    """``out``, or the nearest folder above it that exists."""
    while not os.path.lexists(out):
        out = out.parent
    return out


def _check_device(device: str) -> None:
    """Raise :class:`InputError` for a GPU without a torch that can use one; whether there is one, torch will say."""
    torch_version = version("torch")
    if device == "cuda" and torch_version.endswith("+cpu"):
        raise InputError(
            f"--device cuda: torch {torch_version} has no CUDA; install torch with CUDA, or use --device cpu"
        )


def _check_footprints(path: Path, columns: Sequence[str], may_be_empty: bool) -> pyproj.CRS | None:
    """The CRS that the file states, if any. Raises :class:`InputError` if it cannot hold footprints."""
    import pyproj

    # GDAL may come without its driver for Parquet
    info = _geoparquet(path) if path.suffix.lower() == ".parquet" else _layer(path)
    if not info["features"] and not may_be_empty:
        raise InputError(f"{path}: has no features")
    geometry = info["geometry_type"]
    if geometry is None:
        raise InputError(f"{path}: has no geometry")
    if info["features"] and not any(
        name in geometry for name in ("Polygon", "Surface", "Collection", "Unknown")
    ):
        raise InputError(f"{path}: has no polygons; footprints must be polygons")
    fields = list(map(str, info["fields"]))
    for column in filter(None, columns):
        if column not in fields:
            raise InputError(f"{path}: has no column {column}; its columns are {', '.join(fields) or 'none'}")
    return None if info["crs"] is None else pyproj.CRS.from_user_input(info["crs"])


def _layer(path: Path) -> dict[str, Any]:
    """What GDAL states about the first layer without reading its features."""
    import pyogrio

    try:
        with warnings.catch_warnings():
            # several layers are reported when the file is read
            warnings.simplefilter("ignore")
            return dict(pyogrio.read_info(path))
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable vector file: {' '.join(str(error).split())}") from error


def _geoparquet(path: Path) -> dict[str, Any]:
    """The same of a GeoParquet file (specification 1.1)."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        stored = pq.read_metadata(path)
        geo = json.loads((stored.metadata or {}).get(b"geo", b"{}"))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable vector file: {' '.join(str(error).split())}") from error
    primary = geo.get("primary_column")
    column = geo.get("columns", {}).get(primary)
    names = [name for name in stored.schema.to_arrow_schema().names if name != primary]
    return {
        "features": stored.num_rows,
        "geometry_type": None if column is None else " ".join(column["geometry_types"]) or "Unknown",
        "fields": names,
        "crs": None if column is None else column.get("crs", "OGC:CRS84"),
    }
