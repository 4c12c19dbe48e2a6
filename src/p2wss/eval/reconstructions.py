"""Reconstructions: Parquet with the results of methods for buildings. The stage eval writes and reads it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from p2wss.data import polygon_arrays
from p2wss.data.building import Reconstruction
from p2wss.mesh import Mesh
from p2wss.skeleton.types import Polygons
from p2wss.storage import files
from p2wss.storage.schemas.columns import FOOTPRINT, FRAME, IDENTITY, MESH, STATUS, field

Key = tuple[str, str, str]
KEY_COLUMNS = ["dataset", "tile", "building_id"]
RECONSTRUCTIONS = pa.schema(
    [
        field("dataset", pa.string(), "simulated (the test split) or real"),
        *IDENTITY,
        field(
            "method",
            pa.string(),
            "point2wss, fit, lod1, constant or roofer; with the footprint hidden from the network: "
            "all_masked or all_masked_signs, then without a mesh",
        ),
        *STATUS,
        *FRAME,
        field("ground_z_m", pa.float64(), "z of height 0: the ground at the building as the cloud shows it"),
        *FOOTPRINT,
        field("eave_height_m", pa.float32(), "eave above ground_z_m; null for a method without one", True),
        field("angle_deg", pa.list_(pa.float32()), "one per edge; null for a method without angles", True),
        field("num_parts", pa.int32(), "bodies between which there are steps; 1 for the paper's model"),
        *MESH,
    ]
)


def reconstruction_columns(reconstructions: Sequence[Reconstruction], dataset: str) -> dict[str, Any]:
    """The columns of :data:`RECONSTRUCTIONS` of buildings of one data set."""
    rows = reconstructions
    return {
        "dataset": [dataset] * len(rows),
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
        "num_parts": [r.num_parts for r in rows],
        "vertex_xyz_m": [[] if r.mesh is None else r.mesh.vertex_m.ravel() for r in rows],
        "triangle": [[] if r.mesh is None else r.mesh.triangle.ravel() for r in rows],
        "triangle_kind": [[] if r.mesh is None else r.mesh.kind for r in rows],
        "triangle_edge": [[] if r.mesh is None else r.mesh.label for r in rows],
    }


def read_reconstructions(
    path: Path, keys: Collection[Key] | None = None
) -> dict[str, dict[Key, Reconstruction]]:
    """The reconstructions in a file by method, and by (dataset, tile, building id). keys: only these are read.

    Raises :class:`InputError` if the file is missing, broken or not a table of reconstructions.
    """
    table = (
        files.read_table(path, RECONSTRUCTIONS)
        if keys is None
        else files.read_rows(path, RECONSTRUCTIONS, KEY_COLUMNS, files.rows_with(KEY_COLUMNS, keys))
    )
    polygons = polygon_arrays.from_columns(table)
    by_method: defaultdict[str, dict[Key, Reconstruction]] = defaultdict(dict)
    for i, row in enumerate(table.to_pandas().itertuples()):
        vertex_m, triangle = row.vertex_xyz_m.reshape(-1, 3), row.triangle.reshape(-1, 3)
        mesh = Mesh(vertex_m, triangle, row.triangle_kind, row.triangle_edge) if len(triangle) else None
        by_method[row.method][row.dataset, row.tile, row.building_id] = Reconstruction(
            building_id=row.building_id,
            tile=row.tile,
            method=row.method,
            status=row.status,
            origin_xy_m=(row.origin_x_m, row.origin_y_m),
            ground_z_m=row.ground_z_m,
            rings=polygons.rings(i),
            eave_height_m=None if pd.isna(row.eave_height_m) else row.eave_height_m,
            angle_deg=None if row.angle_deg is None else row.angle_deg.astype(float),
            mesh=mesh,
            num_parts=row.num_parts,
        )
    return by_method
