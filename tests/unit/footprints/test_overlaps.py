"""One building once: footprints that are there twice, lie in others or are the outline of parts."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from feature_tables import clean_footprints

from p2wss.config import Scenes
from p2wss.footprints.overlaps import COLUMN

HOUSE = shapely.box(0, 0, 12, 8)
LEFT, RIGHT = shapely.box(0, 0, 6, 8), shapely.box(6, 0, 12, 8)


def cleaned(heights: dict[str, float] | None = None, **shapes: shapely.Polygon) -> gpd.GeoDataFrame:
    heights = heights or {}
    columns = {
        "building_id": list(shapes),
        "stated_height_m": [heights.get(name, np.nan) for name in shapes],
    }
    frame = gpd.GeoDataFrame(columns, geometry=list(shapes.values()), crs="EPSG:2154")
    return clean_footprints(frame, Scenes()).set_index("building_id")


def statuses(**shapes: shapely.Polygon) -> dict[str, str]:
    return dict(cleaned(**shapes)["status"])


def test_an_outline_gives_way_to_its_parts(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    result = cleaned({"outline": 9.0, "left": 4.0}, outline=HOUSE, left=LEFT, right=RIGHT)
    assert dict(result["status"]) == {"outline": "has-parts", "left": "ok", "right": "ok"}
    assert result.geometry.area.sum() == pytest.approx(96)
    assert result.loc["outline", COLUMN] == "left right" and pd.isna(result.loc["left", COLUMN])
    # a part has the height that it states, or else that of the whole
    assert list(result["stated_height_m"].loc[["left", "right"]]) == [4.0, 9.0]
    assert "footprints that gave way to their parts: 1 (outline)" in caplog.text


def test_parts_that_leave_a_gap_are_in_the_outline() -> None:
    tower = shapely.box(1, 1, 4, 4)
    result = cleaned(outline=HOUSE, tower=tower)
    assert dict(result["status"]) == {"outline": "ok", "tower": "within-other"}
    assert result.loc["tower", COLUMN] == "outline"
    # so are those of which one is upon another
    high = shapely.box(1, 1, 5, 7)
    assert statuses(outline=HOUSE, left=LEFT, right=RIGHT, high=high)["outline"] == "ok"


@pytest.mark.parametrize(("side_m", "num_inside"), [(1000, 4), (1000, 2), (600, 4)])
def test_the_border_of_a_map_gives_way_to_the_buildings_in_it(
    side_m: float, num_inside: int, caplog: pytest.LogCaptureFixture
) -> None:
    """A hall, too, has others in it, but no hall has 0.5 km2."""
    houses = {f"h {k}": shapely.affinity.translate(HOUSE, 50 + 40 * k, 60) for k in range(num_inside)}
    result = cleaned(**{"the border": shapely.box(0, 0, side_m, side_m)}, **houses)
    if side_m == 1000 and num_inside > 2:
        assert dict(result["status"]) == {"the border": "around-others", **dict.fromkeys(houses, "ok")}
        assert result.loc["the border", COLUMN] == "'h 0' 'h 1' 'h 2' 'h 3'"
        assert "larger than any building, and give way to those in them: 1 (the border)" in caplog.text
    else:
        assert dict(result["status"]) == {"the border": "ok", **dict.fromkeys(houses, "within-other")}
        assert "; most in the border: leave it out if it is no building)" in caplog.text


def test_parts_of_parts() -> None:
    lower, upper = shapely.box(6, 0, 12, 4), shapely.box(6, 4, 12, 8)
    result = statuses(outline=HOUSE, left=LEFT, right=RIGHT, lower=lower, upper=upper)
    assert [name for name, status in result.items() if status == "ok"] == ["left", "lower", "upper"]
    assert result["outline"] == result["right"] == "has-parts"


def test_duplicates_are_built_once(caplog: pytest.LogCaptureFixture) -> None:
    moved = shapely.affinity.translate(HOUSE, 0.7, 0.6)
    for other in (HOUSE, moved, shapely.box(-0.3, -0.2, 12.4, 8.3)):
        result = cleaned(a=HOUSE, b=other)
        assert sorted(result["status"]) == ["duplicate", "ok"]
        assert result.geometry.area.sum() == pytest.approx(96, abs=12)
    assert "footprints that are there twice, and are built once: 1 (" in caplog.text


@pytest.mark.parametrize("names", [("a", "a_2"), ("a_2", "a")])
def test_of_a_feature_that_is_there_twice_the_one_with_its_id_is_built(names: tuple[str, str]) -> None:
    assert statuses(**dict.fromkeys(names, HOUSE)) == {"a": "ok", "a_2": "duplicate"}


def test_wide_overlaps_are_divided() -> None:
    result = cleaned(a=HOUSE, b=shapely.box(9, 2, 22, 7), c=shapely.box(40, 0, 50, 9))
    assert list(result["status"]) == ["ok"] * 3
    assert result.geometry["a"].equals(HOUSE) and result.loc["b", COLUMN] == "a"
    assert result.geometry["b"].bounds == (12, 2, 22, 7) and pd.isna(result.loc["c", COLUMN])


def test_neighbours_with_a_wall_are_no_overlap() -> None:
    result = cleaned(a=LEFT, b=shapely.box(5.7, 0, 12, 8))
    assert list(result["status"]) == ["ok", "ok"] and COLUMN not in result


def test_one_that_cannot_be_built_takes_no_place_of_others() -> None:
    """A round outline has too many edges: the house in it is built."""
    hall = shapely.Point(6, 4).buffer(40, quad_segs=64)
    frame = gpd.GeoDataFrame({"building_id": ["hall", "house"]}, geometry=[hall, HOUSE], crs="EPSG:2154")
    result = clean_footprints(frame, Scenes(simplify_m=0, max_edges=40))
    assert list(result["status"]) == ["too-many-edges", "ok"]


def test_the_order_of_rows_changes_nothing() -> None:
    shapes = {"a": HOUSE, "b": HOUSE, "c": LEFT, "d": RIGHT, "e": shapely.box(10, 5, 20, 9)}
    results = set()
    for order in permutations(shapes):
        result = cleaned(**{name: shapes[name] for name in order}).sort_index()
        results.add((*result["status"], *(shape.wkt for shape in result.geometry)))
    assert len(results) == 1


def test_random_overlaps_leave_no_place_to_two(tmp_path: Path) -> None:
    for seed in range(20):
        draw = np.random.default_rng(seed)
        low, size = draw.uniform(0, 30, (12, 2)), draw.uniform(4, 15, (12, 2))
        boxes = {f"b{k}": shapely.box(*low[k], *(low[k] + size[k])) for k in range(12)}
        result = cleaned(**boxes)
        built = result.geometry[result["status"] == "ok"]
        together = shapely.union_all(built.to_numpy())
        assert built.area.sum() == pytest.approx(together.area, abs=1.0)
        # and nearly everything belongs to one
        everything = shapely.union_all(list(boxes.values()))
        assert together.area > 0.85 * everything.area
