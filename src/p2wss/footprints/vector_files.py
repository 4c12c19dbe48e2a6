"""Read vector files: all formats and geometries that GDAL knows, each feature with its number in the file."""

import json
import re
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyogrio
import pyproj
import shapely

from p2wss.data.tiling import Bounds
from p2wss.footprints import osm_tags
from p2wss.storage import integrity
from p2wss.storage.features import Features, columns_of
from p2wss.storage.messages import InputError, log, reading

T = TypeVar("T")
# WKB types that shapely cannot read, and types that it reads with the same bytes
_SURFACES = {15: 6, 16: 6, 17: 3}  # polyhedral surface, TIN, triangle
# what messages call such a file
_KIND = "a readable vector file"
NO_POLYGONS = "has no polygons; QGIS makes them of closed lines, as of a DXF (Lines to polygons)"
_POINT, _LINE, _POLYGON = 1, 2, 3
# what is read from a layer, and the words of GDAL for kinds of geometry with it
_KINDS = {"polygons": ("Polygon", "Surface"), "lines": ("LineString", "Curve")}
# endings of tables as text, and columns in which they may have geometry
_TABLES = (".csv", ".tsv", ".psv")
_WKT_COLUMNS = ("WKT", "geometry", "geom", "the_geom", "wkt_geom")
# endings of GML; .xml is an ending of other formats, too
_GML = (".gml", ".xml")
# endings of vector files that are read in a .zip
_PACKED = (".shp", ".gpkg", ".gdb", ".geojson", ".fgb", ".gml", ".kml")
# integers beside missing values stay integers
_OF_PARQUET = {"integer_object_nulls": True}
# attribute of a table that was read from a file: its path
FILE = "p2wss_file"
# from here on, not each integer can be a float
_MAX_EXACT = 2**53


def read_vector(
    path: str | Path, bounds: Bounds | None = None, layer: str = "", of: str = "polygons"
) -> tuple[Features, np.ndarray]:
    """(the features of a layer, in the order of the file; the number of each feature in the file).

    layer: its name; "" is the first layer that may have ``of``, polygons or lines, with a note if there are others.
    bounds: read only features that intersect this window, in the CRS of the file. Curves become lines. A TIN and a
    polyhedral surface become a multipolygon of their triangles and faces. Times become text. Files in a .zip are read
    without unpacking. If polygons are read from OpenStreetMap, areas that are no buildings are left out, with a note.

    Raises :class:`InputError` if the file is missing or broken, or has no geometry or no layer of this name.
    """
    if not Path(path).exists():
        raise InputError(f"{path}: no such file")
    if not Path(path).is_dir():  # a file geodatabase is a folder
        integrity.verify(path)
    chosen, others = _layer(path, layer, of)
    if others and not layer:
        another = "--layer reads another" if of == "polygons" else "others are"
        text = "note: %s: layer %s, the first that may have %s, is read; %s: %s"
        log.info(text, path, chosen, of, another, ", ".join(others))
    with opening(path):
        if _is_parquet(path):
            import geopandas as gpd
            import pyarrow.parquet as pq

            table = pq.read_table(path)
            table.validate(full=True)  # text that is not UTF-8, for instance
            if b"geo" not in (table.schema.metadata or {}):
                raise InputError(f"{path}: {no_geometry(path)}")
            features = Features.of(gpd.read_parquet(path, to_pandas_kwargs=_OF_PARQUET))
            number = np.arange(len(features))
            if bounds is not None:
                number = np.flatnonzero(shapely.intersects(features.geometry, shapely.box(*bounds)))
            return features.take(number), number
        source = unpacked(path, layer)
        meta, number, wkb, columns = _read(source, layer=chosen, bbox=bounds)
    if wkb is None:
        raise InputError(f"{path}: {no_geometry(path)}")
    if str(source).lower().endswith(".shp") and not columns:  # each .dbf has a column
        log.warning(
            "warning: %s: has no .dbf, or a damaged one, and thus neither ids nor other columns", path
        )
    with reading(path, _KIND):
        try:
            shapes = shapely.from_wkb(wkb)
        except shapely.errors.GEOSException:
            # rings that do not end where they begin are closed
            shapes = shapely.from_wkb([each and _plain_wkb(each) for each in wkb], "fix")
        crs = None if meta["crs"] is None else pyproj.CRS.from_user_input(meta["crs"])
        features = Features(shapes, columns, crs)
    if of != "polygons":
        return features, number
    is_building = osm_tags.is_building(features.columns, len(features))
    if not is_building.all():
        log.info("note: %s: %d areas that are no buildings are left out", path, (~is_building).sum())
    return features.take(is_building), number[is_building]


def _read(
    source: str | Path, **options: Any
) -> tuple[dict[str, Any], np.ndarray, Any, dict[str, np.ndarray]]:
    """(what pyogrio knows of a layer, the number of each feature in the file, WKB or None, columns).

    pyogrio reads integers and booleans beside missing values as floats. Such columns become objects again: the values
    of the file, and None."""
    meta, number, wkb, values = decoded(
        source, pyogrio.raw.read, return_fids=True, datetime_as_string=True, **options
    )
    columns = dict(zip(meta["fields"].tolist(), values, strict=True))
    for dtype, (name, column) in zip(meta["dtypes"], columns.items(), strict=True):
        # columns of lists have a dtype that numpy does not know
        if column.dtype.kind != "f" or np.dtype(dtype).kind not in "biu":
            continue
        is_known = ~np.isnan(column)
        exact = column[is_known]
        if np.abs(exact).max(initial=0) >= _MAX_EXACT:
            alone = {"columns": [name], "read_geometry": False, "where": f'"{name}" IS NOT NULL'}
            exact = _read(source, **options | alone)[3][name]
        columns[name] = np.full(len(column), None)
        columns[name][is_known] = exact.astype(dtype).tolist()
    return meta, number, wkb, columns


def decoded(path: str | Path, read: Callable[..., T], **options: Any) -> T:
    """The result of ``read``, a function of pyogrio with a parameter ``encoding``, for a file, with the options that
    its format needs.

    The text of a shapefile without .cpg is read as UTF-8, as IGN writes it, if it is valid UTF-8. If text is not in the
    encoding that a .cpg states, it is read as ISO-8859-1, with a warning."""
    options |= _options(path)
    if Path(path).suffix.lower() != ".shp":
        return read(path, **options)
    states = Path(path).with_suffix(".cpg").exists()
    try:
        return read(path, encoding=None if states else "utf-8", **options)
    except UnicodeDecodeError:
        if states:
            text = "warning: %s: its text is not in the encoding that its .cpg states; ISO-8859-1 is taken"
            log.warning(text, path)
        return read(path, encoding="ISO-8859-1" if states else None, **options)


def unpacked(path: str | Path, layer: str = "") -> str | Path:
    """What GDAL opens to read a file: the file itself, or for a .zip, the vector file in it, in whatever folder.

    Raises :class:`InputError` if a .zip has several vector files, unless just one of them has a layer of this name."""
    if Path(path).suffix.lower() != ".zip":
        return path
    import zipfile

    with opening(path):
        with zipfile.ZipFile(path) as packed:
            # a file geodatabase is opened by its folder
            names = {re.sub(r"(?i)(\.gdb)/.*", r"\1", name) for name in packed.namelist()}
        files = sorted(
            f"/vsizip/{{{path}}}/{name}"
            for name in names
            # macOS packs metadata of each file in a folder of its own
            if name.lower().endswith(_PACKED) and not name.startswith("__MACOSX/")
        )
        layers = {file: [name for name, _ in layers_of(file)] for file in files}
    fitting = [file for file, names in layers.items() if not layer or layer in names]
    if len(files) > 1 and len(fitting) != 1:
        known = ", ".join(name for names in layers.values() for name in names)
        raise InputError(
            f"{path}: has several vector files; state a layer with --layer, or unpack it: {known}"
        )
    return next(iter(fitting or files), path)


@contextmanager
def opening(path: str | Path) -> Iterator[None]:
    """Turn any error of the ``with`` block into an :class:`InputError`; for an unknown format or kind of layer, it says
    what to do. Only the first warning of the block is logged, as there may be one per feature."""
    with reading(path, _KIND), warnings.catch_warnings(record=True) as said:
        # a database with another ending is read all the same
        warnings.filterwarnings("ignore", ".*non conformant file extension", RuntimeWarning)
        # said of .xml that is no GML, as files of the Dutch cadastre
        warnings.filterwarnings("ignore", ".*does not support open option", RuntimeWarning)
        try:
            yield
        except pyogrio.errors.GeometryError as error:  # 3D of any kind, TIN, polyhedral surfaces
            raise InputError(
                f"{path}: has layers of 3D geometries that cannot be read; save it as GeoPackage with geometries"
                " MultiPolygon, with QGIS for instance, or CityGML as CityJSON: citygml-tools to-cityjson FILE"
            ) from error
        except IndexError as error:  # pyogrio raises it if GDAL knows the format
            raise InputError(f"{path}: has no layers") from error
        except pyogrio.errors.DataSourceError as error:
            if "not recognized" not in str(error):
                raise
            remedy = (
                "unpack it"
                if Path(path).suffix.lower() in (".zip", ".gz")
                else "save it as GeoPackage, with QGIS for instance"
            )
            raise InputError(f"{path}: not {_KIND}; {remedy}") from error
    if said:
        log.warning("warning: %s: %.200s (%d in all)", path, said[0].message, len(said))


def _options(path: str | Path) -> dict[str, str]:
    """The options with which GDAL must read a file, by its ending."""
    ending = Path(path).suffix.lower()
    if ending in _TABLES:
        return {"GEOM_POSSIBLE_NAMES": ",".join(_WKT_COLUMNS), "KEEP_GEOM_COLUMNS": "NO"}
    if ending in _GML:
        # columns are taken from the .xsd, or from the features; a .gfs beside the file may belong to another file
        return {"XSD": str(path)[: -len(ending)] + ".xsd", "WRITE_GFS": "NO"}
    if ending == ".osm":
        # an editor gives what it has not uploaded negative ids, which the faster index refuses
        return {"CONFIG_FILE": str(osm_tags.AREAS), "USE_CUSTOM_INDEXING": "NO"}
    return {"CONFIG_FILE": str(osm_tags.AREAS)} if ending == ".pbf" else {}


def layers_of(path: str | Path) -> list[tuple[str, str | None]]:
    """(name, kind of geometry or None) of each layer. path: as :func:`unpacked` returns it."""
    if Path(path).suffix.lower() not in _GML:
        return [(str(name), kind) for name, kind in pyogrio.list_layers(path).tolist()]
    result: list[tuple[str, str | None]] = []
    while True:  # list_layers has no options
        try:
            info = decoded(path, pyogrio.read_info, layer=len(result))
        except pyogrio.errors.DataLayerError:
            return result
        result.append((info["layer_name"], info["geometry_type"]))


def file_of(footprints: Any) -> str:
    """The file of footprints, or what messages call a table without one; "" for None."""
    if footprints is None or isinstance(footprints, str | Path):
        return str(footprints or "")
    return getattr(footprints, "attrs", {}).get(FILE, "footprints")


def no_geometry(path: str | Path) -> str:
    """The words of a message on a file without geometry, which say what it lacks."""
    if _is_parquet(path):
        return "has no geometry; a Parquet file needs the metadata of GeoParquet, as geopandas writes them"
    if Path(path).suffix.lower() in _TABLES:
        return (
            f"has no geometry; a table needs WKT in a column {', '.join(_WKT_COLUMNS)}, without SRID, no WKB"
        )
    return "has no geometry"


def _is_parquet(path: str | Path) -> bool:
    """Whether a file is Parquet, or should be by its name."""
    if Path(path).suffix.lower() in (".parquet", ".geoparquet"):
        return True
    if not Path(path).is_file():
        return False
    with open(path, "rb") as file:
        return file.read(4) == b"PAR1"


def _layer(path: str | Path, stated: str, of: str = "polygons") -> tuple[str | None, list[str]]:
    """(the layer to read, the names of the others). It is the stated layer, else the first that may have ``of``, else
    the first layer; None for a file without layers. Raises :class:`InputError` if there is no layer of the stated
    name."""
    if _is_parquet(path):  # GDAL may come without its driver for Parquet
        if stated:
            raise InputError(f"{path}: has no layers; omit --layer")
        return None, []
    with opening(path):
        warnings.simplefilter("ignore")  # the warnings are repeated when the file is read
        layers = layers_of(unpacked(path, stated))
    names = [name for name, _ in layers]
    if stated and stated not in names:
        raise InputError(f"{path}: has no layer {stated}; its layers are {', '.join(names)}")
    # a layer that may have any geometry, as in databases, is chosen only if no layer states this kind
    of_kinds = [
        [name for name, kind in layers if kind and any(each in kind for each in kinds)]
        for kinds in (_KINDS[of], ("Unknown", "Collection"))
    ]
    chosen = stated or next((each[0] for each in [*of_kinds, names] if each), None)
    return chosen, [name for name in names if name != chosen]


def layer_info(path: Path, layer: str = "", with_bounds: bool = False) -> dict[str, Any]:
    """What a file states of the layer that :func:`read_vector` reads, without reading the features: ``features`` (their
    number; -1 for some, if it is not stated), ``geometry_type`` (None without geometry), ``fields``, ``crs``,
    ``layer``, ``other_layers`` and ``total_bounds``. The bounds may be None if they are not known without reading all
    features; ``with_bounds`` reads them then. Raises :class:`InputError` if the file is broken."""
    chosen, others = _layer(path, layer)
    if _is_parquet(path):
        info = _geoparquet_info(path)
    else:
        with opening(path):
            warnings.simplefilter("ignore")
            source = unpacked(path, layer)
            info = dict(decoded(source, pyogrio.read_info, layer=chosen, force_total_bounds=with_bounds))
            if info["features"] < 0:  # as in GML, DXF and FlatGeobuf
                info["features"] = -len(pyogrio.read_bounds(source, layer=chosen, max_features=1)[0])
    return info | {"layer": chosen, "other_layers": others}


def _geoparquet_info(path: Path) -> dict[str, Any]:
    """The facts of :func:`layer_info` for a GeoParquet file (specification 1.1)."""
    import pyarrow.parquet as pq

    with reading(path, _KIND):
        stored = pq.read_metadata(path)
        geo = json.loads((stored.metadata or {}).get(b"geo", b"{}"))
    primary = geo.get("primary_column")
    column = geo.get("columns", {}).get(primary)
    names = [name for name in stored.schema.to_arrow_schema().names if name != primary]
    # before version 1.0, the kind could be a text
    kinds = [] if column is None else column.get("geometry_types", column.get("geometry_type"))
    return {
        "features": stored.num_rows,
        "geometry_type": None if column is None else " ".join(np.atleast_1d(kinds)) or "Unknown",
        "fields": names,
        "crs": None if column is None else column.get("crs", "OGC:CRS84"),
        "total_bounds": column and column.get("bbox") and np.reshape(column["bbox"], (2, -1))[:, :2].ravel(),
    }


def read_attributes(
    path: str | Path, columns: tuple[str, ...], layer: str = ""
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """(these columns of all features of a layer, the number of each feature in the file)."""
    return _attributes(str(path), Path(path).stat().st_mtime_ns, columns, layer)


@lru_cache(maxsize=2)
def _attributes(
    path: str, changed_ns: int, columns: tuple[str, ...], layer: str
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    if _is_parquet(path):
        import pyarrow.parquet as pq

        frame = pq.read_table(path, columns=list(columns)).to_pandas(**_OF_PARQUET)
        return columns_of(frame), np.arange(len(frame))
    options = {"layer": _layer(path, layer)[0], "columns": list(columns), "read_geometry": False}
    _, number, _, values = _read(unpacked(path, layer), **options)
    return values, number


def _plain_wkb(wkb: bytes) -> bytes:
    """The WKB with types of geometries that shapely can read."""
    result = bytearray(wkb)
    _convert(result, 0)
    return bytes(result)


def _convert(wkb: bytearray, start: int) -> int:
    """Change the types of the geometry that begins at ``start``, and of its parts, in place; return where it ends."""
    order = "<" if wkb[start] == 1 else ">"
    (code,) = struct.unpack_from(f"{order}I", wkb, start + 1)
    # in codes of ISO, the thousands state the dimensions; in older codes, the uppermost bits do
    flags, base = (code & 0xF0000000, code & 0xFFF) if code >> 28 else (code // 1000 * 1000, code % 1000)
    has_z = bool(flags & 0x80000000) if code >> 28 else flags in (1000, 3000)
    has_m = bool(flags & 0x40000000) if code >> 28 else flags in (2000, 3000)
    base = _SURFACES.get(base, base)
    struct.pack_into(f"{order}I", wkb, start + 1, base + flags)
    point_size = 8 * (2 + has_z + has_m)
    if base == _POINT:
        return start + 5 + point_size
    (count,) = struct.unpack_from(f"{order}I", wkb, start + 5)
    at = start + 9
    if base == _LINE:
        return at + int(count) * point_size
    for _ in range(count):
        if base == _POLYGON:
            (num_points,) = struct.unpack_from(f"{order}I", wkb, at)
            at += 4 + num_points * point_size
        else:
            at = _convert(wkb, at)
    return at


def is_missing(values: np.ndarray) -> np.ndarray:
    """bool (n,): whether each value is None, NaN or empty text."""
    return np.array(
        [
            each is None or not str(each).strip() or (isinstance(each, float) and each != each)
            for each in values.tolist()
        ],
        bool,
    )
