"""Reconstructions: Parquet of the result of one method for each building.

Written and read by the stage eval.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from p2wss.data import polygon_arrays
from p2wss.data.building import Reconstruction
from p2wss.mesh import Mesh
from p2wss.skeleton.types import Polygons
from p2wss.storage import files
from p2wss.storage.schemas.columns import FOOTPRINT, FRAME, IDENTITY, MESH, STATUS, field

RECONSTRUCTIONS = pa.schema(
    [
        field("dataset", pa.string(), "simulated (the test split) or real"),
        *IDENTITY,
        field("method", pa.string(), "point2wss, point2wss+fit, fit, lod1, constant or roofer"),
        *STATUS,
        *FRAME,
        field("ground_z_m", pa.float64(), "z of height 0: the ground at the building as the cloud shows it"),
        *FOOTPRINT,
        field("eave_height_m", pa.float32(), "eave above ground_z_m; null for a method without one", True),
        field("angle_deg", pa.list_(pa.float32()), "one per edge; null for a method without angles", True),
        field(
            "class_probability",
            pa.list_(pa.float32()),
            "per edge the network's probabilities of 0 degrees, 90 degrees and a slope; null without a network",
            True,
        ),
        field(
            "confidence",
            pa.float32(),
            "probability of the decoded values, mean over height and angles; null if unknown",
            True,
        ),
        field("num_parts", pa.int32(), "parts with their own eave height; 1 for the paper's model"),
        *MESH,
    ]
)


def reconstruction_columns(
    reconstructions: Sequence[Reconstruction], dataset: str | Sequence[str]
) -> dict[str, Any]:
    """The columns of :data:`RECONSTRUCTIONS`. dataset: of all rows, or one per row."""
    rows = reconstructions
    names = [dataset] * len(rows) if isinstance(dataset, str) else list(dataset)
    return {
        "dataset": names,
        "building_id": [r.building_id for r in rows],
        "tile": [r.tile for r in rows],
        "method": [r.method for r in rows],
        "status": [r.status for r in rows],
        "origin_x_m": [r.origin_xy_m[0] for r in rows],
        "origin_y_m": [r.origin_xy_m[1] for r in rows],
        "ground_z_m": [r.ground_z_m for r in rows],
        **polygon_arrays.to_columns(
            Polygons.from_rings([list(r.rings) for r in rows]), np.zeros((len(rows), 2))
        ),
        "eave_height_m": [r.eave_height_m for r in rows],
        "angle_deg": [r.angle_deg for r in rows],
        "class_probability": [
            None if r.class_probability is None else r.class_probability.ravel() for r in rows
        ],
        "confidence": [r.confidence for r in rows],
        "num_parts": [r.num_parts for r in rows],
        "vertex_xyz_m": [[] if r.mesh is None else r.mesh.vertex_m.ravel() for r in rows],
        "triangle": [[] if r.mesh is None else r.mesh.triangle.ravel() for r in rows],
        "triangle_kind": [[] if r.mesh is None else r.mesh.kind for r in rows],
        "triangle_edge": [[] if r.mesh is None else r.mesh.label for r in rows],
    }


def read_reconstructions(
    path: Path, keys: Collection[tuple[str, str, str]] | None = None
) -> dict[tuple[str, str, str], Reconstruction]:
    """The reconstructions in a file by (dataset, tile, building id). keys: only these are read.

    Raises :class:`InputError` if the file is missing, broken or not a table of reconstructions.
    """
    if keys is None:
        table = files.read_table(path, RECONSTRUCTIONS)
    else:
        columns = ["dataset", "tile", "building_id"]
        table = files.read_rows(path, RECONSTRUCTIONS, columns, files.rows_with(columns, keys))
    polygons = polygon_arrays.from_columns(table)
    lists = {
        name: files.list_column(table, name)
        for name in (
            "angle_deg",
            "class_probability",
            "vertex_xyz_m",
            "triangle",
            "triangle_kind",
            "triangle_edge",
        )
    }

    def values_of(name: str, i: int) -> np.ndarray:
        values, offset = lists[name]
        return values[offset[i] : offset[i + 1]]

    plain = table.select(
        [
            "dataset",
            "building_id",
            "tile",
            "method",
            "status",
            "origin_x_m",
            "origin_y_m",
            "ground_z_m",
            "eave_height_m",
            "confidence",
            "num_parts",
        ]
    ).to_pylist()
    return {
        (row["dataset"], row["tile"], row["building_id"]): Reconstruction(
            row["building_id"],
            row["tile"],
            row["method"],
            row["status"],
            (row["origin_x_m"], row["origin_y_m"]),
            row["ground_z_m"],
            polygons.rings(i),
            row["eave_height_m"],
            values_of("angle_deg", i).astype(float) if len(values_of("angle_deg", i)) else None,
            row["confidence"],
            Mesh(
                values_of("vertex_xyz_m", i).reshape(-1, 3),
                values_of("triangle", i).reshape(-1, 3),
                values_of("triangle_kind", i),
                values_of("triangle_edge", i),
            )
            if len(values_of("triangle", i))
            else None,
            row["num_parts"],
            probability.reshape(-1, 3).astype(float)
            if len(probability := values_of("class_probability", i))
            else None,
        )
        for i, row in enumerate(plain)
    }
