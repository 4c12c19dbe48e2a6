"""The graph of jobs, without running any (seconds)."""

import re

import pytest
from checkout import ROOT, rules_to_run


def test_the_miniature_plans_every_rule(project):
    town = "resources/towns/1/bdtopo/BDTOPO_mini.gpkg"
    jobs = rules_to_run(project.snakemake("-n", "all", "ablation", town))
    text = "".join(path.read_text() for path in (ROOT / "workflow/rules").glob("*.smk"))
    with_output = re.findall(r"^(?:rule|checkpoint) (\w+):\n(?:    .*\n|\n)*?    output:", text, re.M)
    assert len(with_output) > 12
    assert set(with_output) <= set(jobs), set(with_output) - set(jobs)


def test_the_ablation_is_no_part_of_the_report(project):
    assert not {"ablation", "ablation_model"} & set(rules_to_run(project.snakemake("-n")))


def test_trained_weights_are_used_as_they_are_and_the_town_of_the_config_is_drawn(project):
    jobs = rules_to_run(project.snakemake("-n", "eval_report", "--configfile", "config/shipped.yaml"))
    assert not {"dvae", "model"} & set(jobs)
    assert (jobs["draw_town"], jobs["cut_scene"], jobs["predict"]) == (1, 2, 1)


def test_a_stage_is_a_target(project):
    jobs = rules_to_run(project.snakemake("-n", "scans"))
    assert {"cast_scan", "build_roofs", "cut_scene"} <= set(jobs)
    assert not {"crop_simulated", "dvae", "eval_report"} & set(jobs)


def test_open_tiles_wait_for_the_checkpoint(project):
    jobs = rules_to_run(project.snakemake("-n", "--config", "region={tiles: []}"))
    assert "index_scenes" in jobs and "cut_scene" not in jobs


@pytest.mark.parametrize("file", sorted((ROOT / "config").glob("**/*.yaml")), ids=lambda path: path.stem)
def test_every_config_plans(project, file):
    project.snakemake("-n", "--configfile", str(file.relative_to(ROOT)))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("scans={sede: 1}", "config: scans.sede: unknown key (did you mean seed?)"),
        ("region={tile_size_m: 0}", "config: region.tile_size_m: Input should be greater than 0"),
        ("eval={roofer_recorded: gone.jsonl}", "config: eval.roofer_recorded: gone.jsonl: no such file"),
        ("model={weights: gone.safetensors}", "config: model.weights: gone.safetensors: no such file"),
    ],
)
def test_a_wrong_config_is_one_clear_line(project, override, message):
    run = project.snakemake("-n", "--config", override, check=False)
    assert run.returncode != 0 and message in run.stdout + run.stderr
