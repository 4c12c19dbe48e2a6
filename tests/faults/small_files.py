"""One small good file of every kind that a reader of ours reads, for ``fuzz.py``."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyarrow.parquet as pq
import pyproj
import shapely
import torch
import toy_crops
import toy_scene

from p2wss.clouds.scan_files import write_scan
from p2wss.data.building import Reconstruction
from p2wss.eval.cases import RECONSTRUCTIONS, reconstruction_columns
from p2wss.mesh import Mesh
from p2wss.nets.weights import write_weights
from p2wss.storage import files
from p2wss.storage.schemas.measures import MEASURES

CRS = "EPSG:2154"


def write(folder: Path) -> None:
    """Write them all to ``folder``."""
    toy_crops.make(folder, {"train": 1, "test": 2})
    shutil.copy(folder / "0001_0001.parquet", folder / "crops.parquet")
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    manifest.pop("checksum", None)
    ranges = {"simulated": {"test": {"from": 0, "below": 2**62}}}
    files.write_json(folder / "manifest.json", manifest | {"selection": {"ranges": ranges, "seed": 1}})
    files.write_json(folder / "medians.json", {"eave_height_m": 4.5, "angle_deg": 35.0})
    lines = [{"step": i, "loss": 1.0 / (i + 1), "val_loss": 2.0} for i in range(4)]
    files.write_text(folder / "metrics.jsonl", "".join(json.dumps(line) + "\n" for line in lines))
    files.write_text(
        folder / "config.yaml", "region: {name: town, tiles: ['0652_6862']}\nscenes: {margin_m: 30}\n"
    )
    rows = toy_scene.houses()[:4]
    _tables(folder, rows)
    _clouds(folder)
    state = {"a": torch.zeros(3, 2), "b": torch.ones(4)}
    for name in ("weights", "header"):
        write_weights(
            folder / f"{name}.safetensors", state, {"kind": "model", "version": "0", "config": {"b": 1}}
        )
    city = _city(rows[0])
    files.write_text(folder / "city.city.json", json.dumps(city))
    head = city | {"CityObjects": {}, "vertices": []}
    feature = {
        "type": "CityJSONFeature",
        "id": "a",
        "CityObjects": city["CityObjects"],
        "vertices": city["vertices"],
    }
    files.write_text(folder / "city.city.jsonl", f"{json.dumps(head)}\n{json.dumps(feature)}\n")


def _tables(folder: Path, rows: list[dict]) -> None:
    _, dtm, _ = toy_scene.write_scene(folder, rows)
    dtm.rename(folder / "terrain.tif")
    corners = [
        np.reshape(row["footprint_xy_m"], (-1, 2)) + np.array([row["origin_x_m"], row["origin_y_m"]])
        for row in rows
    ]
    shapes = [shapely.Polygon(ring) for ring in corners]
    facts = files.read_metadata(folder / "scene.parquet")
    scene = pq.read_table(folder / "scene.parquet").to_pandas()
    files.write_geoparquet(
        folder / "scene.parquet", gpd.GeoDataFrame(scene, geometry=shapes, crs=CRS), dict(facts)
    )
    shapes[1] = shapely.MultiPolygon([shapes[1], shapely.affinity.translate(shapes[1], 50, 0)])
    shapes[2] = shapes[2].difference(shapes[2].centroid.buffer(1, quad_segs=1))
    outlines = gpd.GeoDataFrame({"building_id": list("abcd"), "h": [1.0, 2, 3, 4]}, geometry=shapes, crs=CRS)
    outlines.to_parquet(folder / "outlines.parquet")
    outlines.to_file(folder / "outlines.gpkg", layer="buildings", driver="GPKG", engine="pyogrio")
    reconstructions = [
        Reconstruction(
            building_id=row["building_id"],
            tile=row["tile"],
            method="fit",
            status="ok",
            origin_xy_m=(row["origin_x_m"], row["origin_y_m"]),
            ground_z_m=80.0,
            rings=[np.reshape(row["footprint_xy_m"], (-1, 2))],
            eave_height_m=row["eave_height_m"],
            angle_deg=np.array(row["angle_deg"]),
            mesh=Mesh(
                np.reshape(row["vertex_xyz_m"], (-1, 3)),
                np.reshape(row["triangle"], (-1, 3)).astype(np.int32),
                np.array(row["triangle_kind"], np.uint8),
                np.array(row["triangle_edge"], np.int32),
            ),
            num_parts=1,
        )
        for row in rows
    ]
    columns = reconstruction_columns(reconstructions, "simulated")
    files.write_table(
        folder / "reconstructions.parquet", columns, RECONSTRUCTIONS, {"method": "fit", "status": "ok"}
    )
    numbers = {field.name: [_value(field)] * 3 for field in MEASURES}
    files.write_table(folder / "measures.parquet", numbers, MEASURES, {"version": "0"})


def _value(field: files.pa.Field) -> object:
    kind = str(field.type)
    return (
        {"string": "ok", "bool": True, "int32": 7, "float": 0.5}.get(kind, [])
        if field.name != "dataset"
        else "real"
    )


def _clouds(folder: Path) -> None:
    draw = np.random.default_rng(0)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.01), np.array([652_500.0, 6_862_000.0, 0.0])
    header.add_crs(pyproj.CRS.from_user_input(CRS))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y = (header.offsets[i] + draw.uniform(0, 100, 400) for i in range(2))
    cloud.z, cloud.classification = draw.uniform(80, 90, 400), np.full(400, 6)
    for name in ("cloud.las", "cloud.laz"):
        cloud.write(folder / name)
    points = {axis: draw.integers(0, 90_000, 400).astype(np.int32) for axis in "XYZ"}
    ids = {"building_id": np.zeros(400, np.int32), "face_id": np.full(400, 6, np.int32)}
    write_scan(folder / "scan.laz", [points | ids], header.offsets, pyproj.CRS.from_user_input(CRS))


def _city(row: dict) -> dict:
    triangles = np.reshape(row["triangle"], (-1, 3)).tolist()
    kinds = np.minimum(row["triangle_kind"], 2).tolist()
    semantics = {
        "surfaces": [{"type": f"{name}Surface"} for name in ("Ground", "Wall", "Roof")],
        "values": [kinds],
    }
    solid = {
        "type": "Solid",
        "lod": "2.2",
        "boundaries": [[[ring] for ring in triangles]],
        "semantics": semantics,
    }
    return {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.001] * 3, "translate": [652_500.0, 6_862_000.0, 80.0]},
        "CityObjects": {"a": {"type": "Building", "attributes": {"building_id": "a"}, "geometry": [solid]}},
        "vertices": np.round(np.reshape(row["vertex_xyz_m"], (-1, 3)) * 1000).astype(int).tolist(),
    }
