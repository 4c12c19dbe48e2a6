"""``p2wss evaluate``: on made buildings whose distances are known, and on real ones against the independent judge."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pytest
import shapely
from places import SHARED

import p2wss
from p2wss import cli
from p2wss.eval.files import evaluate, summary
from p2wss.formats import cityjson
from p2wss.formats.cityjson_read import ReadSolid
from p2wss.mesh import Mesh
from p2wss.mesh.faces import Surface
from p2wss.skeleton.types import FaceKind

DELFT = SHARED / "data" / "delft_ahn3"
JUDGE = SHARED / "tools" / "evaluate_cityjson.py"
CORNER_M = np.array([652000.0, 6861000.0, 40.0])


def box(name: str, east_m: float) -> ReadSolid:
    """10 m by 10 m by 5 m, at a distance east of the corner."""
    x, y, z = np.meshgrid([0, 10], [0, 10], [0, 5], indexing="ij")
    vertex = np.column_stack([x.ravel(), y.ravel(), z.ravel()]) + CORNER_M + [east_m, 0, 0]
    faces = {FaceKind.GROUND: [[0, 2, 6, 4]], FaceKind.ROOF: [[1, 5, 7, 3]]}
    faces[FaceKind.WALL] = [[0, 4, 5, 1], [4, 6, 7, 5], [6, 2, 3, 7], [2, 0, 1, 3]]
    quads = [(kind, quad) for kind, members in faces.items() for quad in members]
    triangle = np.array([[quad[i] for i in half] for _, quad in quads for half in ((0, 1, 2), (0, 2, 3))])
    kind = np.repeat([int(kind) for kind, _ in quads], 2).astype(np.uint8)
    return ReadSolid(name, Mesh(vertex, triangle, kind, np.repeat(np.arange(6), 2)), {})


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Footprints of four boxes, and a cloud with points 0.3 m above the roofs of the first three."""
    folder, draw = tmp_path_factory.mktemp("place"), np.random.default_rng(1)
    shapes = [shapely.box(0, 0, 10, 10) for _ in range(4)]
    shapes = [shapely.affinity.translate(s, 652000 + 30 * i, 6861000) for i, s in enumerate(shapes)]
    frame = gpd.GeoDataFrame({"building_id": list("abcd")}, geometry=shapes, crs=2154)
    # in another CRS than the cloud
    frame.to_crs(4326).to_file(folder / "footprints.gpkg")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), CORNER_M
    header.add_crs(frame.crs)
    las = laspy.LasData(header)
    roof = np.column_stack([draw.uniform(0.01, 9.99, (9000, 2)), np.full(9000, 5.3)])
    las.x, las.y, las.z = (roof + CORNER_M + np.repeat([[0, 0, 0], [30, 0, 0], [60, 0, 0]], 3000, 0)).T
    las.classification = np.full(9000, 6, np.uint8)
    las.write(folder / "cloud.laz")
    return folder / "footprints.gpkg", folder / "cloud.laz"


def test_the_distance_to_a_box_is_the_height_above_it(place: tuple[Path, Path]) -> None:
    footprints, cloud = place
    bent = box("b", 30.0)
    bent = replace(bent, mesh=bent.mesh.part(np.arange(1, 12)))
    table = evaluate([box("a", 0.0), bent], footprints, [cloud])
    assert list(table["status"]) == ["ok", "ok", "no mesh", "too few points"]
    assert list(table["num_points"]) == [3000, 3000, 3000, 0]
    assert list(table["num_triangles"][:2]) == [12, 11] and list(table["is_watertight"][:2]) == [True, False]
    # samples are a few centimetres apart
    assert table["points_to_mesh_m"].iloc[0] == pytest.approx(0.3, abs=0.01)
    assert table["roof_cd_m"].iloc[0] == pytest.approx(0.33, abs=0.02)
    assert table["cd_m"].iloc[0] > 1  # walls and ground have no points
    assert summary(table).loc["mean", "num_triangles"] == 11.5


def test_level_faces_of_a_reconstruction_are_roofs_too(place: tuple[Path, Path]) -> None:
    solid = box("a", 0.0)
    is_roof = solid.mesh.kind == FaceKind.ROOF
    level = replace(solid.mesh, kind=np.where(is_roof, FaceKind.FLAT, solid.mesh.kind).astype(np.uint8))
    footprints, cloud = place
    tables = [evaluate([each], footprints, [cloud]) for each in (solid, replace(solid, mesh=level))]
    assert tables[0].equals(tables[1])


def test_buildings_without_a_known_id_are_those_of_the_footprints_that_they_overlap(
    place: tuple[Path, Path],
) -> None:
    by_id = evaluate([box("a", 0.0), box("b", 30.0)], *place[:1], [place[1]])
    attributes = {"building_id": "b"}
    named = [box("x", 1.0), replace(box("y", 33.0), attributes=attributes), box("z", 500.0)]
    table = evaluate(named, *place[:1], [place[1]])
    assert list(table["status"]) == list(by_id["status"])
    # two solids over one footprint are its mesh together
    pair = evaluate([box("x", -2.0), box("y", 3.0)], *place[:1], [place[1]])
    # as those of its parts are, which have its id among their attributes
    parts = [replace(box(name, east), attributes={"id": "a"}) for name, east in (("a-1", -2.0), ("a-2", 3.0))]
    of_parts = evaluate(parts, *place[:1], [place[1]])
    assert pair["num_triangles"].iloc[0] == of_parts["num_triangles"].iloc[0] == 24
    # each is closed where they touch, too
    touching = evaluate([box("x", -5.0), box("y", 5.0)], *place[:1], [place[1]])
    assert touching["num_triangles"].iloc[0] == 24 and touching["is_watertight"].iloc[0]


def test_numbers_of_another_program_are_no_ids_of_footprints_elsewhere(
    place: tuple[Path, Path], caplog: pytest.LogCaptureFixture
) -> None:
    footprints, cloud = place
    right = evaluate([box("a", 0.0), box("b", 30.0)], footprints, cloud)
    with caplog.at_level("WARNING", "p2wss"):
        exchanged = evaluate([box("b", 0.0), box("a", 30.0)], footprints, cloud)
    assert exchanged.equals(right)
    assert "not on the footprint of their id: 2" in caplog.text


def test_points_on_roofs_are_those_of_the_classes_of_the_producer(
    place: tuple[Path, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    footprints, cloud = place
    las = laspy.read(cloud)
    las.classification = np.full(len(las), 67, np.uint8)
    las.write(tmp_path / "cloud.laz")
    config = tmp_path / "classes.yaml"
    config.write_text("region: {classes: {preset: custom, building: [67], ground: [2]}}", encoding="utf-8")
    solid = box("a", 0.0).mesh
    faces = [
        Surface(kind, -1, [rings])
        for kind, rings in zip(solid.kind.tolist(), solid.triangle.tolist(), strict=True)
    ]
    scene = cityjson.document_pieces([cityjson.Solid("a", solid.vertex_m, faces)], cityjson.Metadata())
    (tmp_path / "x.city.json").write_text("".join(scene), encoding="utf-8")
    files = [str(each) for each in (tmp_path / "x.city.json", footprints, tmp_path / "cloud.laz")]
    csv = str(tmp_path / "x.csv")
    assert cli.main(["evaluate", *files, "--csv", csv]) == 0
    assert "no point on the footprints has class 6" in caplog.text
    assert cli.main(["evaluate", *files, "--csv", csv, "--config", str(config)]) == 0
    assert pd.read_csv(csv)["points_to_mesh_m"].iloc[0] == pytest.approx(0.3, abs=0.05)
    of_python = p2wss.evaluate(*files, config=config)
    assert of_python.to_csv(float_format="%.4f", lineterminator="\n") == Path(csv).read_text(encoding="utf-8")


@pytest.mark.skipif(not JUDGE.is_file(), reason="no real data beside the checkout")
def test_every_building_of_delft_agrees_with_the_independent_judge_to_a_millimetre(tmp_path: Path) -> None:
    paths = [str(DELFT / name) for name in ("roofer_lod22.city.jsonl", "footprints.gpkg", "ahn3.laz")]
    assert cli.main(["evaluate", *paths, "--csv", str(tmp_path / "rows.csv")]) == 0
    table = pd.read_csv(tmp_path / "rows.csv", index_col="building_id")
    words = [sys.executable, str(JUDGE), *paths, "--json"]
    completed = subprocess.run(words, capture_output=True, text=True, check=True)
    judged = pd.DataFrame(json.loads(completed.stdout)["rows"]).set_index("id")
    assert len(table) == 74 and list(table.index) == list(judged.index)
    columns = {"cd": "cd_m", "roof": "roof_cd_m", "p2m": "points_to_mesh_m"}
    for theirs, ours in columns.items():
        assert (judged[theirs] - table[ours]).abs().max() < 0.001
    assert (judged["tri"] == table["num_triangles"]).all()
    assert (judged["watertight"] == table["is_watertight"]).all()
