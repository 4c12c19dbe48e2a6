"""Checks of tables after reading: types, missing values, lengths of lists, and implausible values."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from p2wss.errors import InputError

_COORDINATE_M, _HEIGHT_M, _LENGTH_M = (-1e8, 1e8), (-1e5, 1e5), (0.0, 1e5)
_SHARE, _COUNT = (0.0, 1.0), (0.0, 2e9)
# values outside these are of no building on Earth, so that the file must be damaged. NaN is within
_BOUNDS: Mapping[str, tuple[float, float]] = {
    "origin_x_m": _COORDINATE_M,
    "origin_y_m": _COORDINATE_M,
    "origin_z_m": _HEIGHT_M,
    "terrain_z_m": _HEIGHT_M,
    "base_z_m": _HEIGHT_M,
    "ground_z_m": _HEIGHT_M,
    "label_terrain_z_m": _HEIGHT_M,
    "eave_height_m": _HEIGHT_M,
    "footprint_xy_m": _COORDINATE_M,
    "vertex_xyz_m": _COORDINATE_M,
    "angle_deg": (-360.0, 360.0),
    "class_probability": (-1e-3, 1.001),
    "num_points": _COUNT,
    "num_vertices": _COUNT,
    "num_parts": _COUNT,
    "num_triangles": _COUNT,
    "num_mesh_vertices": _COUNT,
    "num_small_faces": _COUNT,
    "density_per_m2": (0.0, 1e6),
    "visible_roof_share": _SHARE,
    "confidence": _SHARE,
    "chamfer_m": _LENGTH_M,
    "roof_chamfer_m": _LENGTH_M,
    "points_to_mesh_m": _LENGTH_M,
    "far_share": _SHARE,
    "height_rmse_m": _LENGTH_M,
    "height_bias_m": _HEIGHT_M,
    "overshoot_m": _HEIGHT_M,
    "height_error_m": _LENGTH_M,
    "angle_error_deg": (0.0, 360.0),
    "right_share": _SHARE,
}
# a value of these that is not a number is no value
_FINITE = ("origin_x_m", "origin_y_m", "origin_z_m", "footprint_xy_m", "vertex_xyz_m")
# lists of a row that have the same length
_SAME_LENGTH = (("x_cm", "y_cm", "z_cm", "classification"), ("triangle_kind", "triangle_edge"))
_MULTIPLES = {"footprint_xy_m": 2, "vertex_xyz_m": 3, "triangle": 3, "class_probability": 3}
_MIN_RING = 3


def checked(table: pa.Table, schema: pa.Schema, path: str | Path) -> pa.Table:
    """The table with the types of ``schema``, of which it may have some columns only.

    Raises :class:`InputError` if a column is of another type, lacks a value that it must have or has one that no
    building has, or if lists that belong together have different lengths.
    """
    table = _typed(table, schema, path)
    for name in table.column_names:
        _check_values(table, name, path)
    for names in _SAME_LENGTH:
        present = [name for name in names if name in table.column_names]
        lengths = [_lengths(table, name) for name in present]
        if any(not np.array_equal(lengths[0], other) for other in lengths[1:]):
            raise _damaged(path, f"the lists of {' and '.join(present)} differ in length")
    for name, count in _MULTIPLES.items():
        if name in table.column_names and (_lengths(table, name) % count).any():
            raise _damaged(path, f"a list of {name} has a length that is no multiple of {count}")
    _check_rings(table, path)
    _check_triangles(table, path)
    return table


def _damaged(path: str | Path, reason: str) -> InputError:
    return InputError(f"{path}: damaged: {reason}; delete it and run the stage that writes it again")


def _typed(table: pa.Table, schema: pa.Schema, path: str | Path) -> pa.Table:
    fields = []
    for name in table.column_names:
        target, stored = schema.field(name), table.schema.field(name)
        if _kind(stored.type) != _kind(target.type):
            raise InputError(f"{path}: column {name} has values of type {stored.type}, not {target.type}")
        if not target.nullable and pa.types.is_floating(stored.type):
            # pandas writes NaN as null
            column = pc.fill_null(table[name], np.nan)
            table = table.set_column(table.column_names.index(name), name, column)
        elif not target.nullable and table[name].null_count:
            raise _damaged(path, f"column {name} lacks {table[name].null_count} values")
        fields.append(target)
    try:
        table.validate(full=True)
        return table.cast(pa.schema(fields, metadata=table.schema.metadata))
    except (pa.ArrowException, ValueError) as error:
        raise _damaged(path, " ".join(str(error).split())) from error


def _kind(kind: pa.DataType) -> str:
    """Types of the same kind differ in width only."""
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        return f"list of {_kind(kind.value_type)}"
    for name, test in (
        ("text", pa.types.is_string),
        ("text", pa.types.is_large_string),
        ("float", pa.types.is_floating),
        ("integer", pa.types.is_integer),
    ):
        if test(kind):
            return name
    return str(kind)


def _check_values(table: pa.Table, name: str, path: str | Path) -> None:
    column = table[name]
    if pa.types.is_list(column.type):
        column = pc.list_flatten(column)
        if column.null_count:
            raise _damaged(path, f"a list of {name} lacks values")
    if name not in _BOUNDS:
        return
    values = column.drop_null().to_numpy()
    low, high = _BOUNDS[name]
    outside = values[(values < low) | (values > high)]
    if len(outside):
        raise _damaged(path, f"column {name} has the value {outside[0]:g}")
    if name in _FINITE and np.isnan(values).any():
        raise _damaged(path, f"column {name} has a value that is not a number")


def _lengths(table: pa.Table, name: str) -> np.ndarray:
    return pc.fill_null(pc.list_value_length(table[name]), 0).to_numpy().astype(np.int64)


def _check_rings(table: pa.Table, path: str | Path) -> None:
    """The offsets of each row begin with 0, end with its number of vertices, and no ring has fewer than three."""
    if not {"footprint_xy_m", "ring_offset"} <= set(table.column_names):
        return
    lengths = _lengths(table, "ring_offset")
    offset = pc.list_flatten(table["ring_offset"]).to_numpy()
    end = np.cumsum(lengths)
    has_offsets = lengths > 0
    num_vertices = np.zeros(len(table), np.int64)
    num_vertices[has_offsets] = offset[end[has_offsets] - 1]
    begins = offset[(end - lengths)[has_offsets]]
    within = np.ones(max(len(offset) - 1, 0), bool)
    within[end[(end > 0) & (end < len(offset))] - 1] = False  # from one row to the next
    if (
        (begins != 0).any()
        or (2 * num_vertices != _lengths(table, "footprint_xy_m")).any()
        or (np.diff(offset)[within] < _MIN_RING).any()
    ):
        raise _damaged(path, "ring_offset does not belong to footprint_xy_m")
    if "angle_deg" in table.column_names:
        num_angles = _lengths(table, "angle_deg")
        if ((num_angles != 0) & (num_angles != num_vertices)).any():
            raise _damaged(path, "angle_deg does not belong to footprint_xy_m")


def _check_triangles(table: pa.Table, path: str | Path) -> None:
    if not {"vertex_xyz_m", "triangle"} <= set(table.column_names):
        return
    lengths = _lengths(table, "triangle")
    if "triangle_kind" in table.column_names and (3 * _lengths(table, "triangle_kind") != lengths).any():
        raise _damaged(path, "the lists of triangle and triangle_kind differ in length")
    index = pc.list_flatten(table["triangle"]).to_numpy()
    num_vertices = np.repeat(_lengths(table, "vertex_xyz_m") // 3, lengths)
    if ((index < 0) | (index >= num_vertices)).any():
        raise _damaged(path, "a triangle has a vertex that is not there")
