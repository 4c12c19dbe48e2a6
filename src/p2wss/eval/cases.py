"""The buildings to evaluate, from the shards of the stage crops."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd
import pyarrow as pa

from p2wss.data import polygon_arrays
from p2wss.data.building import Building
from p2wss.data.manifest import Manifest
from p2wss.eval.reconstructions import Key
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS, SIMULATED

_KEY_COLUMNS = ["tile", "building_id"]


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
        table = files.read_rows(shard.verified(), CROPS, ["split", *_KEY_COLUMNS], select)
        if len(table):
            yield from_crops(table, shard.dataset)


def cases_of(manifest: Manifest, keys: Collection[Key]) -> dict[Key, Case]:
    """The cases with these keys."""
    cases: dict[Key, Case] = {}
    for shard in manifest.shards:
        names = {key[1:] for key in keys if key[0] == shard.dataset}
        table = files.read_rows(shard.verified(), CROPS, _KEY_COLUMNS, files.rows_with(_KEY_COLUMNS, names))
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
    columns = ["split", *_KEY_COLUMNS, "eave_height_m", "label_terrain_z_m", "ground_z_m", "angle_deg"]
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
