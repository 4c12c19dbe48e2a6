"""Read and write files. Writing is atomic: a file is complete or absent. Reading verifies checksums: see
:mod:`p2wss.storage.integrity`.

Every Parquet file has a JSON object under the metadata key ``p2wss`` with its provenance (version, config
sections, code fingerprint, CRS, counts).
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from p2wss import __version__
from p2wss.storage import integrity
from p2wss.storage.messages import InputError, log, reading, writing
from p2wss.storage.temporary import remove_leftovers, temporary_prefix

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

# GDAL writes the time of the last change into GeoPackages: the same content would have other bytes in every run
GPKG_DATE = "1970-01-01T00:00:00.000Z"
METADATA_KEY = b"p2wss"
_CHECKSUM_KEY = b"p2wss.checksum"
_JSON_CHECKSUM = "checksum"
# number of rows that are compressed and read together
ROW_GROUP_SIZE = 512


def provenance(**facts: Any) -> dict[str, Any]:
    """Metadata for a file: the version of the package and ``facts`` (config, code, crs, ..)."""
    return {"version": __version__, **facts}


@contextmanager
def gdal_options(**options: str) -> Iterator[None]:
    """Set options of GDAL, and :data:`GPKG_DATE` for GeoPackages, within the block only: other code in this process
    uses GDAL."""
    import pyogrio

    options = {"OGR_CURRENT_DATE": GPKG_DATE, **options}
    before = {name: pyogrio.get_gdal_config_option(name) for name in options}
    pyogrio.set_gdal_config_options(options)
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options(before)


@contextmanager
def atomic(path: str | Path, seal: bool = False) -> Iterator[Path]:
    """A temporary path beside ``path``. It is renamed to ``path`` if the block succeeds, and deleted otherwise.

    It has the suffix of ``path``, from which GDAL and laspy infer the format. A slot for a checksum
    (:mod:`p2wss.storage.integrity`) is filled. seal: add such a slot as the last line. A full disk or any other
    ``OSError`` inside the block is raised as an :class:`InputError` that names ``path``. Temporary files that killed
    processes left in the folder are removed.
    """
    path = Path(path)
    suffix = "".join(path.suffixes)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path.parent)
        prefix = temporary_prefix(path.name.removesuffix(suffix))
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            if seal:
                integrity.append(temporary)
            integrity.fill(temporary)
            with open(temporary, "rb") as file:
                os.fsync(file.fileno())
            temporary.chmod(0o644)
            temporary.replace(path)
            log.debug("%s: written, %d bytes", path, Path(path).stat().st_size)
        finally:
            temporary.unlink(missing_ok=True)


def write_table(
    path: str | Path, columns: dict[str, Any], schema: pa.Schema, metadata: dict[str, Any]
) -> None:
    """Write ``columns`` as Parquet (zstd) with the types of ``schema``; ``metadata`` is stored as JSON."""
    with table_writer(path, schema) as writer:
        writer.append(columns)
        writer.metadata = metadata


class TableWriter:
    """An open Parquet file, see :func:`table_writer`. ``metadata`` is stored as JSON at the end."""

    def __init__(self, writer: pq.ParquetWriter) -> None:
        self._writer = writer
        self.metadata: Mapping[str, Any] = {}

    def append(self, columns: Mapping[str, Any]) -> None:
        """Write rows, one array or list of values per column of the schema."""
        import pyarrow as pa

        schema = self._writer.schema
        # an array without values may have any type, for instance that of a tile without buildings
        arrays = {
            field.name: pa.array(columns[field.name] if len(columns[field.name]) else [], type=field.type)
            for field in schema
        }
        self.append_table(pa.table(arrays, schema=schema))

    def append_table(self, table: pa.Table) -> None:
        """Write rows of the schema."""
        self._writer.write_table(table, row_group_size=ROW_GROUP_SIZE)


@contextmanager
def table_writer(path: str | Path, schema: pa.Schema) -> Iterator[TableWriter]:
    """Write Parquet (zstd) piece by piece: only one piece is in memory. The file appears at the end of the block."""
    import pyarrow.parquet as pq  # as large as a cloud, and needed for few files

    with (
        atomic(path) as temporary,
        pq.ParquetWriter(
            temporary, schema, compression="zstd", compression_level=3, write_page_checksum=True
        ) as writer,
    ):
        table = TableWriter(writer)
        yield table
        writer.add_key_value_metadata({METADATA_KEY: json.dumps(table.metadata).encode()})
        writer.add_key_value_metadata({_CHECKSUM_KEY: integrity.SLOT.encode()})


def read_table(path: str | Path, schema: pa.Schema, columns: list[str] | None = None) -> pa.Table:
    """Read the columns of ``schema`` from a Parquet file. columns: read only these.

    Raises :class:`InputError` if the file is missing, broken or damaged, or lacks one of the columns.
    """
    names = columns or schema.names
    with _readable(path) as file:
        _check_columns(path, file, names)
        table = file.read(columns=names)
    return _typed(table, schema, path)


def read_rows(
    path: str | Path, schema: pa.Schema, columns: list[str], select: Callable[[pa.Table], np.ndarray]
) -> pa.Table:
    """Selected rows of a Parquet file, with all columns of ``schema``. Row groups without a selected row are not read
    whole.

    select: a function from a table of ``columns`` with n rows to a mask, bool (n,). Raises :class:`InputError` as
    :func:`read_table` does.
    """
    import pyarrow as pa

    pieces = [schema.empty_table()]
    with _readable(path) as file:
        _check_columns(path, file, schema.names)
        for i in range(file.num_row_groups):
            mask = select(file.read_row_group(i, columns=columns))
            if mask.any():
                pieces.append(file.read_row_group(i, columns=schema.names).filter(pa.array(mask)))
        table = pa.concat_tables(pieces, promote_options="permissive").combine_chunks()
    return _typed(table, schema, path)


def rows_with(columns: list[str], keys: Collection[tuple[str, ...]]) -> Callable[[pa.Table], np.ndarray]:
    """A function from a table to the mask, bool (n,), of the rows whose values of ``columns`` are in ``keys``."""
    selection = set(keys)

    def select(table: pa.Table) -> np.ndarray:
        rows = zip(*(table[name].to_pylist() for name in columns), strict=True)
        return np.array([row in selection for row in rows], bool)

    return select


def _check_columns(path: str | Path, file: pq.ParquetFile, names: list[str]) -> None:
    missing = [name for name in names if name not in file.schema_arrow.names]
    if missing:
        raise InputError(
            f"{path}: has no columns {', '.join(missing)}; was it written by another version of p2wss?"
        )


def _typed(table: pa.Table, schema: pa.Schema, path: str | Path) -> pa.Table:
    """The table with the types of ``schema``. It may have only some of the columns of ``schema``."""
    import pyarrow as pa
    import pyarrow.compute as pc

    fields = [schema.field(name) for name in table.column_names]
    with reading(path, "a table with the types that are expected"):
        table = table.cast(pa.schema([field.with_nullable(True) for field in fields], table.schema.metadata))
        for place, field in enumerate(fields):
            column = table[field.name]
            if pa.types.is_floating(field.type) and not field.nullable:
                column = pc.fill_null(column, np.nan)  # pandas writes NaN as null
            if column.null_count and not field.nullable:
                raise ValueError(f"column {field.name} lacks {column.null_count} values")
            table = table.set_column(place, field, column)
    return table


@contextmanager
def _readable(path: str | Path) -> Iterator[pq.ParquetFile]:
    import pyarrow.parquet as pq

    integrity.verify(path)
    with (
        reading(path, "a readable Parquet file"),
        pq.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        yield file


def write_geoparquet(
    path: str | Path, frame: Any, metadata: dict[str, Any], schema: pa.Schema | None = None
) -> None:
    """Write a GeoDataFrame as GeoParquet (zstd); ``metadata`` is stored as JSON.

    schema: the types of its columns, which an empty frame does not show.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    # a buffer of Python aborts the process if threads of Arrow let go of it while Python ends (apache/arrow#34314)
    buffer = pa.BufferOutputStream()
    frame.to_parquet(buffer)
    table = pq.read_table(pa.BufferReader(buffer.getvalue()))
    if schema is not None and not table.num_rows:
        for field in schema:
            table = table.set_column(table.column_names.index(field.name), field, pa.array([], field.type))
    with table_writer(path, table.schema) as writer:
        writer.append_table(table)
        writer.metadata = metadata


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The metadata of a Parquet file that p2wss wrote.

    Raises :class:`InputError` if the file has none. The result raises it, too, for a key that it lacks.
    """
    with _readable(path) as file:
        stored = (file.metadata.metadata or {}).get(METADATA_KEY)
        if stored is None:
            raise InputError(f"{path}: not written by p2wss: it has no metadata with the key p2wss")
        facts = _Facts(json.loads(stored))
    facts.path = path
    return facts


class _Facts(dict[str, Any]):
    """The metadata of a file."""

    path: str | Path = ""

    def __missing__(self, name: str) -> Any:
        raise InputError(
            f"{self.path}: its metadata lacks {name}; was it written by another version of p2wss?"
        )


def write_json(path: str | Path, value: dict[str, Any]) -> None:
    """Write ``value`` as indented JSON with a first key ``checksum``, see :mod:`p2wss.storage.integrity`."""
    # a checksum that the value has brought from another file is no longer true
    value = {name: each for name, each in value.items() if name != _JSON_CHECKSUM}
    text = json.dumps(value, indent=1, sort_keys=True) + "\n"
    stated = f'{{\n "{_JSON_CHECKSUM}": "{integrity.SLOT}"'
    write_text(path, stated + (f",{text[1:]}" if value else "\n}\n"))


def check_stem(name: str) -> None:
    """Raise :class:`InputError` if the name for files also states a folder."""
    if name != Path(name).name or name == "..":
        raise InputError(f"name {name}: must be that of a file without ending, and no folder")


def check_folder(folder: Path, endings: Iterable[str]) -> None:
    """Raise :class:`InputError` for a folder that is a file or lies in one, or that does not exist and has the ending
    of one of the files to be written in it."""
    if folder.name.lower().endswith(tuple(endings)) and not folder.exists():
        raise InputError(
            f"{folder}: results are several files; name a folder; --name, name= in Python, is of the files"
        )
    if not (above := existing_folder(folder)).is_dir():
        raise InputError(f"{folder}: not written: {above} is a file; name a folder for the outputs")


def existing_folder(out: Path) -> Path:
    """``out``, or the nearest folder above it that exists."""
    while not os.path.lexists(out):
        out = out.parent
    return out


def write_text(path: str | Path, text: str | Iterable[str]) -> None:
    """Write a text file. text: the text, or pieces that follow each other."""
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines([text] if isinstance(text, str) else text)


def write_bytes(path: str | Path, content: bytes | memoryview, seal: bool = False) -> None:
    """Write a binary file. seal: with its checksum as the last line."""
    with atomic(path, seal) as temporary:
        temporary.write_bytes(content)


def read_json(path: str | Path, kind: Any = Any, name: str = "what p2wss writes") -> Any:
    """The value in a JSON file, without its checksum.

    kind: the type that it must have, as pydantic understands it, such as a dataclass or ``dict[str, float]``. name:
    what messages call such a file. Raises :class:`InputError` if it is missing, not JSON or of another type.
    """
    integrity.verify(path)
    with reading(path, "JSON"):
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    if isinstance(value, dict):
        value.pop(_JSON_CHECKSUM, None)
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(f"{path}: not {name}: {key + ': ' if key else ''}{first['msg']}") from error


def sha256(path: str | Path) -> str:
    """The SHA-256 checksum of a file, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def list_column(table: pa.Table, name: str) -> tuple[np.ndarray, np.ndarray]:
    """A list column as (values, offsets): row i is ``values[offsets[i]:offsets[i + 1]]``; a null row is empty."""
    column = table.column(name).combine_chunks()
    lengths = np.nan_to_num(column.value_lengths().to_numpy(zero_copy_only=False)).astype(np.int64)
    return column.flatten().to_numpy(zero_copy_only=False), np.concatenate([[0], np.cumsum(lengths)])


def ragged(values: np.ndarray, offsets: np.ndarray) -> pa.ListArray:
    """The inverse of :func:`list_column`: a list array with the slices of ``values`` between ``offsets``."""
    import pyarrow as pa

    return pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), pa.array(values))
