"""Every footprint of a hostile file gets a mesh or a reason, and one bad one costs the others nothing."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pytest
import shapely
import trimesh
from oracle_network import Oracle
from toy_clouds import LAMBERT, cleaned

from p2wss import reconstruct
from p2wss.config import Reconstruct
from p2wss.data.clouds import Cloud
from p2wss.reconstruct import pipeline

GROUND_M, ROOF_M = 100.0, 107.0


def gabled(x: np.ndarray, y: np.ndarray, middle: float, half: float) -> np.ndarray:
    """A ridge along y."""
    return ROOF_M + 0.7 * np.maximum(half - np.abs(x - middle), 0)


class Scene:
    """Footprints and points that are added one building at a time, 100 m apart."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.shapes: list[shapely.Geometry | None] = []
        self.points: list[np.ndarray] = []
        self.draw = np.random.default_rng(5)

    def add(
        self,
        name: str,
        shape: shapely.Geometry | None,
        num_points: int = 400,
        classes: tuple[int, int] = (6, 2),
        within: shapely.Geometry | None = None,
        half_m: float = 5.0,
    ) -> None:
        """classes: of the points on the roof and of those on the ground around; 0 for no such points. within:
        the part of the roof that has points."""
        place = np.array([652000.0 + 100 * len(self.names), 6861000.0])
        self.names.append(name)
        if shape is not None:
            shape = shapely.transform(shape, lambda xy: xy + place)
        self.shapes.append(shape)
        if shape is None or shape.is_empty or not num_points:
            return
        area = shapely.box(*shape.bounds)
        x0, y0, x1, y1 = area.bounds
        seen = shape.buffer(0) if within is None else shapely.transform(within, lambda xy: xy + place)
        xy = self.draw.uniform([x0, y0], [x1, y1], (60 * num_points, 2))
        xy = xy[shapely.contains_xy(seen, *xy.T)][:num_points]
        z = gabled(*xy.T, (x0 + x1) / 2, half_m)
        if classes[0]:
            self.points.append(np.column_stack([xy, z, np.full(len(xy), classes[0])]))
        if classes[1]:
            count = 80
            ring = np.column_stack([np.full(count, x0 - 0.5), np.linspace(y0, y1, count)])
            self.points.append(np.column_stack([ring, np.full(count, GROUND_M), np.full(count, classes[1])]))

    def results(self, predictor: Oracle | None, config: Reconstruct) -> dict[str, reconstruct.Result]:
        x, y, z, classification = np.concatenate(self.points).T
        cloud = Cloud(x, y, z, classification.astype(np.uint8), LAMBERT)
        shapes = gpd.GeoSeries(self.shapes, crs=LAMBERT)
        frame = gpd.GeoDataFrame({"building_id": self.names}, geometry=shapes)
        found = reconstruct.run(cleaned(frame), cloud, predictor, "tile", config)
        return {result.reconstruction.building_id: result for result in found}


HOUSE = shapely.box(0, 0, 10, 14)
COURTYARD = shapely.Polygon([(0, 0), (24, 0), (24, 24), (0, 24)], [[(8, 8), (8, 16), (16, 16), (16, 8)]])
COMB = shapely.union_all(
    [shapely.box(0, 0, 60, 8), *(shapely.box(4 * i, 8, 4 * i + 2, 14) for i in range(15))]
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    scene = Scene()
    scene.add("good", HOUSE)
    scene.add("no point", HOUSE, num_points=0)
    scene.add("one point", HOUSE, num_points=1, classes=(6, 0))
    scene.add("ten points", HOUSE, num_points=10, classes=(6, 0))
    scene.add("ten points and ground", HOUSE, num_points=10)
    scene.add("no class 6", HOUSE, classes=(1, 2))
    scene.add("no ground", HOUSE, classes=(6, 0))
    scene.add("ground only", HOUSE, classes=(0, 2))
    scene.add("half seen", HOUSE, within=shapely.box(0, 0, 10, 7))
    scene.add("courtyard", COURTYARD, num_points=2000, half_m=12.0)
    scene.add("comb", COMB, num_points=3000, half_m=0.0)
    scene.add("two parts", shapely.union_all([HOUSE, shapely.box(20, 0, 30, 14)]))
    scene.add("bow tie", shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)]))
    scene.add("line", shapely.Polygon([(0, 0), (10, 0), (5, 0)]))
    scene.add("speck", shapely.box(0, 0, 0.05, 0.05))
    scene.add("empty", shapely.Polygon())
    scene.add("missing", None)
    scene.add("not a polygon", shapely.Point(3, 3).buffer(0).union(shapely.LineString([(0, 0), (9, 9)])))
    return scene


def check(found: dict[str, reconstruct.Result]) -> None:
    for name, result in found.items():
        made = result.reconstruction
        assert result.status in ("ok", "flat", "none"), name
        assert (result.reason is None) == (result.status == "ok"), name
        assert made.has_mesh == (result.status != "none"), name
        if made.has_mesh:
            mesh = trimesh.Trimesh(made.vertex_m, made.triangle, process=False)
            assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, name
            # without a point on the roof there is the network's guess, and nothing to hold against it
            assert result.residual_m < 1 or result.status == "flat" or result.visible_share == 0, name
        attributes = reconstruct.attributes(result)
        assert attributes["num_parts"] == (made.num_parts if made.has_mesh else None)
        assert attributes["visible_share"] is None or 0 <= attributes["visible_share"] <= 1


@pytest.mark.parametrize("predictor", [None, Oracle()], ids=["fit", "network and fit"])
def test_a_mesh_or_a_reason(scene: Scene, predictor: Oracle | None) -> None:
    found = scene.results(predictor, Reconstruct())
    check(found)
    with_mesh = {name for name, result in found.items() if result.status == "ok"}
    assert with_mesh >= {"good", "ten points", "no class 6", "no ground", "half seen", "courtyard", "comb"}
    assert with_mesh >= {"ten points and ground", "two parts-1", "two parts-2"}
    assert found["no point"].reason == "no-points"
    assert (found["one point"].status, found["one point"].reason) == ("flat", "too-few-points")
    # a flat roof at no height would be a guess; the network's is one
    assert found["ground only"].status == ("none" if predictor is None else "ok")
    assert found["ground only"].visible_share == 0
    for name in ("line", "speck", "empty", "missing", "not a polygon"):
        assert found[name].status == "none" and found[name].reason, name
    assert any(name.startswith("bow tie") and found[name].reconstruction.has_mesh for name in found)
    names = {name.split("-")[0] for name in found}
    assert names == set(scene.names)
    # 10 m wide, 35 degrees: 3.5 m over the eave
    good = found["good"].reconstruction
    assert good.eave_height_m == pytest.approx(ROOF_M - GROUND_M, abs=0.1)
    assert good.vertex_m[:, 2].max() == pytest.approx(ROOF_M + 3.5 - GROUND_M, abs=0.2)


def test_visible_share_is_that_of_cells_with_a_point(scene: Scene) -> None:
    found = scene.results(None, Reconstruct(max_parts=1))
    # 140 cells and 400 points: e^-2.9 of the cells have none
    assert found["good"].visible_share == pytest.approx(0.94, abs=0.05)
    assert found["half seen"].visible_share == pytest.approx(0.5, abs=0.03)
    assert found["one point"].visible_share == pytest.approx(1 / 140, abs=1e-3)
    assert found["no point"].visible_share == 0 and found["ground only"].visible_share == 0


def test_what_one_roof_cannot_be_is_flagged() -> None:
    """A tower over half of a house: one height leaves metres, two heights centimetres."""
    scene = Scene()
    scene.add("good", HOUSE)
    scene.add("tower", shapely.box(0, 0, 20, 10), num_points=800, half_m=0.0)
    roof = scene.points[-2]
    high = roof[:, 0] > roof[:, 0].mean()
    roof[:, 2] = np.where(high, ROOF_M + 9, ROOF_M)
    one = scene.results(None, Reconstruct(max_parts=1))
    assert one["tower"].not_representable and one["tower"].residual_m > 1
    assert not one["good"].not_representable
    assert "1 of them not representable" in reconstruct.summary(list(one.values()))
    two = scene.results(None, Reconstruct())
    assert two["tower"].reconstruction.num_parts == 2 and not two["tower"].not_representable
    # the network alone was not fitted: its error is no fault of the building
    network_alone = scene.results(Oracle(), Reconstruct(fit=False))
    assert not network_alone["tower"].not_representable


def test_batches_and_progress_change_nothing(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    config = Reconstruct(max_parts=1)
    whole = scene.results(Oracle(), config)
    monkeypatch.setattr(pipeline, "_BATCH", 4)
    parts = scene.results(Oracle(), config)
    assert list(whole) == list(parts)
    for name, result in whole.items():
        assert np.array_equal(result.reconstruction.vertex_m, parts[name].reconstruction.vertex_m)
        assert reconstruct.attributes(result) == reconstruct.attributes(parts[name])
