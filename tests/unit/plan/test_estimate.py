"""What a config needs: counts by hand, costs in proportion, and the pinned config."""

import json
from pathlib import Path

import pytest
import yaml

from p2wss import cli
from p2wss.config import load, place_config
from p2wss.errors import InputError
from p2wss.plan import costs, networks, work
from p2wss.plan.costs import Cost
from p2wss.plan.estimate import Download, estimate, pinned, to_text
from p2wss.plan.work import Region, count_work

ROOT = Path(__file__).resolve().parents[3]
CITIES = {
    "region": {"tiles": [], "lidar_tiles": []},
    "dataset": {
        "name": "cities",
        "num_pairs": 1000,
        "num_lidar_dvae": 500,
        "num_lidar_test": 300,
        "members": [
            {"name": "paris", "draws": 2, "region": {"vintage": "2026"}},
            {"name": "lyon", "region": {"vintage": "2026"}, "split": "train"},
        ],
    },
    "plan": {"buildings_per_km2": 100, "member_buildings_per_km2": {"paris": 1000}},
}
REGIONS = [Region(["0650_6860", "0651_6860"], ["0650_6860"]), Region(["0840_6520"], [])]


def counted(**changes):
    config = load(CITIES, *([changes] if changes else []))
    return count_work(config, REGIONS)


def test_buildings_are_counted_by_member_and_draw():
    counts = counted()
    assert (counts.num_tiles, counts.num_lidar_tiles) == (3, 1)
    assert counts.num_buildings == 2 * 1000 + 100
    assert counts.num_expected == 2 * 2 * 1000 + 100
    assert counts.amounts["tile"] == 3 and counts.amounts["member"] == 2
    assert counts.amounts["million pulses"] == 5 * 8


def test_pairs_are_those_asked_for_if_there_are_enough_in_each_split():
    counts = counted()
    assert counts.pairs == {"train": 800, "val": 100, "test": 100}
    # blocks of 125 m with a guard of 10 m: 24 % of val and test are not used
    all_pairs = counted(dataset={"num_pairs": 0}).pairs
    assert all_pairs["train"] == pytest.approx(0.8 * 4000 + 100)
    assert all_pairs["test"] == pytest.approx(0.1 * 4000 * 0.764, rel=0.01)
    few = counted(dataset={"num_pairs": 10_000}).pairs
    assert few == all_pairs
    assert counted(crops={"guard_m": 0}, dataset={"num_pairs": 0}).pairs["test"] == 400


def test_real_clouds_of_the_test_are_taken_first_and_others_for_the_dvae():
    counts = counted()
    assert (counts.num_real, counts.num_lidar_test, counts.num_lidar_dvae) == (1000, 300, 500)
    many = {"num_lidar_test": 700, "num_lidar_dvae": 500}
    counts = counted(dataset=many)
    assert (counts.num_lidar_test, counts.num_lidar_dvae) == (700, 300)
    counts = counted(dataset={"num_lidar_test": 0, "num_lidar_dvae": 0})
    assert (counts.num_lidar_test, counts.num_lidar_dvae) == (1000, 1000)
    assert counted(dvae={"use_lidar": False}).num_lidar_dvae == 0


def test_counted_buildings_replace_the_assumption():
    regions = [Region(REGIONS[0].tiles, [], {"0650_6860": 7}), REGIONS[1]]
    assert count_work(load(CITIES), regions).num_buildings == 7 + 100


def test_draws_and_members_share_terrain_of_the_same_tile():
    config = load(CITIES)
    both = count_work(config, [Region(["0650_6860"], []), Region(["0650_6860"], [])])
    assert both.amounts["tile"] == 1 and both.num_tiles == 2


def test_networks_cost_more_the_larger_they_are_and_nothing_with_weights():
    small, paper = load(), load(ROOT / "config/paper.yaml")
    assert networks.model_flop(paper.model, paper.dvae) > 50 * networks.model_flop(small.model, small.dvae)
    assert networks.dvae_flop(paper.dvae) > 50 * networks.dvae_flop(small.dvae)
    # twice the steps are twice the work
    twice = load({"model": {"optimiser": {"num_steps": 2 * small.model.optimiser.num_steps}}})
    assert networks.training_tflop(twice.model, twice.dvae) == pytest.approx(
        2 * networks.training_tflop(small.model, small.dvae)
    )
    weights = counted(model={"weights": "x.safetensors"})
    assert weights.amounts["model tflop"] == weights.amounts["dvae tflop"] == 0
    assert weights.num_jobs == counted().num_jobs - 2


TABLE = [
    Cost("scans", "million pulses", 36.0, 0.0, 10.0, 900.0, "measured"),
    Cost("model", "model tflop", 3600.0, 36.0, 0.0, 2000.0, "guessed"),
]


def test_costs_are_proportional_and_the_gpu_takes_over_what_it_can():
    result = estimate(load(CITIES), REGIONS, TABLE, [Download("LiDAR", 410.0, 205.0, "two tiles")])
    tflop = counted().amounts["model tflop"]
    assert result["cpu_hours"] == pytest.approx(40 * 36 / 3600)
    assert result["gpu_hours"] == pytest.approx(tflop / 100, rel=0.01)
    assert result["cpu_hours_without_gpu"] == pytest.approx(0.4 + tflop, rel=0.01)
    assert result["download_gb"] == pytest.approx(0.41)
    assert result["peak_memory_gb"] == pytest.approx(4.1)  # a LiDAR tile of 205 MB, 20 times
    assert result["disk_gb"] > 0.4 + 2 * 0.41
    text = "\n".join(result["assumptions"])
    for words in ("1000 usable buildings per km2", "two tiles", "costs: guessed", "24 % of val and test"):
        assert words in text
    assert "TOO FEW" not in text
    assert result["pairs"] == 1000 and "1,000 (800 train" in to_text(result)


def test_too_few_buildings_are_named():
    change = {"dataset": {"num_pairs": 10_000, "num_lidar_dvae": 5000}}
    result = estimate(load(CITIES, change), REGIONS, TABLE, [])
    assert sum("TOO FEW" in line for line in result["assumptions"]) == 2


def test_a_table_with_an_unknown_unit_is_an_error():
    with pytest.raises(InputError, match="unknown unit parsec"):
        estimate(load(CITIES), REGIONS, [Cost("scans", "parsec", 1.0, 0.0, 0.0, 0.0, "")], [])


def test_the_table_is_read_as_it_was_written(tmp_path):
    costs.write_costs(tmp_path / "costs.csv", TABLE)
    assert costs.read_costs(tmp_path / "costs.csv") == TABLE
    (tmp_path / "costs.csv").write_text("stage,unit\nscans,tile\n")
    with pytest.raises(InputError, match="not a table of costs"):
        costs.read_costs(tmp_path / "costs.csv")


def test_the_table_of_the_project_has_known_units():
    known = set(counted().amounts)
    assert {cost.unit for cost in costs.read_costs(ROOT / "config/costs.csv")} <= known


def test_pinned_members_keep_their_settings():
    config = load(CITIES)
    again = load(CITIES, pinned(config, REGIONS))
    for place, region in zip(("paris/", "lyon/"), REGIONS, strict=True):
        at, pinned_at = place_config(config, place), place_config(again, place)
        assert pinned_at.region.tiles == region.tiles
        assert pinned_at.region.lidar_tiles == region.lidar_tiles
        assert pinned_at.region.vintage == at.region.vintage == "2026"
        assert pinned_at.crops == at.crops and pinned_at.scans == at.scans


def test_the_command_prints_json_and_writes_a_config_that_pins_the_tiles(tmp_path, monkeypatch, capsys):
    table = ROOT / "config/costs.csv"
    monkeypatch.chdir(tmp_path)
    region = {"name": "x", "tiles": [], "lidar_tiles": [], "bounds_m": [650000, 6860000, 652000, 6861000]}
    (tmp_path / "x.yaml").write_text(yaml.safe_dump({"region": region}))
    command = ["plan", "--config", "x.yaml", "--json", "--costs", str(table), "--pin", "pinned.yaml"]
    assert cli.main(command) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["tiles"] == 2 and printed["buildings"] == 1800 and printed["lidar_dvae"] == 0
    config = load("x.yaml", "pinned.yaml")
    assert config.region.tiles == ["0650_6861", "0651_6861"]
    assert cli.main(["plan", "--config", "gone.yaml"]) == 2


def test_the_command_takes_counted_buildings_from_the_results(tmp_path, monkeypatch, capsys):
    table = ROOT / "config/costs.csv"
    monkeypatch.chdir(tmp_path)
    index = tmp_path / "results/mini/scenes/index.tsv"
    index.parent.mkdir(parents=True)
    index.write_text("place\ttile\tnum_buildings\n\t0652_6862\t5\n\t0652_6861\t6\n")
    assert cli.main(["plan", "--costs", str(table)]) == 0
    printed = capsys.readouterr().out
    assert "buildings    11, simulated 11 times" in printed and "counted by the stage scenes" in printed


def test_the_density_of_pulses_is_that_of_the_preset():
    empty = {"scans": {"density_per_m2": None, "preset": "hd"}}
    assert count_work(load(CITIES, empty), REGIONS).amounts["million pulses"] == 5 * 14
    assert work.split_shares(load({"crops": {"split": "test"}}).crops) == {"train": 0, "val": 0, "test": 1}
