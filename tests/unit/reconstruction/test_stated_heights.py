"""Buildings without points stand at the height that their footprint states."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pytest
import shapely
from toy_clouds import LAMBERT, cleaned, cloud_over

from p2wss.clouds.reading import Cloud
from p2wss.config import Reconstruct
from p2wss.data.terrain import Terrain
from p2wss.reconstruction.outputs.attributes import attributes, with_columns
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.result import Result

SQUARE, NEAR, FAR, UNKNOWN = (shapely.box(x, 0, x + 10, 10) for x in (0, 30, 500, 800))


FAR_ALONE = gpd.GeoDataFrame({"building_id": ["far"], "stated_height_m": [7.0]}, geometry=[FAR], crs=LAMBERT)


def results(terrain: Terrain | None = None, cloud: Cloud | None = None) -> list[Result]:
    frame = gpd.GeoDataFrame(
        {"building_id": ["seen", "near", "far", "unknown"], "stated_height_m": [30.0, 5.0, 7.0, np.nan]},
        geometry=[SQUARE, NEAR, FAR, UNKNOWN],
        crs=LAMBERT,
    )
    config = Reconstruct(registration="never")
    return run(cleaned(frame), cloud or cloud_over(SQUARE), None, "t", config, terrain=terrain)


def test_no_points_a_flat_roof_at_the_stated_height() -> None:
    seen, near, far, unknown = results()
    assert (seen.status, seen.reconstruction.eave_height_m) == ("ok", pytest.approx(6.0, abs=0.1))
    for result, height_m in ((near, 5.0), (far, 7.0)):
        assert (result.status, result.reason) == ("flat", "height-from-attribute")
        assert result.reconstruction.eave_height_m == pytest.approx(height_m) and result.num_points == 0
        # the ground of the cloud nearby, else of the nearest building
        assert result.reconstruction.ground_z_m == pytest.approx(2.0)
        z = result.reconstruction.placed_mesh.vertex_m[:, 2]
        assert (z.min(), z.max()) == pytest.approx((2.0, 2.0 + height_m))
        assert not result.is_reliable
    assert (unknown.status, unknown.reason) == ("none", "no-points")
    # and that says whose ground it is
    assert [attributes(each)["ground_source"] for each in (seen, near, far)] == [
        "around",
        "around",
        "nearest-buildings",
    ]
    bare = run(cleaned(FAR_ALONE), cloud_over(SQUARE), None, "t", Reconstruct(registration="never"))[0]
    assert (bare.status, bare.reason) == ("none", "no-ground")
    assert [attributes(bare)[name] for name in ("ground_z_m", "ground_source", "ground_sd_m")] == [None] * 3


def test_terrain_is_their_ground() -> None:
    terrain = Terrain(np.full((10, 1200), 17.0, np.float32), -100.0, 50.0, 10.0)
    seen, near, far, _ = results(terrain)
    assert seen.reconstruction.ground_z_m == pytest.approx(2.0)
    assert near.reconstruction.ground_z_m == far.reconstruction.ground_z_m == pytest.approx(17.0)


def test_ground_alone_inside_a_footprint_is_no_height_either() -> None:
    cloud = cloud_over(SQUARE)
    x, y = np.random.default_rng(1).uniform([30, 0], [40, 10], (200, 2)).T
    ground = Cloud(
        np.concatenate([cloud.x_m, x, x + 770]),
        np.concatenate([cloud.y_m, y, y]),
        np.append(cloud.z_m, np.full(400, 3.0)),
        np.append(cloud.classification, np.full(400, 2)).astype(np.uint8),
        LAMBERT,
    )
    _, near, _, unknown = results(cloud=ground)
    assert (near.status, near.reason, near.num_points) == ("flat", "height-from-attribute", 200)
    assert near.reconstruction.eave_height_m == pytest.approx(5.0)
    # where the footprint states none, the reason is not that of points on the roof that are too few
    assert (unknown.status, unknown.reason, unknown.num_points) == ("none", "no-points-on-building", 200)
    assert [attributes(each, names="3dbag")["b3_dak_type"] for each in (near, unknown)] == ["no points"] * 2


def test_chosen_columns_are_passed_through() -> None:
    frame = gpd.GeoDataFrame(
        {"building_id": ["a"], "usage": ["x"], "floors": [2]}, geometry=[SQUARE], crs=LAMBERT
    )
    (result,) = run(cleaned(frame), cloud_over(SQUARE), None, "t", Reconstruct(registration="never"))
    assert with_columns(result, ["all"]).columns == {"usage": "x", "floors": 2}
    assert with_columns(result, ["floors", "none"]).columns == {"floors": 2}
    assert with_columns(result, []).columns == {}
    assert attributes(with_columns(result, ["usage"]))["usage"] == "x"
    assert "stated_height_m" not in attributes(result)
