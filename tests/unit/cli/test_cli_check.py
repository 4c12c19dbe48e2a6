"""``p2wss check``: valid and invalid files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import p2wss
from p2wss import cli, skeleton
from p2wss.formats import cityjson
from p2wss.mesh import Mesh
from p2wss.skeleton.types import Polygons


@pytest.fixture
def city(tmp_path: Path) -> Path:
    """Two hip roofs as one document."""
    ring = np.array([[0, 0], [12, 0], [12, 8], [0, 8]], float)
    meshes = skeleton.build(Polygons.from_rings([[ring]]), np.full(4, 40.0), np.array([5.0]))
    mesh = Mesh.of_kernel(meshes, 0)
    solids = [
        cityjson.Solid(name, mesh.vertex_m + np.array([x, 0, 0]), mesh.surfaces)
        for name, x in (("a", 0), ("b", 20))
    ]
    path = tmp_path / "city.city.json"
    path.write_text("".join(cityjson.document_pieces(solids, cityjson.Metadata(2154))))
    return path


def test_the_files_of_a_folder_are_checked(city: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken(city)
    assert cli.main(["check", str(city.parent)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"{city}: 2 solids, 0 invalid" and lines[1].endswith(
        "broken.city.json: 2 solids, 1 invalid"
    )


def broken(path: Path) -> Path:
    """The file with the roof of building b turned round."""
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    shell = document["CityObjects"]["b"]["geometry"][0]["boundaries"][0]
    shell[0][0] = shell[0][0][::-1]
    other = path.with_name("broken.city.json")
    other.write_text(json.dumps(document))
    return other


def test_a_folder_without_cityjson_is_one_line(city: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = city.parent / "empty"
    empty.mkdir()
    assert cli.main(["check", str(city), str(empty)]) == 2
    assert capsys.readouterr() == (
        "",
        f"p2wss: error: {empty}: has no CityJSON files\n",
    )


def test_a_valid_file(city: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(city)]) == 0
    assert capsys.readouterr().out == f"{city}: 2 solids, 0 invalid\n"


def test_an_invalid_file_has_a_line_per_solid(city: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = broken(city)
    assert cli.main(["check", str(city), str(path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{city}: 2 solids, 0 invalid"
    assert lines[1].startswith(f"{path}: b (LoD 2.0): 307 faces of the shell")
    assert lines[2] == f"{path}: 2 solids, 1 invalid"


def test_a_sequence_is_read_too(city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = json.loads(broken(city).read_text())
    header = {**document, "CityObjects": {}, "vertices": []}
    features = [
        {
            "type": "CityJSONFeature",
            "id": name,
            "CityObjects": {name: value},
            "vertices": document["vertices"],
        }
        for name, value in document["CityObjects"].items()
    ]
    path = tmp_path / "a.city.jsonl"
    path.write_text("\n".join(map(json.dumps, [header, *features])))
    assert cli.main(["check", str(path)]) == 1
    assert capsys.readouterr().out.count("307") == 1


def test_files_without_solids_are_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "empty.json"
    path.write_text("".join(cityjson.document_pieces([], cityjson.Metadata(2154))))
    assert cli.main(["check", str(path)]) == 2
    assert "has no solids" in capsys.readouterr().err
    assert cli.main(["check", str(tmp_path / "missing")]) == 2


@pytest.mark.parametrize(
    ("east_m", "breach"),
    [(6.0, "501 solids of a composite overlap"), (11.9, "501 solids of a composite overlap"), (12.0, "")]
    + [(east_m, "503 solids of a composite are apart") for east_m in (12.01, 30.0)],
)
@pytest.mark.parametrize("kind", ["CompositeSolid", "MultiSolid"])
def test_solids_of_a_composite_touch_and_do_not_overlap(
    city: Path, tmp_path: Path, east_m: float, breach: str, kind: str
) -> None:
    document: dict[str, Any] = json.loads(city.read_text(encoding="utf-8"))
    scale = document["transform"]["scale"][0]
    first, second = (document["CityObjects"][name]["geometry"][0] for name in "ab")
    # the second house from 20 m to the stated distance from the first
    moved = {index for shell in second["boundaries"] for face in shell for ring in face for index in ring}
    for index in moved:
        document["vertices"][index][0] += round((east_m - 20.0) / scale)
    first["boundaries"] = [first["boundaries"], second["boundaries"]]
    first["type"] = kind
    first.pop("semantics", None)
    del document["CityObjects"]["b"]
    path = tmp_path / "composite.city.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    validity = p2wss.check(path)
    assert validity.num_solids == 2
    expected = [[breach]] if breach and kind == "CompositeSolid" else []
    assert list(validity.invalid.values()) == expected


@pytest.mark.parametrize("is_sequence", [False, True])
def test_templates_are_read_where_they_are_placed(
    city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], is_sequence: bool
) -> None:
    """As if each object had its own geometry: CityJSON 2.0, 3.4."""
    document = json.loads(city.read_text(encoding="utf-8"))
    transform = document["transform"]
    vertices = np.array(document["vertices"]) * transform["scale"] + transform["translate"]
    templates = [
        geometry for each in document["CityObjects"].values() for geometry in each.get("geometry", [])
    ]
    place = {
        "type": "GeometryInstance",
        "template": 0,
        "boundaries": [1],
        "transformationMatrix": [2, 0, 0, 5, 0, 2, 0, 7, 0, 0, 2, 0, 0, 0, 0, 1],
    }
    document["CityObjects"] = {"a": {"type": "Building", "geometry": [place]}}
    document |= {
        "vertices": [[0, 0, 0], [3000, 2000, 0]],
        "transform": {"scale": [0.01] * 3, "translate": [0] * 3},
    }
    document["geometry-templates"] = {"templates": templates[:1], "vertices-templates": vertices.tolist()}
    path = tmp_path / "templates.city.json"
    feature = {"type": "CityJSONFeature", "id": "a"}
    feature |= {name: document[name] for name in ("CityObjects", "vertices")}
    rest = document | {"CityObjects": {}, "vertices": []}
    path.write_text(f"{json.dumps(rest)}\n{json.dumps(feature)}" if is_sequence else json.dumps(document))
    assert cli.main(["check", str(path)]) == 0
    placed, alone = p2wss.read(path)["a"].solid, p2wss.read(city)["a"].solid
    assert placed is not None and alone is not None
    assert np.allclose(placed.vertex_m[placed.triangle], 2 * alone.vertex_m[alone.triangle] + [35, 27, 0])
    document["geometry-templates"]["vertices-templates"] = vertices[:3].tolist()
    path.write_text(json.dumps(document))
    assert cli.main(["check", str(path)]) == 2
    assert "a template has the vertex" in capsys.readouterr().err
