"""A small file of every kind that is passed between stages or kept by a training, and its reader.

For tests and for ``benchmarks/bit_flips.py``: a reader returns all that it read, as something that can be compared.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import laspy
import matplotlib.pyplot as plt
import numpy as np
import pyproj
import shapely
import torch
import toy_crops
import toy_scene
from feature_tables import read_footprints
from torch import nn

from p2wss.clouds import scan_files as scan_file
from p2wss.clouds.reading import read_clouds, read_headers
from p2wss.config import Optimiser
from p2wss.data.manifest import read_manifest
from p2wss.data.terrain import read_terrain, write_terrain
from p2wss.eval.cases import RECONSTRUCTIONS
from p2wss.eval.report import _scan_picture, read_training
from p2wss.fetching import bdtopo
from p2wss.fetching.cloud import write_cloud
from p2wss.nets.weights import read_weights, write_weights
from p2wss.storage import files, integrity
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.buildings import BUILDINGS
from p2wss.storage.schemas.crops import CROPS
from p2wss.storage.schemas.measures import MEASURES
from p2wss.storage.schemas.scene import SCENE, read_scene, write_scene
from p2wss.training.loop import TrainingState

CRS = "EPSG:2154"


@dataclass(frozen=True)
class Kind:
    """write: to a folder; returns the file whose bits are flipped. read: all that the stages read of it.

    remade: a cache or a checkpoint, which is made again with a warning instead of an error.
    """

    write: Callable[[Path], Path]
    read: Callable[[Path], Any]
    remade: bool = False


_LISTS = {
    "footprint_xy_m": [0.0, 0.0, 9.5, 0.0, 9.5, 8.0, 0.0, 8.0],
    "ring_offset": [0, 4],
    "angle_deg": [30.0, 90.0, 30.0, 90.0],
}


def _value(field: Any, row: int) -> Any:
    """A value of a column that the readers accept."""
    kind = str(field.type)
    if kind == "string":
        return f"{field.name} {row}"
    if kind == "bool":
        return True
    if kind.startswith("list"):
        return _LISTS.get(field.name, [])
    return float(row % 2) if kind in ("float", "double") else row % 2


def _table(name: str, schema: Any, num_rows: int = 20) -> Kind:
    def write(folder: Path) -> Path:
        columns = {field.name: [_value(field, row) for row in range(num_rows)] for field in schema}
        files.write_table(folder / name, columns, schema, files.provenance(crs=CRS, config="{}", code="x"))
        return folder / name

    def read(path: Path) -> Any:
        return files.read_table(path, schema).to_pydict(), files.read_metadata(path)

    return Kind(write, read)


def _scene(folder: Path) -> Path:
    rows = {field.name: [_value(field, row) for row in range(9)] for field in SCENE}
    shapes = [shapely.box(x, 0, x + 8, 9) for x in range(0, 90, 10)]
    write_scene(folder / "scene.parquet", gpd.GeoDataFrame(rows, geometry=shapes, crs=CRS), {"crs": CRS})
    return folder / "scene.parquet"


def _read_scene(path: Path) -> Any:
    frame, metadata = read_scene(path)
    return (
        frame.drop(columns="geometry").to_json(),
        frame.geometry.to_wkb().tolist(),
        str(frame.crs),
        metadata,
    )


def _terrain(folder: Path) -> Path:
    write_terrain(folder / "terrain.tif", toy_scene.terrain(), CRS, {"version": "1"})
    return folder / "terrain.tif"


def _read_terrain(path: Path) -> Any:
    terrain, crs = read_terrain(path)
    return terrain.height_m.tobytes(), terrain.x_min_m, terrain.y_max_m, terrain.cell_m, crs.to_wkt()


def _footprints(folder: Path) -> Path:
    shapes = [shapely.MultiPolygon([shapely.box(x, 0, x + 8, 9)]) for x in range(0, 500, 10)]
    columns: dict[str, Any] = {"building_id": [f"B{x}" for x in range(50)], "hauteur_m": np.arange(50.0)}
    frame = gpd.GeoDataFrame(columns, geometry=shapes, crs=CRS)
    bdtopo.write_footprints(folder / "footprints.gpkg", frame, {"version": "1"})
    return folder / "footprints.gpkg"


def _read_footprints(path: Path) -> Any:
    frame = read_footprints(path)
    return frame.drop(columns="geometry").to_json(), frame.geometry.to_wkb().tolist(), frame.crs.to_wkt()


def _scan(folder: Path) -> Path:
    rng, count = np.random.default_rng(0), 2000
    chunk = {name: rng.integers(0, 100_000, count).astype(np.int32) for name in "XYZ"}
    chunk |= {name: rng.integers(-1, 50, count).astype(np.int32) for name in ("building_id", "face_id")}
    chunk |= {"classification": rng.choice([2, 6], count), "point_source_id": rng.integers(1, 4, count)}
    path = folder / "scan.laz"
    scan_file.write_scan(path, [chunk], np.array([652_000.0, 6_862_000.0, 0.0]), pyproj.CRS(CRS))
    return path


def _arrays(cloud: Any) -> Any:
    values = [getattr(cloud, name) for name in ("x_m", "y_m", "z_m", "classification", "day")]
    return [None if value is None else value.tobytes() for value in values], str(cloud.crs)


def _read_scan(path: Path) -> Any:
    cloud, building, face = scan_file.read_scan(path)
    return _arrays(cloud), building.tobytes(), face.tobytes()


def _cloud(folder: Path) -> Path:
    """Of the user, or of a service: copied as it is."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.01), np.array([652_000.0, 6_861_000.0, 0.0])
    header.add_crs(pyproj.CRS(CRS))
    points = laspy.ScaleAwarePointRecord.zeros(2000, header=header)
    rng = np.random.default_rng(0)
    for name in "XYZ":
        points[name] = rng.integers(0, 90_000, 2000)
    points["classification"] = rng.choice([2, 6], 2000)
    with laspy.open(folder / "source.laz", "w", header=header, do_compress=True) as writer:
        writer.write_points(points)
    write_cloud(folder / "cloud.laz", [folder / "source.laz"], (652_000, 6_861_000, 653_000, 6_862_000), CRS)
    return folder / "cloud.laz"


def _read_cloud(path: Path) -> Any:
    header = read_headers([path])[0]
    return _arrays(read_clouds([path])), header.num_points, header.bounds


def _index(folder: Path) -> Path:
    rows = "".join(f"\t{x:04d}_6862\t{x}\n" for x in range(600, 640))
    files.write_text(folder / "index.tsv", f"place\ttile\tnum_buildings\n{rows}{integrity.TABLE_TRAILER}")
    return folder / "index.tsv"


def _json(folder: Path) -> Path:
    value = {"angles": {"cuts": [float(x) for x in np.linspace(0, 1, 60)]}, "p2wss": {"version": "1"}}
    files.write_json(folder / "parameters.json", value)
    return folder / "parameters.json"


def _manifest(folder: Path) -> Path:
    return toy_crops.make(folder, {"train": 3, "val": 2})


def _shard(folder: Path) -> Path:
    return _manifest(folder).with_name("0001_0001.parquet")


def _read_shard(path: Path) -> Any:
    shards = read_manifest(path.with_name("manifest.json")).shards
    return [files.read_table(shard.verified(), CROPS).to_pydict() for shard in shards]


def _read_manifest(path: Path) -> Any:
    return read_manifest(path)


def _weights(folder: Path) -> Path:
    torch.manual_seed(0)
    metadata = {"version": "1", "kind": "model", "config": {"dim": 16}}
    write_weights(folder / "model.safetensors", nn.Linear(16, 40).state_dict(), metadata)
    return folder / "model.safetensors"


def _read_weights(path: Path) -> Any:
    state, metadata = read_weights(path, "model")
    return {name: value.numpy().tobytes() for name, value in state.items()}, metadata


def _metrics(folder: Path) -> Path:
    lines = "".join(json.dumps({"step": step, "loss": 1 / step}) + "\n" for step in range(1, 60))
    files.write_text(folder / "metrics.jsonl", lines + integrity.JSON_LINES_TRAILER)
    return folder / "metrics.jsonl"


def _png(folder: Path) -> Path:
    figure, axes = plt.subplots(figsize=(2, 1))
    axes.plot([1, 3, 2])
    with files.atomic(folder / "scan.png") as temporary:
        figure.savefig(temporary)
        integrity.append(temporary)
    plt.close(figure)
    return folder / "scan.png"


def _state() -> TrainingState:
    torch.manual_seed(0)
    return TrainingState(nn.Linear(8, 4), Optimiser(num_steps=10))


def _checkpoint(folder: Path) -> Path:
    _state().save(folder, 5, {"a": 1})
    return folder / "step-00000005.pt"


def _read_checkpoint(path: Path) -> Any:
    state = _state()
    with torch.no_grad():
        state.module.weight.zero_()
    if not state.resume(path.parent, {"a": 1}):
        raise InputError("starts afresh")
    return [value.numpy().tobytes() for value in state.module.state_dict().values()]


KINDS: dict[str, Kind] = {
    "footprints, GeoPackage": Kind(_footprints, _read_footprints),
    "terrain, GeoTIFF": Kind(_terrain, _read_terrain),
    "LiDAR as delivered, LAZ": Kind(_cloud, _read_cloud),
    "index of scenes, TSV": Kind(_index, integrity.read_lines),
    "scene, GeoParquet": Kind(_scene, _read_scene),
    "buildings, Parquet": _table("buildings.parquet", BUILDINGS),
    "scan, LAZ": Kind(_scan, _read_scan),
    "picture of a scan, PNG": Kind(_png, _scan_picture),
    "crops, Parquet": Kind(_shard, _read_shard),
    "manifest, JSON": Kind(_manifest, _read_manifest),
    "weights, safetensors": Kind(_weights, _read_weights),
    "metrics, JSON lines": Kind(_metrics, read_training),
    "reconstructions, Parquet": _table("fit.parquet", RECONSTRUCTIONS),
    "measures, Parquet": _table("measures.parquet", MEASURES),
    "errors and times, JSON": Kind(_json, files.read_json),
    "checkpoint": Kind(_checkpoint, _read_checkpoint, True),
}


@dataclass
class Outcome:
    """What flips in a file led to: told (an InputError, or a file that is made again), the same content, silent (other
    content), a traceback."""

    told: int = 0
    same: int = 0
    silent: int = 0
    traceback: int = 0


def flip_bits(kind: Kind, folder: Path, num_flips: int, seed: int = 0) -> Outcome:
    """Read a file of a kind with one flipped bit, ``num_flips`` times; each time in a folder of its own state."""
    path = kind.write(folder)
    content, expected = path.read_bytes(), kind.read(path)
    outcome = Outcome()
    # a quarter of the flips in the last kilobyte: footers and checksums
    rng = np.random.default_rng(seed)
    places = rng.integers(0, 8 * len(content), num_flips)
    tail = 8 * min(len(content), 1024)
    places[::4] = 8 * len(content) - 1 - rng.integers(0, tail, len(places[::4]))
    for place in places.tolist():
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << place % 8
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(damaged)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                actual = kind.read(path)
        except InputError as error:
            assert len(str(error).splitlines()) == 1
            outcome.told += 1
        except Exception:
            outcome.traceback += 1
        else:
            # a cache that was made again has the same content: the file tells
            remade = kind.remade and path.read_bytes() != bytes(damaged)
            same = actual == expected or (isinstance(actual, float) and math.isnan(actual))
            outcome.silent += not same
            outcome.told += same and remade
            outcome.same += same and not remade
    return outcome
