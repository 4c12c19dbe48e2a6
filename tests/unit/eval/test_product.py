"""What the report calls fit is what ``p2wss reconstruct`` writes, building by building."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyproj
import pytest
import shapely

from p2wss import cli, skeleton
from p2wss.data.building import Reconstruction
from p2wss.eval.cases import read_reconstructions
from p2wss.mesh.surface import sample_surface
from p2wss.reconstruction.outputs import exports
from p2wss.skeleton.types import FaceKind, Polygons

TILE = "0652_6862"
L_SHAPE = [(0, 0), (16, 0), (16, 6), (7, 6), (7, 13), (0, 13)]
BOX = [(0, 0), (12, 0), (12, 8), (0, 8)]
# notches that the product simplifies away
NOTCHED = [(0, 0), (6, 0), (6, 0.1), (6.1, 0.1), (6.1, 0), (12, 0), (12, 8), (0, 8)]
HOUSES = [
    (BOX, [35, 90, 35, 90], 5.0),
    (NOTCHED, [30] * 8, 4.5),
    (L_SHAPE, [40, 90, 40, 40, 90, 40], 6.0),
    (BOX, [0] * 4, 7.0),
    # above 50 m the oracle gives no answer
    (BOX, [0] * 4, 60.0),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with footprints.gpkg and a cloud in centimetres: the houses, one with two points on its roof and one
    with none."""
    folder, draw = tmp_path_factory.mktemp("place"), np.random.default_rng(5)
    points, classes, shapes = [], [], []
    for i, (ring, angle, height) in enumerate([*HOUSES, (BOX, [0] * 4, 4.0), (BOX, [0] * 4, 0.0)]):
        corner = np.array([652100.13 + 40 * i, 6861200.37])
        xy, ground = np.array(ring, float), 140.0 + i
        shapes.append(shapely.Polygon(xy + corner))
        around = draw.uniform(-0.9, -0.1, (60, 2)) * [1, 0] + draw.uniform(0, 8, (60, 2)) * [0, 1]
        points.append(np.column_stack([around + corner, np.full(60, ground)]))
        classes.append(np.full(60, 2))
        if height:
            polygon = Polygons.from_rings([[xy]])
            vertex, triangle, kind, _ = skeleton.build(
                polygon, np.array(angle, float), np.array([height])
            ).mesh(0)
            num_points = 400 if i < len(HOUSES) else 2
            roof = sample_surface(vertex, triangle[kind >= FaceKind.ROOF], num_points, draw)
            points.append(roof + draw.normal(0, 0.03, roof.shape) + [*corner, ground])
            classes.append(np.full(num_points, 6))
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.01), np.array([652000, 6861000, 0])
    header.add_crs(pyproj.CRS.from_epsg(2154))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.concatenate(points).T
    las.classification = np.concatenate(classes).astype(np.uint8)
    las.write(folder / "cloud.laz")
    names = [f"house {i}" for i in range(len(shapes))]
    gpd.GeoDataFrame({"cleabs": names}, geometry=shapes, crs=2154).to_file(folder / "footprints.gpkg")
    return folder


def test_the_report_measures_the_product(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = {"crops": {"min_points": 10}}
    products: list[Reconstruction] = []
    write = exports.write

    def capture(folder: Path, stem: str, results: list, *rest: object) -> list[str]:
        products.extend(result.reconstruction for result in results)
        return write(folder, stem, results, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(exports, "write", capture)

    def run(*arguments: object) -> None:
        assert cli.main([*map(str, arguments), "--config", json.dumps(config)]) == 0

    footprints, cloud, shard = place / "footprints.gpkg", place / "cloud.laz", tmp_path / "shard.parquet"
    run("crops", "real", "--tile", TILE, "--footprints", footprints, "--clouds", cloud, "--out", shard)
    run("crops", "manifest", "--out", tmp_path / "manifest.json", "--real", shard)
    out = tmp_path / "out.parquet"
    files = ["--manifest", tmp_path / "manifest.json", "--out", out]
    run("eval", "reconstruct", "--method", "fit", *files)
    run("reconstruct", cloud, footprints, tmp_path / "out", "--tile", TILE)

    measured = {key[2]: row for key, row in read_reconstructions(out)["fit"].items()}
    assert len(measured) == len(HOUSES) + 2 == len(products)
    for product in products:
        row = measured[product.building_id]
        assert row.method == "fit" and product.method in ("fit", "lod1")
        assert (row.status, row.num_parts, row.ground_z_m) == (
            product.status,
            product.num_parts,
            product.ground_z_m,
        )
        assert row.has_mesh == product.has_mesh
        if row.has_mesh:
            for name in ("vertex_m", "triangle", "kind", "label"):
                assert np.array_equal(getattr(row.mesh, name), getattr(product.mesh, name))
    # few points give a flat roof and none give nothing
    assert [product.status == "ok" for product in products] == [True] * 5 + [False] * 2
    assert [product.has_mesh for product in products] == [True] * 6 + [False]
    assert [product.method == "lod1" for product in products] == [False] * 5 + [True, False]
