"""The files that stages hand to each other: their columns, and how they are written whole or not at all.

Every Parquet file carries, under the metadata key ``p2wss``, a JSON object with what made it (config section,
code fingerprint, version, CRS, counts). A column's meaning and unit are in its field's metadata, so
``pyarrow.parquet.read_schema(path)`` is the documentation.

Frames. ``*_xy_m`` and ``vertex_xyz_m`` are flattened (x0, y0, x1, y1, ...) and relative to
(origin_x_m, origin_y_m) in the projected CRS of the file. Mesh heights are relative to ``ground_z_m``.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from p2wss import __version__
from p2wss.errors import InputError

METADATA_KEY = b"p2wss"


def _field(name: str, kind: pa.DataType, about: str, nullable: bool = False) -> pa.Field:
    return pa.field(name, kind, nullable=nullable, metadata={"about": about})


_IDENTITY = [
    _field(
        "building_id",
        pa.string(),
        "cleabs of BD TOPO or the user's own id; parts of a multipolygon end in -1, -2, ..",
    ),
    _field("tile", pa.string(), "name of the tile, its north-west corner"),
]
_FRAME = [
    _field("origin_x_m", pa.float64(), "x of the local origin in the CRS of the file"),
    _field("origin_y_m", pa.float64(), "y of the local origin in the CRS of the file"),
]
_FOOTPRINT = [
    _field(
        "footprint_xy_m",
        pa.list_(pa.float64()),
        "vertices of all rings, exterior (CCW) first, x and y in turn, local",
    ),
    _field("ring_offset", pa.list_(pa.int32()), "ring r owns vertices ring_offset[r] to ring_offset[r + 1]"),
]
_STATUS = [
    _field("status", pa.string(), "'ok', or why the building was left out"),
]
_MESH = [
    _field(
        "vertex_xyz_m",
        pa.list_(pa.float64()),
        "mesh vertices, local x and y, z above ground_z_m; empty if rejected",
    ),
    _field(
        "triangle", pa.list_(pa.int32()), "three vertex indices per triangle, counter-clockwise from outside"
    ),
    _field("triangle_kind", pa.list_(pa.uint8()), "per triangle: 0 ground, 1 wall, 2 roof, 3 flat"),
    _field(
        "triangle_edge",
        pa.list_(pa.int32()),
        "per triangle: the footprint edge it grows from, or -1; of several parts and of Roofer: its polygon",
    ),
]

# Scenes are GeoParquet: these columns and a `geometry` of cleaned polygons (exterior CCW, courtyards CW, 2D).
SCENE = pa.schema(
    [
        *_IDENTITY,
        _field("in_tile", pa.bool_(), "false for a building of the margin, which only casts shadows"),
        *_STATUS,
        _field("eave_height_m", pa.float32(), "gutter above ground_z_m"),
        _field("eave_height_source", pa.string(), "'hauteur', or the fallback that gave the height"),
        _field("ground_z_m", pa.float64(), "median height of the DTM along the footprint"),
        _field("base_z_m", pa.float64(), "lowest height of the DTM along the footprint, where the walls end"),
        _field(
            "roof_type",
            pa.string(),
            "what the sampler drew: gable, hip, half-hip, shed, flat, mixed, uniform",
        ),
        _field("angle_deg", pa.list_(pa.float32()), "one per edge over all rings; edge i starts at vertex i"),
    ]
)

BUILDINGS = pa.schema(
    [
        *_IDENTITY,
        _field("in_tile", pa.bool_(), "false for a building of the margin"),
        *_STATUS,
        _field("eave_height_m", pa.float32(), "gutter above ground_z_m"),
        _field("ground_z_m", pa.float64(), "z of height 0"),
        _field("base_z_m", pa.float64(), "z of the mesh's ground face"),
        _field("roof_type", pa.string(), "as drawn by the scene's sampler"),
        _field("angle_deg", pa.list_(pa.float32()), "one per edge over all rings"),
        *_FRAME,
        *_FOOTPRINT,
        *_MESH,
    ]
)

CROPS = pa.schema(
    [
        *_IDENTITY,
        _field(
            "split",
            pa.string(),
            "train, val, test, guard (too near another split: unused) or none (real LiDAR)",
        ),
        _field("num_points", pa.int32(), "points within the buffer"),
        *_FRAME,
        _field(
            "origin_z_m",
            pa.float64(),
            "z of z_cm = 0; chosen from the points alone, so it tells nothing of the labels",
        ),
        _field("x_cm", pa.list_(pa.int16()), "point x - origin_x_m, centimetres"),
        _field("y_cm", pa.list_(pa.int16()), "point y - origin_y_m, centimetres"),
        _field("z_cm", pa.list_(pa.int16()), "point z - origin_z_m, centimetres"),
        _field("classification", pa.list_(pa.uint8()), "LAS class per point: 2 ground, 6 building, .."),
        *_FOOTPRINT,
        _field(
            "ground_z_m", pa.float64(), "ground at the building estimated from the cloud, NaN if it has none"
        ),
        _field(
            "eave_height_m", pa.float32(), "label: gutter above label_ground_z_m; null for real LiDAR", True
        ),
        _field("label_ground_z_m", pa.float64(), "label: z of height 0; null for real LiDAR", True),
        _field("angle_deg", pa.list_(pa.float32()), "label: one per edge; null for real LiDAR", True),
        _field("roof_type", pa.string(), "label; null for real LiDAR", True),
        _field(
            "num_roof_points",
            pa.int32(),
            "points on this building's roof (real LiDAR: class 6 inside, else all inside but ground)",
        ),
        _field("num_wall_points", pa.int32(), "points on this building's walls; null for real LiDAR", True),
        _field(
            "num_walls_seen",
            pa.int32(),
            "footprint edges whose walls have 10 points or more; null for real LiDAR",
            True,
        ),
        _field("num_strips", pa.int32(), "flight lines that the points come from"),
        _field("visible_roof_share", pa.float32(), "share of the roof's 1 m cells that have a point"),
        _field("is_truncated", pa.bool_(), "more points than crops.max_points: networks see a part of them"),
    ]
)

RECONSTRUCTIONS = pa.schema(
    [
        _field("dataset", pa.string(), "synthetic (the test split) or lidar"),
        *_IDENTITY,
        _field("method", pa.string(), "point2wss, point2wss+fit, fit, lod1, constant or roofer"),
        *_STATUS,
        *_FRAME,
        _field("ground_z_m", pa.float64(), "z of height 0"),
        *_FOOTPRINT,
        _field("eave_height_m", pa.float32(), "gutter above ground_z_m; null for a method without one", True),
        _field("angle_deg", pa.list_(pa.float32()), "one per edge; null for a method without", True),
        _field(
            "class_probability",
            pa.list_(pa.float32()),
            "of a network, per edge three: of 0 degrees, of 90 degrees, of a slope; else null",
            True,
        ),
        _field(
            "confidence",
            pa.float32(),
            "probability of the decoded values, mean over height and angles; null where unknown",
            True,
        ),
        _field("num_parts", pa.int32(), "parts with a height each; 1 for the paper's model"),
        *_MESH,
    ]
)

MEASURES = pa.schema(
    [
        _field("dataset", pa.string(), "synthetic (the test split) or lidar"),
        *_IDENTITY,
        _field("method", pa.string(), "point2wss, point2wss+fit, fit, lod1, constant or roofer"),
        _field("status", pa.string(), "of the reconstruction: 'ok', or why there is no mesh"),
        _field("num_points", pa.int32(), "points of the building's cloud"),
        _field("num_vertices", pa.int32(), "vertices of the building's footprint, all rings"),
        _field("density_per_m2", pa.float32(), "points inside the footprint, per m2 of it"),
        _field("roof_type", pa.string(), "label; null for real LiDAR", True),
        _field(
            "roof_kind", pa.string(), "by the angles of this reconstruction; null where it has none", True
        ),
        _field("visible_roof_share", pa.float32(), "as in the crop"),
        _field("confidence", pa.float32(), "expected share of right numbers; null where unknown", True),
        _field(
            "num_parts", pa.int32(), "of the reconstruction, with a height each; null without a mesh", True
        ),
        _field("num_triangles", pa.int32(), "of the whole mesh, ground included; null without a mesh", True),
        _field("num_mesh_vertices", pa.int32(), "different ones of the mesh; null without a mesh", True),
        _field("watertight", pa.bool_(), "every edge has two triangles; null without a mesh", True),
        _field("oriented", pa.bool_(), "and they agree on the outside; null without a mesh", True),
        _field(
            "manifold",
            pa.bool_(),
            "watertight, oriented, and the triangles at each vertex form one fan; null without a mesh",
            True,
        ),
        _field(
            "planar",
            pa.bool_(),
            "every face's vertices lie within 1 cm of one plane; null without a mesh",
            True,
        ),
        _field(
            "num_small_faces", pa.int32(), "roof faces and walls below 0.25 m2; null without a mesh", True
        ),
        _field("chamfer_m", pa.float32(), "CD of the paper: cloud against the whole mesh", True),
        _field(
            "roof_chamfer_m",
            pa.float32(),
            "CD of the points on the building against roof faces only; null with fewer than 10 such points",
            True,
        ),
        _field("points_to_mesh_m", pa.float32(), "mean distance of those points to the mesh", True),
        _field("far_share", pa.float32(), "share of those points more than 0.5 m from the mesh", True),
        _field(
            "height_rmse_m",
            pa.float32(),
            "root mean square of the heights over the roof of those 0.5 m or more inside the footprint",
            True,
        ),
        _field("height_bias_m", pa.float32(), "median of the same heights: positive = roof too low", True),
        _field(
            "overshoot_m",
            pa.float32(),
            "highest point of the mesh above the highest of those points, negative below it",
            True,
        ),
        _field("height_error_m", pa.float32(), "absolute error of the eave's z; null without label", True),
        _field(
            "angle_error_deg", pa.float32(), "mean absolute error over the edges; null without label", True
        ),
        _field(
            "right_share",
            pa.float32(),
            "share of the height and the angles within 0.5 m and 5 degrees; null without label",
            True,
        ),
    ]
)


def provenance(**facts: Any) -> dict[str, Any]:
    """Metadata for a result: the package's version and ``facts`` (config, code, crs, ..)."""
    return {"version": __version__, **facts}


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """A temporary name beside ``path`` that becomes ``path`` when the block ends well and vanishes otherwise.

    The suffix is kept, because GDAL and laspy choose the format by it. A full disk or any other ``OSError``
    inside the block becomes an :class:`InputError` that names ``path``.
    """
    path = Path(path)
    suffix = "".join(path.suffixes)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{path.name.removesuffix(suffix)}-", suffix=suffix, dir=path.parent
        )
    except OSError as error:
        raise InputError(f"{path}: not written: {error.strerror or error}") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{path}: not written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_table(
    path: str | Path, columns: dict[str, Any], schema: pa.Schema, metadata: dict[str, Any]
) -> None:
    """Write columns as Parquet (zstd) with ``metadata`` under the key ``p2wss``."""
    table = pa.table(
        {field.name: pa.array(columns[field.name], type=field.type) for field in schema},
        schema=schema.with_metadata({METADATA_KEY: json.dumps(metadata).encode()}),
    )
    with atomic(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", compression_level=3, row_group_size=512)


def read_table(path: str | Path, schema: pa.Schema, columns: list[str] | None = None) -> pa.Table:
    """Read a Parquet file that has the columns of ``schema`` (all, or those named).

    Raises :class:`InputError` if it is missing, broken or of another kind.
    """
    wanted = columns or schema.names
    try:
        missing = [name for name in wanted if name not in pq.read_schema(path).names]
        table = pq.read_table(path, columns=[name for name in wanted if name not in missing])
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (pa.ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a readable Parquet file: {reason}") from error
    if missing:
        raise InputError(
            f"{path}: columns {', '.join(missing)} are missing; was it written by another version?"
        )
    return table


def read_scene(path: str | Path) -> tuple[Any, dict[str, Any]]:
    """A scene as (GeoDataFrame with the columns of ``SCENE`` and a geometry, metadata)."""
    import geopandas as gpd

    read_table(path, SCENE, columns=["building_id"])  # a clear error for what is no scene
    return gpd.read_parquet(path), read_metadata(path)


def write_scene(path: str | Path, scene: Any, metadata: dict[str, Any]) -> None:
    """Write a GeoDataFrame with the columns of ``SCENE`` and a geometry as GeoParquet with ``metadata``."""
    write_geoparquet(path, scene[[*SCENE.names, scene.geometry.name]], metadata)


def write_geoparquet(path: str | Path, frame: Any, metadata: dict[str, Any]) -> None:
    """Write a GeoDataFrame as GeoParquet (zstd) with ``metadata`` under the key ``p2wss``."""
    with atomic(path) as temporary:
        frame.to_parquet(temporary, compression="zstd")
        table = pq.read_table(temporary)
        own = {METADATA_KEY: json.dumps(metadata).encode()}
        pq.write_table(
            table.replace_schema_metadata(table.schema.metadata | own), temporary, compression="zstd"
        )


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The JSON object that :func:`write_table` stored."""
    found = (pq.read_schema(path).metadata or {}).get(METADATA_KEY)
    if found is None:
        raise InputError(f"{path}: not a file of p2wss: it has no metadata named p2wss")
    return json.loads(found)


def write_json(path: str | Path, value: Any) -> None:
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, sort_keys=True) + "\n")


def write_text(path: str | Path, text: str) -> None:
    with atomic(path) as temporary:
        temporary.write_text(text)


def write_bytes(path: str | Path, content: bytes) -> None:
    with atomic(path) as temporary:
        temporary.write_bytes(content)


def read_json(path: str | Path) -> Any:
    try:
        return json.loads(Path(path).read_text())
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: not JSON: {error}") from error


def sha256(path: str | Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def list_column(table: pa.Table, name: str) -> tuple[np.ndarray, np.ndarray]:
    """A list column as (values, offsets): row i owns ``values[offsets[i]:offsets[i + 1]]``; a null row is empty."""
    column = table.column(name).combine_chunks()
    lengths = np.nan_to_num(column.value_lengths().to_numpy(zero_copy_only=False)).astype(np.int64)
    return column.flatten().to_numpy(zero_copy_only=False), np.concatenate([[0], np.cumsum(lengths)])


def ragged(values: np.ndarray, offsets: np.ndarray) -> pa.ListArray:
    """The inverse of :func:`list_column`: a list array that owns ``values`` cut at ``offsets``."""
    return pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), pa.array(values))
