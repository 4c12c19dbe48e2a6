"""Damaged files for every reader, made by hypothesis: how many ended in a traceback, took too long or too much memory.

    python tests/faults/fuzz.py --cases 10000

A case is a good file with one to three changes: to values of its structure (JSON, YAML, cells, names and types of the
columns of a table, the header of safetensors and of LAS, WKB in a GeoPackage), or to its bytes (cut off, flipped,
overwritten). Each is read twice, by its reader and by ``p2wss inspect``. A reader may read it or raise InputError;
anything else is a traceback for the user. Times are CPU time.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
import resource
import shutil
import sqlite3
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "unit"))

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import toy_scene
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from p2wss.cli import inspection
from p2wss.clouds.reading import list_clouds, read_clouds, read_headers
from p2wss.clouds.scan_files import read_scan
from p2wss.config import Scenes, load
from p2wss.data.manifest import read_manifest
from p2wss.data.terrain import read_terrain
from p2wss.eval import cases, report, tables
from p2wss.eval.cases import read_reconstructions
from p2wss.footprints.cleaning import clean_footprints, read_footprints
from p2wss.formats import cityjson_read
from p2wss.nets import weights_file
from p2wss.nets.weights import read_weights
from p2wss.scans.scan import build_surface, local_buildings
from p2wss.storage import files, integrity
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.buildings import BUILDINGS
from p2wss.storage.schemas.measures import MEASURES
from p2wss.storage.schemas.scene import read_scene

MAX_S, MAX_MB = 10.0, 2000.0
HOSTILE: list[Any] = [
    *(None, True, "", "x", "../../x", "é\u0000", "9" * 400, -1, 0, 1, 7, 2**31, 2**63, 2**70, -(2**63)),
    *(1e308, -6e34, float("nan"), float("inf"), 0.5, [], {}, [[]], [[[[]]]], {"": None}, [None, "a", {}]),
]
Draw = Callable[[Any], Any]


def changed_value(draw: Draw, value: Any) -> Any:
    """A JSON value in which one place has another value, is missing or is there twice."""
    value = json.loads(json.dumps(value))
    parent, key, here = None, None, value
    while isinstance(here, dict | list) and here and (parent is None or draw(st.integers(0, 5))):
        parent, key = (
            here,
            draw(st.sampled_from(sorted(here) if isinstance(here, dict) else range(len(here)))),
        )
        here = here[key]
    other = draw(st.sampled_from(HOSTILE))
    if parent is None:
        return other
    how = draw(st.sampled_from(["replace", "replace", "delete", "repeat"]))
    if how == "delete":
        del parent[key]
    elif how == "repeat" and isinstance(parent, list):
        parent.insert(key, here)
    else:
        parent[key] = other
    return value


def changed_bytes(draw: Draw, content: bytes, within: int | None = None) -> bytes:
    """The bytes cut off, or with some flipped, overwritten or repeated; within: the first so many."""
    data = bytearray(content)
    end = max(min(within or len(data), len(data)), 1)
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, end - 1))
        how = draw(st.sampled_from(["flip", "flip", "number", "cut", "repeat", "text"]))
        if how == "flip" and at < len(data):
            data[at] ^= 1 << draw(st.integers(0, 7))
        elif how == "number":
            number = draw(st.sampled_from([0, 1, 2**15, 2**16 - 1, 2**31 - 1, 2**32 - 1, 2**63, 2**64 - 1]))
            width = draw(st.sampled_from([1, 2, 4, 8]))
            data[at : at + width] = struct.pack("<Q", number)[:width]
        elif how == "cut":
            del data[at:]
        elif how == "repeat":
            data[at:at] = data[at : at + 16]
        else:
            data[at : at + 4] = draw(
                st.sampled_from(["é".encode("latin-1"), b"\xff\xfe\0\0", b"null", b'"}]{'])
            )
    return bytes(data)


def change_json(draw: Draw, path: Path) -> None:
    value = json.loads(path.read_text(encoding="utf-8"))
    for _ in range(draw(st.integers(1, 2))):
        value = changed_value(draw, value)
    path.write_text(json.dumps(value), encoding="utf-8")


def change_json_lines(draw: Draw, path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    at = draw(st.integers(0, len(lines) - 1))
    lines[at] = json.dumps(changed_value(draw, json.loads(lines[at])))
    path.write_text("\n".join(lines), encoding="utf-8")


def change_yaml(draw: Draw, path: Path) -> None:
    value = changed_value(draw, yaml.safe_load(path.read_text(encoding="utf-8")))
    path.write_text(yaml.safe_dump(value, allow_unicode=True), encoding="utf-8")


def change_table(draw: Draw, path: Path) -> None:
    """Another value or type in a column, a column under another name, or other metadata."""
    table = pq.read_table(path)
    at = draw(st.integers(0, table.num_columns - 1))
    name, metadata = table.column_names[at], dict(table.schema.metadata or {})
    how = draw(st.sampled_from(["cell", "cell", "cell", "type", "name", "metadata", "geo", "null"]))
    if how == "cell":
        values = table[name].to_pylist()
        row = draw(st.integers(0, len(values) - 1))
        values[row] = values[row] if isinstance(values[row], bytes) else changed_value(draw, values[row])
        try:
            column = pa.array(values, table.schema.field(name).type)
        except (pa.ArrowException, OverflowError, ValueError):
            return
        table = table.set_column(at, pa.field(name, column.type), column)
    elif how == "type":
        kind = draw(
            st.sampled_from([pa.string(), pa.int8(), pa.list_(pa.string()), pa.float64(), pa.bool_()])
        )
        table = table.set_column(at, name, pa.nulls(len(table), kind).fill_null(pa.scalar(False).cast(kind))
                                 if not pa.types.is_list(kind) else pa.array([["a"]] * len(table), kind))  # fmt: skip
    elif how == "name":
        table = table.rename_columns(
            [f"{column}x" if i == at else column for i, column in enumerate(table.column_names)]
        )
    elif how == "null":
        table = table.set_column(at, name, pa.nulls(len(table), table.schema.field(name).type))
    else:
        key = b"p2wss" if how == "metadata" else b"geo"
        if key in metadata:
            metadata[key] = json.dumps(changed_value(draw, json.loads(metadata[key]))).encode()
    pq.write_table(table.replace_schema_metadata(metadata), path)


def change_weights(draw: Draw, path: Path) -> None:
    content = path.read_bytes()
    size = struct.unpack_from("<Q", content)[0]
    header = json.dumps(changed_value(draw, json.loads(content[8 : 8 + size]))).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header + content[8 + size :])


def change_wkb(draw: Draw, path: Path) -> None:
    with sqlite3.connect(path) as base:
        base.execute("PRAGMA journal_mode = OFF")
        base.execute("PRAGMA synchronous = OFF")
        row = draw(st.integers(1, 4))
        ((blob,),) = base.execute("SELECT geom FROM buildings WHERE fid = ?", (row,)).fetchall()
        for (trigger,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            base.execute(f'DROP TRIGGER "{trigger}"')
        base.execute("UPDATE buildings SET geom = ? WHERE fid = ?", (changed_bytes(draw, blob), row))


def change_las(draw: Draw, path: Path) -> None:
    path.write_bytes(changed_bytes(draw, path.read_bytes(), within=600))


def change_bytes(draw: Draw, path: Path) -> None:
    path.write_bytes(changed_bytes(draw, path.read_bytes()))


def damage_own_table(draw: Draw, path: Path) -> None:
    """Other bytes. A table with the checksum of its content is one that a stage wrote, which the next one trusts."""
    change_bytes(draw, path)


def seal_again(path: Path) -> None:
    """Make the checksum that a file of ours states that of its changed content, as whoever means harm would."""
    slot = integrity.SLOT.encode()
    path.write_bytes(re.sub(re.escape(slot[:13]) + rb"[0-9a-f]{64}", slot, path.read_bytes()))
    integrity.fill(path)


def read_scene_files(path: Path) -> None:
    scene, facts = read_scene(path)
    _ = scene.geometry.bounds, facts["tile"], facts["crs"]


def read_buildings(path: Path) -> None:
    from p2wss.config import Scans

    facts, table = files.read_metadata(path), files.read_table(path, BUILDINGS)
    _ = facts["tile"], facts["margin_m"] < 1
    build_surface(table, toy_scene.terrain(), np.zeros(3), Scans())
    local_buildings(table, np.zeros(3), 0)


def read_crops(path: Path) -> None:
    from p2wss.storage.schemas.crops import CROPS

    cases.from_crops(files.read_table(path, CROPS), "simulated")
    files.read_metadata(path).get("crs")


def read_measures(path: Path) -> None:
    measures, runs = files.read_table(path, MEASURES), [tables.Run("fit", "ok")]
    tables.table_1(measures)
    tables.ranked(tables.frame_of(measures, runs), runs)


def read_city(path: Path) -> None:
    cityjson_read.read(path)
    list(cityjson_read.shells(path))


def read_manifest_file(path: Path) -> None:
    manifest = read_manifest(path)
    keys = pa.table({"split": ["test"], "tile": ["a"], "building_id": ["b"]})
    for shard in manifest.shards:
        manifest.select(keys, shard.dataset, ["test"])


def read_outlines(path: Path) -> None:
    clean_footprints(read_footprints(path), Scenes())


def read_points(path: Path) -> None:
    read_headers(list_clouds([path]))
    read_clouds([path])


# name of the good file: (the reader, the change to its structure)
READERS: dict[str, tuple[Callable[[Path], Any], Callable[[Draw, Path], None]]] = {
    "manifest.json": (read_manifest_file, change_json),
    "medians.json": (partial(files.read_json, kind=cases.Medians), change_json),
    "metrics.jsonl": (report.read_training, change_json_lines),
    "config.yaml": (load, change_yaml),
    "crops.parquet": (read_crops, damage_own_table),
    "buildings.parquet": (read_buildings, damage_own_table),
    "scene.parquet": (read_scene_files, damage_own_table),
    "reconstructions.parquet": (read_reconstructions, damage_own_table),
    "measures.parquet": (read_measures, damage_own_table),
    "outlines.parquet": (read_outlines, change_table),
    "outlines.gpkg": (read_outlines, change_wkb),
    "weights.safetensors": (lambda path: read_weights(path, "model"), change_weights),
    "header.safetensors": (lambda path: weights_file.read_metadata(path, "model"), change_weights),
    "city.city.json": (read_city, change_json),
    "city.city.jsonl": (read_city, change_json_lines),
    "cloud.las": (read_points, change_las),
    "cloud.laz": (read_points, change_las),
    "scan.laz": (read_scan, change_las),
    "terrain.tif": (read_terrain, change_bytes),
}  # fmt: skip


def write_good_files(folder: Path) -> None:
    """One good file for each reader."""
    from small_files import write

    write(folder)
    for name, (read, _) in READERS.items():
        read(folder / name)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", help="names of good files")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    names = options.only or list(READERS)
    counts = {
        name: {"cases": 0, "read": 0, "refused": 0, "tracebacks": 0, "slowest_s": 0.0} for name in names
    }
    errors: dict[str, str] = {}
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None) as folder:
        good, bad = Path(folder, "good"), Path(folder, "bad")
        write_good_files(good)
        shutil.copytree(good, bad)
        before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

        def run(name: str, data: st.DataObject) -> None:
            read, change = READERS[name]
            shutil.copy(good / name, bad / name)
            path, row = bad / name, counts[name]
            row["cases"] += 1
            (change if data.draw(st.integers(0, 3)) else change_bytes)(data.draw, path)
            if change is not damage_own_table and data.draw(st.integers(0, 7)):
                seal_again(path)
            for reader in (read, inspection.describe):
                start = time.process_time()
                try:
                    reader(path)
                    outcome = "read"
                except InputError as error:
                    assert "\n" not in str(error), error
                    outcome = "refused"
                except BaseException as error:
                    if isinstance(error, KeyboardInterrupt):
                        raise
                    outcome = "tracebacks"
                    place = traceback.extract_tb(error.__traceback__)[-1]
                    errors.setdefault(f"{name}: {type(error).__name__} at {place.name}:{place.lineno}",
                                      "".join(traceback.format_exception(error))[-1500:])  # fmt: skip
                row[outcome] += 1
                row["slowest_s"] = max(row["slowest_s"], round(time.process_time() - start, 2))

        for name in names:
            per_reader = -(-options.cases // len(names))

            @settings(max_examples=per_reader, phases=[Phase.generate], derandomize=options.seed == 0, database=None,
                      deadline=None, suppress_health_check=list(HealthCheck))  # fmt: skip
            @given(st.just(name), st.data())
            def damaged(name: str, data: st.DataObject) -> None:
                run(name, data)

            damaged()
            print(name, counts[name], file=sys.stderr, flush=True)
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    for place, text in errors.items():
        print(place, text, sep="\n", file=sys.stderr)
    figures = {
        "cases": {"value": sum(row["cases"] for row in counts.values()), "bar": options.cases, "ok": True},
        "tracebacks": {"value": sum(row["tracebacks"] for row in counts.values()), "bar": 0},
        "slowest_s": {"value": max(row["slowest_s"] for row in counts.values()), "bar": MAX_S},
        "peak_mb": {"value": round(peak_mb), "bar": MAX_MB, "before": round(before_mb)},
    }
    for name in ("tracebacks", "slowest_s", "peak_mb"):
        figures[name]["ok"] = figures[name]["value"] <= figures[name]["bar"]
    print(f"{'file':<28}{'cases':>7}{'read':>7}{'refused':>9}{'tracebacks':>12}{'slowest (s)':>13}")
    for name, row in counts.items():
        numbers = f"{row['cases']:>7}{row['read']:>7}{row['refused']:>9}{row['tracebacks']:>12}"
        print(f"{name:<28}{numbers}{row['slowest_s']:>13.2f}")
    print(json.dumps({"readers": counts} | figures))
    return 0 if all(figure["ok"] for figure in figures.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
