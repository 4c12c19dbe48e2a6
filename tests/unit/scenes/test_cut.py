from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from places import SHARED

from p2wss.cli import main
from p2wss.cli.common import check_failures
from p2wss.config import Crops, Scenes, load
from p2wss.crops.rows import assign_splits
from p2wss.data import polygon_arrays
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import tile_bounds
from p2wss.scenes.cut import (
    NEIGHBOUR_DISTANCE_M,
    count_buildings,
    cut_scene,
    party_walls,
)
from p2wss.storage import files
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.buildings import BUILDINGS
from p2wss.storage.schemas.scene import SCENE, read_scene, write_scene

OLEMPS = SHARED / "data" / "olemps_bdtopo"
TILE_M = 1000
CONFIG = Scenes(margin_m=50)


def town(seed: int = 0, number: int = 150) -> gpd.GeoDataFrame:
    """Boxes on a 40 m grid over four tiles, some of them in rows that touch."""
    rng = np.random.default_rng(seed)
    x = 652000 + 40 * rng.permutation(50)[:, None] + np.array([0.0, 8.0, 16.0])
    y = 6861000 + 40 * rng.permutation(50)[:, None] + np.zeros(3)
    x, y = x.ravel()[:number], y.ravel()[:number]
    return gpd.GeoDataFrame(
        {
            "building_id": [f"B{i:03d}" for i in range(len(x))],
            "hauteur_m": np.where(rng.random(len(x)) < 0.2, np.nan, 6.0),
        },
        geometry=shapely.box(x, y, x + 8, y + 10),
        crs="EPSG:2154",
    )


def flat(z: float = 40.0) -> Terrain:
    return Terrain(np.full((480, 480), z, np.float32), 651800 - 2.5, 6863200 + 2.5, 5.0)


def window(frame: gpd.GeoDataFrame, tile: str, config: Scenes = CONFIG) -> Features:
    x_min, y_min, x_max, y_max = tile_bounds(tile, TILE_M, config.margin_m + NEIGHBOUR_DISTANCE_M)
    return Features.of(frame.cx[x_min:x_max, y_min:y_max])


TILES = ["0652_6862", "0653_6862", "0652_6863", "0653_6863"]


def test_every_building_is_in_one_tile() -> None:
    frame = town()
    scenes = [cut_scene(window(frame, tile), flat(), tile, TILE_M, CONFIG) for tile in TILES]
    in_tile = pd.concat([scene[scene["in_tile"]] for scene in scenes])
    assert sorted(in_tile["building_id"]) == sorted(frame["building_id"])
    counts = count_buildings(Features.of(frame), TILE_M, CONFIG.min_area_m2)
    assert counts == in_tile["tile"].value_counts().to_dict()
    middle = frame.set_index("building_id").centroid
    for scene in scenes:
        x_min, y_min, x_max, y_max = tile_bounds(scene["tile"].iloc[0], TILE_M, CONFIG.margin_m)
        near = middle[(middle.x >= x_min) & (middle.x <= x_max) & (middle.y >= y_min) & (middle.y <= y_max)]
        assert set(scene["building_id"]) == set(near.index)


def test_a_hall_whose_middle_is_far_away_is_in_the_scene_of_the_house_beside_it() -> None:
    """It occludes the house, which shares points with it and so must not be in another split."""
    house, far_house = (
        shapely.box(652990, 6861500, 652999, 6861510),
        shapely.box(653080, 6861300, 653090, 6861310),
    )
    hall = shapely.box(653000, 6861495, 653160, 6861535)
    columns = {"building_id": ["house", "far", "hall"], "hauteur_m": 6.0}
    frame = gpd.GeoDataFrame(columns, geometry=[house, far_house, hall], crs="EPSG:2154")
    scenes = {tile: cut_scene(window(frame, tile), flat(), tile, TILE_M, CONFIG) for tile in TILES[:2]}
    assert scenes["0652_6862"]["building_id"].tolist() == ["hall", "house"]
    assert scenes["0652_6862"]["in_tile"].tolist() == [False, True]
    splits = []
    for scene in scenes.values():
        polygons = polygon_arrays.to_polygons(scene.geometry.to_numpy())
        # the border of the tiles is one of blocks
        of_seeds = [assign_splits(polygons, Crops(seed=seed, block_size_m=100)) for seed in range(20)]
        splits.append([split[scene["building_id"] == "house"].tolist() for split in of_seeds])
    assert splits[0] == splits[1] and ["guard"] in splits[0]


def test_a_building_is_the_same_in_each_scene_and_in_any_order() -> None:
    frame = town()
    seen: dict[str, tuple] = {}
    shuffled = frame.sample(frac=1, random_state=3)
    for tile in TILES:
        for source in (frame, shuffled):
            scene = cut_scene(window(source, tile), flat(), tile, TILE_M, CONFIG)
            for row in scene.itertuples():
                values = (
                    row.roof_type,
                    tuple(row.angle_deg),
                    row.eave_height_m,
                    row.terrain_z_m,
                    row.geometry.wkt,
                )
                assert seen.setdefault(row.building_id, values) == values
    assert len(seen) == len(frame)


def test_columns_match_the_schema(tmp_path: Path) -> None:
    frame = town()
    frame.loc[3, "geometry"] = shapely.box(0, 0, 1, 1)
    scene = cut_scene(window(frame, TILES[0]), flat(), TILES[0], TILE_M, CONFIG)
    write_scene(tmp_path / "s.parquet", scene, {"tile": TILES[0]})
    back, facts = read_scene(tmp_path / "s.parquet")
    assert facts == {"tile": TILES[0]}
    assert list(back.columns) == [*SCENE.names, "geometry"]
    assert back.crs == frame.crs
    good = back[back["status"] == "ok"]
    assert (
        good["angle_deg"].map(len) == good.geometry.map(lambda shape: len(shape.exterior.coords) - 1)
    ).all()
    assert (good["terrain_z_m"] == 40).all() and (good["base_z_m"] == 40).all()


def test_excluded_buildings_keep_their_row() -> None:
    frame = town(number=6)
    frame["geometry"] = [shapely.box(652100 + 30 * i, 6861500, 652110 + 30 * i, 6861510) for i in range(6)]
    frame.loc[1, "geometry"] = shapely.box(652130, 6861500, 652131, 6861501)
    frame["hauteur_m"] = [5.0, 5.0, 120.0, 5.0, 5.0, 5.0]
    terrain = flat()
    terrain.height_m[:, round((652190 - 651800) / 5) : round((652202 - 651800) / 5)] = np.nan
    scene = cut_scene(Features.of(frame), terrain, "0652_6862", TILE_M, CONFIG)
    assert list(scene["status"]) == ["ok", "too-small", "too-high", "no-terrain", "ok", "ok"]
    bad = scene[scene["status"] != "ok"]
    assert bad.geometry.is_empty.all() and bad["eave_height_m"].isna().all()
    assert (bad["angle_deg"].map(len) == 0).all()


def test_an_empty_window_gives_an_empty_scene() -> None:
    scene = cut_scene(Features.of(town().iloc[:0]), flat(), TILES[0], TILE_M, CONFIG)
    assert len(scene) == 0 and list(scene.columns) == [*SCENE.names, "geometry"]


def test_party_walls_agree_with_sampled_distances() -> None:
    """A row of three, one of them set back, one 0.2 m away, one far away. The reference samples points on the edges."""
    shapes = [
        shapely.box(0, 0, 8, 10),
        shapely.box(8, 2, 16, 12),
        shapely.box(16.2, 0, 24, 10),
        shapely.box(26, 0, 34, 10),
        shapely.box(8, 12, 11, 16),
    ]
    polygons = np.array([shapely.orient_polygons(shape) for shape in shapes])
    for building, flags in enumerate(party_walls(polygons)):
        others = shapely.union_all(np.delete(polygons, building))
        ring = np.array(polygons[building].exterior.coords)
        for start, end, flag in zip(ring[:-1], ring[1:], flags, strict=True):
            along = shapely.points(start + np.linspace(0, 1, 101)[:, None] * (end - start))
            assert flag == (np.mean(shapely.distance(along, others) <= 0.3) >= 0.5)


def write_inputs(folder: Path) -> tuple[Path, Path]:
    town().to_file(folder / "f.gpkg")
    from p2wss.data.terrain import write_terrain

    write_terrain(folder / "dtm.tif", flat(), "EPSG:2154", {})
    return folder / "f.gpkg", folder / "dtm.tif"


def cut(folder: Path, tile: str, footprints: Path, dtm: Path, config: str = "{}") -> int:
    inputs = ["--tile", tile, "--footprints", str(footprints), "--dtm", str(dtm)]
    outputs = ["--out", str(folder / "out.parquet"), "--out-dtm", str(folder / "out.tif")]
    return main(["scenes", "cut", *inputs, *outputs, "--config", config])


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    footprints, dtm = write_inputs(tmp_path)
    assert (
        main(["scenes", "index", "--footprints", str(footprints), "--out", str(tmp_path / "index.tsv")]) == 0
    )
    lines = (tmp_path / "index.tsv").read_text().splitlines()
    assert lines[0] == "place\ttile\tnum_buildings" and lines[1].startswith("\t0652_6862\t")
    assert cut(tmp_path, "0652_6862", footprints, dtm) == 0
    scene, facts = read_scene(tmp_path / "out.parquet")
    assert scene["in_tile"].sum() == facts["num_by_status"]["ok"] == int(lines[1].split("\t")[2])
    assert facts["tile_size_m"] == 1000 and facts["crs"] == "EPSG:2154"
    # footprints that are too small are no failures
    assert cut(tmp_path, "0652_6862", footprints, dtm, '{"scenes": {"min_area_m2": 1e6}}') == 0


@pytest.mark.parametrize(
    ("tile", "config", "message"),
    [
        ("0700_6600", "{}", "does not cover tile 0700_6600"),
        ("nowhere", "{}", "'nowhere' is not a tile name"),
        (
            "0652_6862",
            '{"scenes": {"max_eave_height_m": 3}}',
            "were excluded, more than scenes.max_failed_fraction",
        ),
        ("0652_6862", '{"scenes": {"margin": 3}}', "scenes.margin: unknown key"),
    ],
)
def test_bad_input_gives_one_line_and_keeps_existing_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], tile: str, config: str, message: str
) -> None:
    footprints, dtm = write_inputs(tmp_path)
    (tmp_path / "out.parquet").write_text("before")
    assert cut(tmp_path, tile, footprints, dtm, config) == 2
    error = capsys.readouterr().err
    assert error.count("p2wss: error:") == 1 and message in error
    assert (tmp_path / "out.parquet").read_text() == "before"
    assert not (tmp_path / "out.tif").exists()


def test_too_many_failures_stop_the_job() -> None:
    status = np.array(["ok", "ok", "too-high", "ok", "no-terrain"], object)
    strict, tolerant = ({"scenes": {"max_failed_fraction": most}} for most in (0.39, 0.4))
    check_failures(Path("a.gpkg"), "buildings", status, "scenes", load(tolerant))
    check_failures(Path("a.gpkg"), "buildings", status[:0], "scenes", load(strict))
    with pytest.raises(
        InputError, match=r"^a\.gpkg: 40\.0% of buildings, more than scenes\.max_failed_fraction 39"
    ):
        check_failures(Path("a.gpkg"), "buildings", status, "scenes", load(strict))


@pytest.mark.skipif(not OLEMPS.exists(), reason="no shared/data/olemps_bdtopo")
@pytest.mark.parametrize("sampler", ["realistic", "uniform"])
def test_real_footprints(tmp_path: Path, sampler: str) -> None:
    """Two tiles of BD TOPO through fetch, scenes and buildings: at most 2 % of the buildings are excluded."""
    config = tmp_path / "olemps.yaml"
    config.write_text(
        f"""
region: {{name: olemps, vintage: v3, bounds_m: [664000, 6359000, 665000, 6361000]}}
fetch: {{folder: {{footprints: {OLEMPS}/BATIMENT.shp, dtm: {OLEMPS}/dtm}}}}
scenes: {{sampler: {sampler}}}
"""
    )
    footprints, rest = tmp_path / "f.gpkg", ["--config", str(config)]
    assert main(["fetch", "footprints", "--out", str(footprints), *rest]) == 0
    statuses: list[pd.Series] = []
    for tile in ("0664_6361", "0664_6360"):
        dtm, scene, buildings = (tmp_path / f"{tile}{end}" for end in (".tif", ".parquet", ".b.parquet"))
        assert main(["fetch", "dtm", "--tile", tile, "--out", str(dtm), *rest]) == 0
        inputs = ["--tile", tile, "--footprints", str(footprints), "--dtm", str(dtm)]
        outputs = ["--out", str(scene), "--out-dtm", str(tmp_path / "w.tif")]
        assert main(["scenes", "cut", *inputs, *outputs, *rest]) == 0
        assert main(["buildings", "--scene", str(scene), "--out", str(buildings), *rest]) == 0
        table = files.read_table(buildings, BUILDINGS, ["status", "in_tile"]).to_pandas()
        statuses.append(table.loc[table["in_tile"], "status"])
    counts = pd.concat(statuses).value_counts()
    print(f"{sampler}:\n{counts.to_string()}")
    assert counts.sum() == 1341
    assert counts["ok"] / counts.sum() >= 0.98
