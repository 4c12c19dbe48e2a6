"""Members and draws of a data set, and the config of each place."""

from __future__ import annotations

import pytest

from p2wss.config import dataset_name, draw_places, load, member_place, member_places, place_config
from p2wss.storage.messages import InputError

TWO_CITIES = {
    "region": {"name": "cities", "vintage": "2024"},
    "scenes": {"seed": 3},
    "dataset": {
        "members": [
            {
                "name": "paris",
                "draws": 2,
                "region": {"bounds_m": [0, 0, 2000, 1000]},
                "scans": {"preset": "paper"},
            },
            {"name": "lyon", "split": "test", "region": {"vintage": "2025", "lidar_tiles": ["0001_0001"]}},
        ]
    },
}


def test_one_region_is_its_own_place() -> None:
    config = load({"region": {"name": "here"}})
    assert dataset_name(config) == "here" and member_places(config) == [""]
    assert draw_places(config, "") == [""] and member_place(config, "") == ""
    assert place_config(config, "") is config


def test_members_and_draws_have_places() -> None:
    config = load(TWO_CITIES)
    assert dataset_name(config) == "cities" and member_places(config) == ["paris/", "lyon/"]
    assert draw_places(config, "paris/") == ["paris/1/", "paris/2/"] and draw_places(config, "lyon/") == [
        "lyon/"
    ]
    assert member_place(config, "paris/2/") == "paris/" and member_place(config, "lyon/") == "lyon/"
    for place in ("paris/3/", "paris/0/", "nice/"):
        with pytest.raises(ValueError, match=f"no place {place}"):
            place_config(config, place)


def test_a_place_has_the_settings_of_its_member_and_seeds_of_its_own() -> None:
    config = load(TWO_CITIES)
    first, second, lyon = (place_config(config, place) for place in ("paris/1/", "paris/2/", "lyon/"))
    assert first.region.bounds_m == (0, 0, 2000, 1000) and first.region.vintage == "2024"
    assert first.region.tiles == [] == first.region.lidar_tiles, "the miniature's tiles are not inherited"
    assert lyon.region.vintage == "2025" and lyon.region.lidar_tiles == ["0001_0001"]
    assert (first.scans.preset, lyon.scans.preset) == ("paper", "hd")
    assert (first.crops.split, lyon.crops.split) == ("blocks", "test")
    seeds = [place.scenes.seed for place in (first, second, lyon)]
    assert len(set(seeds)) == 3 and len({place.scans.seed for place in (first, second, lyon)}) == 3
    assert {place.crops.seed for place in (first, second, lyon)} == {config.crops.seed}, (
        "splits agree between draws"
    )
    moved = load(TWO_CITIES, {"scenes": {"seed": 4}})
    assert place_config(moved, "paris/1/").scenes.seed == seeds[0] + 1


@pytest.mark.parametrize(
    ("dataset", "message"),
    [
        ({"members": [{"name": "a"}, {"name": "a"}]}, "different names"),
        ({"members": [{"name": "7"}]}, "dataset.members.0.name"),
        ({"members": [{"name": "a", "scans": {"densty": 1}}]}, "dataset.members.0.scans.densty"),
        ({"num_lidar_test": 5}, "both"),
    ],
)
def test_a_wrong_member_is_named(dataset: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load({"dataset": dataset})


def test_the_margins_of_a_member_fit_each_other() -> None:
    """The terrain reaches beyond its scenes; the rules would find that out one by one, with a traceback."""
    member = {"name": "a", "scenes": {"margin_m": 100}}
    documents = {"fetch": {}, "scenes": {}, "dataset": {"members": [{"name": "b"}, member]}}
    with pytest.raises(InputError, match=r"dataset\.members\.1: fetch\.margin_m must be at least"):
        load(documents)
    wider = {**member, "fetch": {"margin_m": 130}}
    load({**documents, "dataset": {"members": [wider]}})


def test_a_scan_has_the_points_of_the_crops_at_its_border() -> None:
    """Those of a wide buffer would lack up to a quarter of their points, without a word."""
    documents = {"scans": {}, "crops": {"buffer_m": 5}}
    load(documents)
    member = {"name": "a", "scans": {"keep_margin_m": 4}}
    with pytest.raises(InputError, match=r"dataset\.members\.0: scans\.keep_margin_m must be at least"):
        load({**documents, "dataset": {"members": [member]}})
    with pytest.raises(InputError, match=r"scans\.keep_margin_m must be at least crops\.buffer_m"):
        load({**documents, "crops": {"buffer_m": 6}})


def test_the_density_of_a_scan_is_within_its_bounds() -> None:
    """All scenes would have that of the nearest bound."""
    with pytest.raises(InputError, match="density_per_m2 must be within density_bounds_per_m2"):
        load({"scans": {"density_per_m2": 2}})
    load({"scans": {"density_per_m2": 2, "density_bounds_per_m2": [1, 30]}})
    load({"scans": {"density_per_m2": 2, "preset": "paper"}})


def test_members_of_one_vintage_do_not_get_the_terrain_of_each_other() -> None:
    """Drawn towns all lie at the same place."""
    town = {"name": "town", "fetch": {"folder": {"dtm": "resources/towns/1/rgealti"}}}
    documents = {"fetch": {}, "region": {}}
    with pytest.raises(
        InputError, match=r"dataset\.members\.1: has the region\.vintage and a part of the area of member a"
    ):
        load(documents | {"dataset": {"members": [{"name": "a"}, town]}})
    far = {"bounds_m": [700000, 6860000, 702000, 6862000]}
    for region in ({"vintage": "town"}, far):
        load(documents | {"dataset": {"members": [{"name": "a"}, town | {"region": region}]}})
    # the same terrain, of other footprints
    load(
        documents
        | {"dataset": {"members": [{"name": "a"}, {"name": "b", "fetch": {"folder": {"footprints": "f"}}}]}}
    )
