"""The graph of jobs, without running any (seconds)."""

import json
import re
import shlex

import click
import pytest
from checkout import ROOT, rules_to_run

from p2wss import cli

NETWORK = ["eval", "reconstruct", "--method", "point2wss"]


def test_the_miniature_plans_every_rule(fresh):
    town = "resources/towns/1/bdtopo/BDTOPO_mini.gpkg"
    jobs = rules_to_run(fresh.dry_run("all", "ablation", town))
    text = "".join(path.read_text() for path in (ROOT / "workflow/rules").glob("*.smk"))
    with_output = re.findall(r"^(?:rule|checkpoint) (\w+):\n(?:    .*\n|\n)*?    output:", text, re.M)
    assert len(with_output) > 12
    assert set(with_output) <= set(jobs), set(with_output) - set(jobs)


# a list may be as long as the data set is large: the shell hands it over as a file
LISTED = re.compile(r"@<\(printf '%s\\n' ?(.*?)\)(?= --| 2>|$)")


def output_of(run):
    return run.stdout + run.stderr


def commands_of(dry_run):
    """The words of every command that a dry run prints, up to where its output goes."""
    lines = (dry_run.stdout + dry_run.stderr).splitlines()
    commands = [
        line.removeprefix("Shell command: ") for line in lines if line.startswith("Shell command: p2wss")
    ]
    commands = [LISTED.sub(r"\1", re.split(r" 2>|2>&1", command)[0]) for command in commands]
    return [shlex.split(command)[1:] for command in commands]


def parsed(words):
    """The values of the options of a command."""
    command, words = cli.program, list(words)
    while isinstance(command, click.Group):
        command = command.get_command(click.Context(command), words.pop(0))
    return command.make_context("p2wss", words).params


def test_every_printed_command_can_be_run_by_hand(fresh):
    """Weights whose path the shell would cut into words are quoted; the command line knows all options."""
    weights = fresh.folder / "my weights" / "$HOME; 'x'.safetensors"
    weights.parent.mkdir()
    weights.touch()
    override = json.dumps({"weights": str(weights)})
    runs = fresh.dry_runs(
        [["all", "--config", f"model={override}"], ["ablation", "resources/towns/1/rgealti"]]
    )
    commands = [command for run in runs for command in commands_of(run)]
    assert {str(model) for command in commands if (model := parsed(command).get("model"))} == {str(weights)}
    names = {" ".join(command[:2]) for command in commands}
    assert {"eval reconstruct", "eval measure", "crops simulated", "crops real", "towns --seed"} <= names


def test_the_ablation_is_no_part_of_the_report(fresh):
    assert not {"ablation", "ablation_model"} & set(rules_to_run(fresh.dry_run()))


def test_trained_weights_are_used_as_they_are_and_the_town_of_the_config_is_drawn(fresh):
    jobs = rules_to_run(fresh.dry_run("eval_report", "--configfile", "config/shipped.yaml"))
    assert not {"dvae", "model"} & set(jobs)
    assert (jobs["draw_town"], jobs["cut_scene"], jobs["eval_reconstruct"]) == (1, 2, 6)


def test_shards_are_evaluated_in_groups(fresh):
    """Four shards: by default in one group, or three and one."""
    in_threes = ["eval_report", "--config", "eval={shards_per_job: 3}"]
    by_default, dry_run = fresh.dry_runs([["eval_report"], in_threes])
    jobs = rules_to_run(by_default)
    assert [jobs[rule] for rule in ("eval_reconstruct", "measure")] == [6, 1]
    jobs = rules_to_run(dry_run)
    assert [jobs[rule] for rule in ("eval_reconstruct", "measure")] == [12, 2]
    groups = [parsed(words) for words in commands_of(dry_run) if words[:4] == NETWORK]
    shards = sorted((group["out"].parent.name, [shard.stem for shard in group["shards"]]) for group in groups)
    simulated = ["0652_6862", "0653_6862", "0652_6861"]
    assert shards == [("0000", simulated), ("0001", ["0653_6861"])]


def test_a_stage_is_a_target(fresh):
    jobs = rules_to_run(fresh.dry_run("scans"))
    assert {"cast_scan", "build_roofs", "cut_scene"} <= set(jobs)
    assert not {"crop_simulated", "dvae", "eval_report"} & set(jobs)


def test_open_tiles_wait_for_the_checkpoint(fresh):
    jobs = rules_to_run(fresh.dry_run("--config", "region={tiles: []}"))
    assert "index_scenes" in jobs and "cut_scene" not in jobs


def test_a_damaged_index_of_the_scenes_is_one_clear_line(project):
    index = project.folder / "results/mini/scenes/index.tsv"
    index.parent.mkdir(parents=True)
    index.write_text(f"place\ttile\tnum_buildings\n\t0652_6861\t7\n# p2wss-sha256:{'5' * 64}\n")
    run = project.dry_run("--config", "region={tiles: []}", check=False)
    assert run.returncode != 0
    message = f"{index.relative_to(project.folder)}: damaged or changed: its content does not have"
    assert message in run.stdout + run.stderr and "InputFunctionException" not in run.stdout + run.stderr
    project.dry_run()  # the tiles are pinned: nobody reads it
    index.unlink()
    assert "index_scenes" in rules_to_run(project.dry_run("--config", "region={tiles: []}"))


@pytest.mark.parametrize(
    ("several", "asks"),
    [(["--config", "model={compute: {num_gpus: 3}}"], False), (["--set-resources", "model:gpu=3"], True)],
)
def test_several_processes_of_the_config_or_a_profile_start_torchrun(fresh, several, asks):
    """Only the profile asks for GPUs: without one, the same command runs where there are none."""
    run = fresh.dry_run("model", *several)
    commands = [line for line in (run.stdout + run.stderr).splitlines() if line.startswith("Shell command:")]
    assert [line.split(" --manifest")[0] for line in commands if "--checkpoints" in line] == [
        "Shell command: p2wss dvae",
        "Shell command: torchrun --standalone --nproc-per-node 3 -m p2wss.cli model",
    ]
    assert ("gpu=3" in output_of(run)) == ("gpu=" in output_of(run)) == asks
    assert "num_gpus" not in "".join(commands)


def test_a_training_gets_the_files_that_it_reads_and_no_weights_that_replace_one(project):
    """Each variant, too; every shard, as the manifest lists none that is not there."""
    for name in ("start.safetensors", "weights.safetensors"):
        (project.folder / name).touch()
    start = {"start": "start.safetensors"}
    overrides = [start, start | {"weights": "weights.safetensors"}]
    arguments = [["ablation", "model", "--config", f"model={json.dumps(each)}"] for each in overrides]
    runs = project.dry_runs(arguments)
    inputs = re.findall(r"^rule (ablation_model|ablation|model):\n    input: (.*)$", output_of(runs[0]), re.M)
    assert {rule for rule, _ in inputs} == {"ablation_model", "ablation", "model"}
    assert all("crops/real/0653_6861.parquet" in files for _, files in inputs)
    assert all(("start.safetensors" in files) == (rule != "ablation") for rule, files in inputs)
    before, after = (sorted(words for words in commands_of(run) if words[0] == "model") for run in runs)
    assert len(before) > 2 and before == after


def test_all_tiles_are_planned_without_the_checkpoint(fresh):
    everything = "region={tiles: [all], lidar_tiles: [all], bounds_m: [652000, 6860000, 654000, 6862000]}"
    jobs = rules_to_run(fresh.dry_run("--config", everything))
    assert jobs["cut_scene"] == jobs["prepare_lidar"] == jobs["crop_real"] == 4


def test_no_command_grows_with_the_number_of_tiles(fresh):
    """9 or 36 tiles, all named in the config: lists of all of them reach a command as a file."""

    def longest(side):
        tiles = [f"{500 + column:04d}_{6600 + row:04d}" for column in range(side) for row in range(side)]
        member = {"name": "square", "region": {"tiles": tiles, "lidar_tiles": tiles}}
        lists = ["eval={shards_per_job: 2}", f"dataset={json.dumps({'name': 'd', 'members': [member]})}"]
        lengths = {}
        for line in output_of(fresh.dry_run("--config", *lists)).splitlines():
            if line.startswith("Shell command: p2wss"):
                command = LISTED.sub("", line)
                name = " ".join(word for word in command.split()[3:5] if "/" not in word)
                lengths[name] = max(len(command), lengths.get(name, 0))
        return lengths

    few, many = longest(3), longest(6)
    assert {"scenes index", "scenes cut", "crops manifest", "eval report"} <= set(few)
    assert many == few


def test_a_project_of_the_catalogue_plans(project):
    """What snakedeploy writes: a module with the config in config/config.yaml, and no default.yaml needed."""
    (project.folder / "config/default.yaml").unlink()
    (project.folder / "deployed.smk").write_text(
        'configfile: "config/config.yaml"\n'
        'module p2wss:\n    snakefile: "workflow/Snakefile"\n    config: config\n'
        "use rule * from p2wss\n"
    )
    jobs = rules_to_run(project.dry_run("-s", "deployed.smk"))
    assert {"eval_report", "reconstruct_tile"} <= set(jobs)


def test_every_config_plans(fresh):
    # what continues a training needs its weights
    continued = {f"shipped-{part}.yaml" for part in ("continued", "numbers", "parts", "more", "gpu")}
    configs = (file for file in (ROOT / "config").glob("**/*.yaml") if file.name not in continued)
    files = sorted(str(file.relative_to(ROOT)) for file in configs)
    runs = fresh.dry_runs([["--configfile", file] for file in files])
    assert len(runs) == len(files) > 10 and all(map(rules_to_run, runs))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("scans={sede: 1}", "config: scans.sede: unknown key (did you mean seed?)"),
        (
            "region={tile_size_m: 0}",
            "config: region.tile_size_m: Input should be greater than or equal to 10",
        ),
        # recorded outputs are for where Roofer cannot be run
        (
            "eval={roofer_recorded: gone.jsonl, roofer_command: no-roofer}",
            "config: eval.roofer_recorded: gone.jsonl: no such file",
        ),
        ("model={weights: gone.safetensors}", "config: model.weights: gone.safetensors: no such file"),
    ],
)
def test_a_wrong_config_is_one_clear_line(fresh, override, message):
    run = fresh.dry_run("--config", override, check=False)
    assert run.returncode != 0 and message in run.stdout + run.stderr


def test_settings_of_roofer_change_the_command_of_its_baseline_only(fresh):
    """Snakemake runs a rule again whose parameters have changed, and they are all in the command."""
    other = json.dumps({"roofer_command": "roofer --rerun", "roofer_timeout_s": 7})
    before = commands_of(fresh.dry_run())
    after = commands_of(fresh.dry_run("--config", f"eval={other}"))
    changed = [command for command in after if command not in before]
    roofer = ["eval", "reconstruct", "--method", "roofer"]
    assert [command[:4] == roofer for command in changed if command[:2] != ["eval", "report"]] == [True]


def test_a_setting_changes_the_commands_that_read_it_only(fresh):
    values = {
        "eval": {"num_samples": 7},
        "crops": {"min_points": 30},
        "region": {"classes": {"preset": "ahn"}},
    }
    runs = [["all"], *(["all", "--config", f"{name}={json.dumps(of)}"] for name, of in values.items())]
    before, *after = (commands_of(run) for run in fresh.dry_runs(runs))
    changed = [{" ".join(words[:2]) for words in each if words not in before} for each in after]
    by_setting = dict(zip(values, ({each.split(" --")[0] for each in of} for of in changed), strict=True))
    assert by_setting == {
        "eval": {"eval measure", "eval report"},
        "crops": {"crops simulated", "crops real", "crops manifest"},
        "region": {
            "crops real",
            "eval report",
            "fetch prepare",
            "reconstruct results/mini/fetch/lidar/0653_6861.laz",
        },
    }


def test_rules_get_the_settings_that_they_read(fresh):
    limits = ["reconstruct={not_representable_m: 0.5}", "buildings={max_roof_height_m: 50}"]
    by_name = {" ".join(words[:2]): words for words in commands_of(fresh.dry_run("--config", *limits))}
    report, measure = (parsed(by_name[f"eval {name}"])["config"] for name in ("report", "measure"))
    assert report.reconstruct.not_representable_m == 0.5
    assert measure.buildings.max_roof_height_m == 50


def test_the_filters_of_a_member_are_an_input(project):
    own = project.folder / "own_filters.json"
    own.write_text("[]")
    prepare = {"prepare": {"pdal_stages": own.name}}
    members = [{"name": "one", "fetch": prepare}, {"name": "two"}]
    region = {"tiles": ["0652_6862"], "lidar_tiles": ["0653_6861"]}
    dataset = {"name": "d", "members": [each | {"region": region} for each in members]}
    run = project.dry_run("--config", f"dataset={json.dumps(dataset)}")
    inputs = re.findall(r"^rule prepare_lidar:\n    input: (.*)$", output_of(run), re.M)
    assert sorted(each.split(", ")[-1] for each in inputs) == ["config/pdal/prepare.json", own.name]


def test_rules_that_fit_run_again_with_other_weights_between_few_points():
    """They come with the package, and no code changes with them."""
    rules = "".join(path.read_text() for path in (ROOT / "workflow/rules").glob("*.smk")).split("\nrule ")
    code = {rule.split(":")[0]: re.findall(r"code=fingerprint\((.*)\)", rule) for rule in rules}
    assert {name for name, stages in code.items() if '"weights"' in str(stages)} == {
        "eval_reconstruct",
        "reconstruct_tile",
    }


def test_every_value_in_a_shell_command_is_quoted():
    """A name of a file may hold a space, a quote or ``$(command)``; only numbers of the rule itself need no quoting."""
    texts = [file.read_text() for file in sorted((ROOT / "workflow/rules").glob("*.smk"))]
    commands = [
        command
        for text in texts
        for command in re.findall(r"^    shell:\n((?: {8}.*\n?)+)", text, re.MULTILINE)
    ]
    assert len(commands) == sum(text.count("    shell:\n") for text in texts) > 15
    values = [value for command in commands for value in re.findall(r"\{([^{}]*)\}", command)]
    assert len(values) > 100
    assert {value for value in values if not value.endswith(":q")} == {"threads"}
