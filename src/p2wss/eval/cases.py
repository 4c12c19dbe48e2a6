"""The buildings to evaluate, from the shards of the stage crops."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from p2wss.data import polygon_arrays
from p2wss.data.building import Building, Reconstruction
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS, SIMULATED
from p2wss.storage.schemas.manifest import Manifest

Key = tuple[str, str, str]
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


def test_cases(manifest: Manifest) -> Iterator[list[Case]]:
    """The test split of the simulated shards and the real clouds for the test, shard by shard.

    A list for each shard that has any, in the order of the manifest; an empty one if none has. No more than one is in
    memory.
    """
    is_empty = True
    for shard in manifest.shards:
        dataset = shard.dataset

        def select(table: pa.Table, dataset: str = dataset) -> np.ndarray:
            return manifest.select(table, dataset, ["test"])

        table = files.read_rows(shard.verified(), CROPS, ["split", *_KEY_COLUMNS], select)
        if len(table):
            is_empty = False
            yield from_crops(table, dataset)
    if is_empty:
        yield []


def cases_of(manifest: Manifest, keys: Collection[Key]) -> dict[Key, Case]:
    """The cases with these keys."""
    cases: dict[Key, Case] = {}
    for shard in manifest.shards:
        dataset = shard.dataset
        names = {key[1:] for key in keys if key[0] == dataset}
        table = files.read_rows(shard.verified(), CROPS, _KEY_COLUMNS, files.rows_with(_KEY_COLUMNS, names))
        cases |= {case.key: case for case in from_crops(table, dataset)}
    return cases


@dataclass(frozen=True)
class Medians:
    """The constant predictor: medians of eave heights above the cloud's ground, and of all edges' angles."""

    eave_height_m: float
    angle_deg: float

    def write(self, path: Path) -> None:
        """Write as JSON."""
        files.write_json(path, asdict(self))


def read_medians(path: Path) -> Medians:
    """Medians from a file of :meth:`Medians.write`. Raises :class:`InputError` if it is missing or something else."""
    return files.read_json(path, Medians, "written by p2wss eval medians")


def train_medians(manifest: Manifest) -> Medians:
    """Medians of the train split, or of all labels if there is no train split, which favours the constant predictor.

    NaN without labels.
    """
    train = _medians(manifest, ["train"])
    return train if np.isfinite(train.eave_height_m) else _medians(manifest, ["train", "val", "test"])


def _medians(manifest: Manifest, splits: Sequence[str]) -> Medians:
    heights, angles = [np.zeros(0)], [np.zeros(0)]
    for shard in manifest.shards:
        dataset = shard.dataset
        if dataset == SIMULATED:
            columns = [
                "split",
                "tile",
                "building_id",
                "eave_height_m",
                "label_terrain_z_m",
                "ground_z_m",
                "angle_deg",
            ]
            table = files.read_table(shard.verified(), CROPS, columns=columns)
            mask = manifest.select(table, dataset, splits)
            table = table.filter(pa.array(mask))
            lift = table["label_terrain_z_m"].to_numpy() - table["ground_z_m"].to_numpy()
            heights.append(table["eave_height_m"].to_numpy() + lift)
            angles.append(files.list_column(table, "angle_deg")[0])
    height, angle = np.concatenate(heights), np.concatenate(angles)
    if not len(height):
        return Medians(float("nan"), float("nan"))
    return Medians(float(np.median(height)), float(np.median(angle)))


def local_points(case: Case, reconstruction: Reconstruction) -> np.ndarray:
    """The building's points in the frame of the reconstruction's mesh: (n, 3), metres."""
    shift = np.subtract(case.building.origin_xy_m, reconstruction.origin_xy_m)
    return case.building.point_m + np.array([*shift, -reconstruction.ground_z_m])


def from_crops(table: pa.Table, dataset: str) -> list[Case]:
    """Rows of the schema ``CROPS`` as cases."""
    polygons = polygon_arrays.from_columns(table)
    x, offset = files.list_column(table, "x_cm")
    y, _ = files.list_column(table, "y_cm")
    z, _ = files.list_column(table, "z_cm")
    classification, _ = files.list_column(table, "classification")
    angle, angle_offset = files.list_column(table, "angle_deg")
    point_cm = np.column_stack([x, y, z]).astype(np.int64)
    plain = table.select(
        [
            "building_id",
            "tile",
            "origin_x_m",
            "origin_y_m",
            "origin_z_m",
            "ground_z_m",
            "eave_height_m",
            "label_terrain_z_m",
            "roof_type",
            "visible_roof_share",
        ]
    ).to_pylist()
    cases = []
    for i, row in enumerate(plain):
        points = slice(offset[i], offset[i + 1])
        building = Building(
            row["building_id"],
            row["tile"],
            (row["origin_x_m"], row["origin_y_m"]),
            polygons.rings(i),
            (point_cm[points] + [0, 0, round(100 * row["origin_z_m"])]) / 100.0,
            classification[points].astype(np.uint8),
            row["ground_z_m"],
        )
        labelled = row["eave_height_m"] is not None
        cases.append(
            Case(
                dataset,
                building,
                row["visible_roof_share"],
                row["roof_type"],
                row["eave_height_m"],
                row["label_terrain_z_m"],
                angle[angle_offset[i] : angle_offset[i + 1]].astype(float) if labelled else None,
            )
        )
    return cases


def columns_of(rows: Iterable[dict[str, Any]], names: Sequence[str]) -> dict[str, list[Any]]:
    """The columns ``names`` of rows, for a table."""
    rows = list(rows)
    return {name: [row[name] for row in rows] for name in names}
