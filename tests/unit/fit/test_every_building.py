"""Every footprint of a difficult file gets a mesh or a reason, and a bad one does not affect the others."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pytest
import shapely
import trimesh
from oracle_network import Oracle
from toy_clouds import LAMBERT, cleaned

from p2wss.clouds.reading import Cloud
from p2wss.config import Reconstruct
from p2wss.reconstruction import pipeline
from p2wss.reconstruction.outputs.attributes import attributes as reconstruct_attributes
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.result import Result, summary

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
        visible = shape.buffer(0) if within is None else shapely.transform(within, lambda xy: xy + place)
        xy = self.draw.uniform([x0, y0], [x1, y1], (60 * num_points, 2))
        xy = xy[shapely.contains_xy(visible, *xy.T)][:num_points]
        z = gabled(*xy.T, (x0 + x1) / 2, half_m)
        if classes[0]:
            self.points.append(np.column_stack([xy, z, np.full(len(xy), classes[0])]))
        if classes[1]:
            count = 80
            ring = np.column_stack([np.full(count, x0 - 0.5), np.linspace(y0, y1, count)])
            self.points.append(np.column_stack([ring, np.full(count, GROUND_M), np.full(count, classes[1])]))

    def results(self, predictor: Oracle | None, config: Reconstruct) -> dict[str, Result]:
        x, y, z, classification = np.concatenate(self.points).T
        cloud = Cloud(x, y, z, classification.astype(np.uint8), LAMBERT)
        shapes = gpd.GeoSeries(self.shapes, crs=LAMBERT)
        frame = gpd.GeoDataFrame({"building_id": self.names}, geometry=shapes)
        results = run(cleaned(frame), cloud, predictor, "tile", config)
        return {result.reconstruction.building_id: result for result in results}


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


def check(results: dict[str, Result], is_fitted: bool) -> None:
    for name, result in results.items():
        reconstruction = result.reconstruction
        assert result.status in ("ok", "flat", "none"), name
        assert (result.reason is None) == (result.status == "ok"), name
        assert reconstruction.has_mesh == (result.status != "none"), name
        if reconstruction.has_mesh:
            mesh = trimesh.Trimesh(reconstruction.mesh.vertex_m, reconstruction.mesh.triangle, process=False)
            assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, name
            assert result.residual_m < 1 or result.status == "flat" or not is_fitted, name
        attributes = reconstruct_attributes(result)
        assert attributes["num_parts"] == (reconstruction.num_parts if reconstruction.has_mesh else None)
        assert attributes["visible_share"] is None or 0 <= attributes["visible_share"] <= 1


@pytest.mark.parametrize("predictor", [None, Oracle()], ids=["fit", "network"])
def test_a_mesh_or_a_reason(scene: Scene, predictor: Oracle | None) -> None:
    results = scene.results(predictor, Reconstruct())
    check(results, predictor is None)
    with_mesh = {name for name, result in results.items() if result.status == "ok"}
    assert with_mesh >= {"good", "ten points", "no class 6", "no ground", "half seen", "courtyard", "comb"}
    assert with_mesh >= {"ten points and ground", "two parts-1", "two parts-2"}
    assert results["no point"].reason == "no-points"
    assert (results["one point"].status, results["one point"].reason) == ("flat", "too-few-points")
    # without points on the roof only the network has a height
    assert results["ground only"].status == ("none" if predictor is None else "ok")
    assert results["ground only"].visible_share == 0
    for name in ("line", "speck", "empty", "missing", "not a polygon"):
        assert results[name].status == "none" and results[name].reason, name
    assert any(name.startswith("bow tie") and results[name].reconstruction.has_mesh for name in results)
    names = {name.split("-")[0] for name in results}
    assert names == set(scene.names)
    if predictor is not None:
        return
    # 10 m wide, 35 degrees: 3.5 m over the eave
    good = results["good"].reconstruction
    assert good.eave_height_m == pytest.approx(ROOF_M - GROUND_M, abs=0.1)
    assert good.mesh.vertex_m[:, 2].max() == pytest.approx(ROOF_M + 3.5 - GROUND_M, abs=0.2)


def test_visible_share_is_the_share_of_cells_with_a_point(scene: Scene) -> None:
    results = scene.results(None, Reconstruct(roofs="parametric"))
    # 140 cells and 400 points: e^-2.9 of the cells have none
    assert results["good"].visible_share == pytest.approx(0.94, abs=0.05)
    assert results["half seen"].visible_share == pytest.approx(0.5, abs=0.03)
    assert results["one point"].visible_share == pytest.approx(1 / 140, abs=1e-3)
    assert results["no point"].visible_share == 0 and results["ground only"].visible_share == 0


def test_a_building_that_one_roof_cannot_describe_is_flagged() -> None:
    """A tower over half of a house: one height leaves metres, two heights centimetres."""
    scene = Scene()
    scene.add("good", HOUSE)
    scene.add("tower", shapely.box(0, 0, 20, 10), num_points=800, half_m=0.0)
    roof = scene.points[-2]
    high = roof[:, 0] > roof[:, 0].mean()
    roof[:, 2] = np.where(high, ROOF_M + 9, ROOF_M)
    single = scene.results(None, Reconstruct(roofs="parametric"))
    assert single["tower"].not_representable and single["tower"].residual_m > 1
    assert not single["good"].not_representable
    assert "1 of them not representable" in summary(list(single.values()))
    several = scene.results(None, Reconstruct())
    assert several["tower"].reconstruction.num_parts == 2 and not several["tower"].not_representable
    # the network's own values are not fitted: a large residual does not mean that the building is not representable
    network_alone = scene.results(Oracle(), Reconstruct())
    assert not network_alone["tower"].not_representable


def test_batches_and_progress_change_nothing(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    config = Reconstruct(roofs="parametric")
    whole = scene.results(Oracle(), config)
    monkeypatch.setattr(pipeline, "_NETWORK_BATCH", 4)
    parts = scene.results(Oracle(), config)
    assert list(whole) == list(parts)
    for name, result in whole.items():
        both = result.reconstruction, parts[name].reconstruction
        assert both[0].has_mesh == both[1].has_mesh
        assert not both[0].has_mesh or np.array_equal(both[0].mesh.vertex_m, both[1].mesh.vertex_m)
        assert reconstruct_attributes(result) == reconstruct_attributes(parts[name])
