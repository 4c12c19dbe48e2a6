"""The files of a source ``folder``, and which of them may overlap a tile.

The rules use this too, so that a replaced file reruns everything that depends on it. It runs at every start of
Snakemake, so it uses only the standard library and reads at most the header of a file.
"""

import struct
from glob import glob
from pathlib import Path

from p2wss.data.tiling import Bounds, are_near
from p2wss.storage.messages import InputError

VECTOR = (".gpkg", ".shp", ".parquet", ".geojson", ".fgb")
RASTER = (".asc", ".tif", ".tiff", ".vrt")
CLOUD = (".laz", ".las")
# position of max x, min x, max y, min y in the public header block of LAS 1.0 to 1.4
_LAS_EXTENT = struct.Struct("<4d")
_LAS_EXTENT_AT = 179
_MAX_ASC_HEADER_BYTES = 512


def list_files(location: str, suffixes: tuple[str, ...], key: str) -> list[Path]:
    """The files at a path, in a folder and its subfolders, or that match a pattern, sorted by path.

    key: the config key of ``location``, used in messages. Raises :class:`InputError` if there is none.
    """
    path = Path(location)
    if path.is_dir():
        paths = [file for file in path.rglob("*") if file.name.lower().endswith(suffixes) and file.is_file()]
    else:
        paths = [Path(name) for name in glob(location, recursive=True) if Path(name).is_file()]
    if not paths:
        raise InputError(
            f"{key}: {location}: no such file, and no folder or pattern with files {', '.join(suffixes)};"
            " unpack archives first, such as .7z by 7z x"
        )
    return sorted(paths)


def with_companions(path: Path) -> list[Path]:
    """A file and its companions: the .dbf, .shx, .prj and .cpg of a shapefile.

    >>> with_companions(Path("nowhere/a.gpkg"))
    [PosixPath('nowhere/a.gpkg')]
    """
    suffixes = (".cpg", ".dbf", ".prj", ".shx") if path.suffix.lower() == ".shp" else ()
    return [path, *filter(Path.is_file, map(path.with_suffix, suffixes))]


def extent_m(path: Path) -> Bounds | None:
    """(x_min, y_min, x_max, y_max) as the header of a LAS, LAZ or .asc file states it; None if it states none, for
    other formats, and for damaged files."""
    try:
        with path.open("rb") as file:
            head = file.read(_MAX_ASC_HEADER_BYTES)
    except OSError:
        return None
    if head.startswith(b"LASF") and len(head) >= _LAS_EXTENT_AT + _LAS_EXTENT.size:
        x_max, x_min, y_max, y_min = _LAS_EXTENT.unpack_from(head, _LAS_EXTENT_AT)
        return (x_min, y_min, x_max, y_max) if x_max > x_min and y_max > y_min else None
    if path.suffix.lower() == ".asc":
        return _asc_extent_m(head)
    return None


def _asc_extent_m(head: bytes) -> Bounds | None:
    words = head.decode("latin-1").lower().split()[:12]
    try:
        value = {words[i]: float(words[i + 1]) for i in range(0, len(words) - 1, 2) if words[i][0].isalpha()}
        cell, columns, rows = value["cellsize"], value["ncols"], value["nrows"]
        x = value["xllcorner"] if "xllcorner" in value else value["xllcenter"] - cell / 2
        y = value["yllcorner"] if "yllcorner" in value else value["yllcenter"] - cell / 2
    except (KeyError, ValueError):
        return None
    return x, y, x + columns * cell, y + rows * cell


def may_overlap(extent: Bounds | None, bounds: Bounds) -> bool:
    """Whether a file with this :func:`extent_m` may have data in ``bounds``; a file without a stated extent may."""
    return extent is None or are_near(extent, bounds, 0.0)
