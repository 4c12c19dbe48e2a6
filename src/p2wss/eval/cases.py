"""The buildings to evaluate, from the shards of the stage crops, and the tables of their reconstructions."""

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from p2wss.data import polygon_arrays
from p2wss.data.building import Building, Reconstruction
from p2wss.data.manifest import Manifest
from p2wss.mesh import Mesh
from p2wss.skeleton.types import Polygons
from p2wss.storage import files
from p2wss.storage.schemas.columns import FOOTPRINT, FRAME, IDENTITY, MESH, STATUS, field
from p2wss.storage.schemas.crops import CROPS, SIMULATED

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


@dataclass(frozen=True)
class Case:
    """A building of a data set with its row of the shard; the labels are None for real LiDAR."""

    dataset: str
    building: Building
    visible_roof_share: float
    roof_type: str | None
    eave_height_m: float | None
    label_terrain_z_m: float | None
    angle_deg: np.ndarray | None

    @property
    def key(self) -> Key:
        """(dataset, tile, building id), which identifies the building in every table of the evaluation."""
        return self.dataset, self.building.tile, self.building.building_id

    @property
    def is_labelled(self) -> bool:
        """Whether the true height and angles are known."""
        return self.angle_deg is not None


def test_cases(manifest: Manifest) -> Iterator[list[Case]]:
    """The cases of the test: the test split of the simulated shards, and the real clouds chosen for the test.

    A list for each shard that has any, in the order of the manifest. Only one list is in memory at a time.
    """
    for shard in manifest.shards:
        select = partial(manifest.select, dataset=shard.dataset, purposes=["test"])
        table = files.read_rows(shard.verified(), CROPS, ["split", *KEY_COLUMNS[1:]], select)
        if len(table):
            yield from_crops(table, shard.dataset)


def cases_of(manifest: Manifest, keys: Collection[Key]) -> dict[Key, Case]:
    """The cases with these keys."""
    cases: dict[Key, Case] = {}
    for shard in manifest.shards:
        names = {key[1:] for key in keys if key[0] == shard.dataset}
        table = files.read_rows(
            shard.verified(), CROPS, KEY_COLUMNS[1:], files.rows_with(KEY_COLUMNS[1:], names)
        )
        cases |= {case.key: case for case in from_crops(table, shard.dataset)}
    return cases


@dataclass(frozen=True)
class Medians:
    """The constant predictor: medians of eave heights above the cloud's ground, and of all edges' angles."""

    eave_height_m: float
    angle_deg: float


def train_medians(manifest: Manifest) -> Medians:
    """Medians of the train split; of all labels if there is no train split, which favours the constant predictor.

    NaN without labels.
    """
    train = _medians(manifest, ["train"])
    return train if np.isfinite(train.eave_height_m) else _medians(manifest, ["train", "val", "test"])


def _medians(manifest: Manifest, splits: Sequence[str]) -> Medians:
    heights, angles = [np.zeros(0)], [np.zeros(0)]
    columns = ["split", *KEY_COLUMNS[1:], "eave_height_m", "label_terrain_z_m", "ground_z_m", "angle_deg"]
    for shard in manifest.shards:
        if shard.dataset == SIMULATED:
            table = files.read_table(shard.verified(), CROPS, columns=columns)
            table = table.filter(pa.array(manifest.select(table, SIMULATED, splits)))
            lift = table["label_terrain_z_m"].to_numpy() - table["ground_z_m"].to_numpy()
            heights.append(table["eave_height_m"].to_numpy() + lift)
            angles.append(files.list_column(table, "angle_deg")[0])
    height, angle = np.concatenate(heights), np.concatenate(angles)
    if not len(height):
        return Medians(float("nan"), float("nan"))
    return Medians(float(np.median(height)), float(np.median(angle)))


def from_crops(table: pa.Table, dataset: str) -> list[Case]:
    """Rows of the schema ``CROPS`` as cases."""
    polygons = polygon_arrays.from_columns(table)
    cases = []
    for i, row in enumerate(table.to_pandas().itertuples()):
        point_cm = np.column_stack([row.x_cm, row.y_cm, row.z_cm]).astype(np.int64)
        building = Building(
            row.building_id,
            row.tile,
            (row.origin_x_m, row.origin_y_m),
            polygons.rings(i),
            (point_cm + np.array([0, 0, round(100 * row.origin_z_m)])) / 100.0 - [0.0, 0.0, row.ground_z_m],
            row.classification.astype(np.uint8),
            row.ground_z_m,
        )
        labels = None, None, None, None
        if not pd.isna(row.eave_height_m):
            labels = row.roof_type, row.eave_height_m, row.label_terrain_z_m, row.angle_deg.astype(float)
        cases.append(Case(dataset, building, row.visible_roof_share, *labels))
    return cases


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
