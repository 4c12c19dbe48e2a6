"""Profiles, image and CI name what exists: rules, files and targets of make."""

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
TARGETS = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
HOSTED = ROOT / ".github/workflows/ci.yml"


def rules() -> dict[str, str]:
    """The text of each rule."""
    text = "\n".join(path.read_text() for path in ROOT.glob("workflow/rules/*.smk"))
    parts = re.split(r"^(?:rule|checkpoint) (\w+):", text, flags=re.M)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


@pytest.mark.parametrize("name", ["slurm", "kubernetes"])
def test_a_profile_names_rules_and_groups_that_exist(name):
    text = (ROOT / f"profiles/{name}/config.yaml").read_text()
    profile = yaml.safe_load(text)
    assert profile["executor"] == name and profile["retries"] >= 1
    # without its plugin snakemake only says that the executor is an invalid choice
    assert f"pip install snakemake-executor-plugin-{name}" in text
    named = {*profile["groups"], *profile.get("set-resources", {})}
    assert named <= set(rules()), named - set(rules())
    # Snakemake 9.27 adds tiles to a group that runs when a checkpoint ends, and the run breaks off
    assert "group-components" not in profile
    # a stage of simulated tiles that is missing here would be a job of seconds for each tile
    assert {"cut_scene", "build_roofs", "cast_scan", "crop_simulated"} <= set(profile["groups"])


@pytest.mark.parametrize("name", ["slurm", "kubernetes"])
def test_gpus_are_asked_for_by_profiles_only(name):
    profile = yaml.safe_load((ROOT / f"profiles/{name}/config.yaml").read_text())
    with_gpu = {rule for rule, resources in profile["set-resources"].items() if "gpu" in resources}
    assert with_gpu == {"dvae", "model", "ablation_model", "ablation", "eval_reconstruct"}
    assert not [rule for rule, text in rules().items() if "gpu=" in text]


@pytest.mark.parametrize("resource", ["mem_mb", "runtime"])
def test_every_job_asks_for_more_memory_and_time_on_a_retry(resource):
    running = {name for name, text in rules().items() if re.search(r"^    shell:", text, re.M)}
    assert len(running) > 15
    asking = {
        name
        for name, text in rules().items()
        if re.search(rf"{resource}=lambda \w+, attempt:.*attempt", text)
    }
    local = {"fetch_footprints", "fetch_dtm", "fetch_lidar", "draw_town"}  # no scheduler limits their time
    assert asking | (local if resource == "runtime" else set()) == running


def test_what_a_config_names_is_local_where_results_are_in_storage():
    text = "\n".join(path.read_text() for path in ROOT.glob("workflow/rules/*.smk"))
    for name in ("settings.model.weights", "recorded_files(", "with_companions("):
        uses = re.findall(rf".*{re.escape(name)}.*", text)
        assert any("local(" in line for line in uses), name


def test_hosted_ci_and_ours_call_targets_that_exist():
    hosted = yaml.safe_load(HOSTED.read_text())
    # YAML 1.1 reads the key "on" as true
    assert {"push", "schedule"} <= set(hosted[True])
    commands = [step["run"] for job in hosted["jobs"].values() for step in job["steps"] if "run" in step]
    called = set(re.findall(r"\bmake ([\w-]+)", "\n".join(commands)))
    ours = set(re.findall(r"^make ([\w-]+)", (ROOT / ".ci/run").read_text(), re.M))
    assert called | ours <= TARGETS
    assert {"lint", "dry-run", "test", "test-slurm", "test-live"} <= called and {"dry-run", "test"} <= ours
    on_push = [job for job in hosted["jobs"].values() if "if" not in job]
    weekly = [hosted["jobs"][name]["if"] for name in ("slurm", "live")]
    assert len(on_push) == 4 and all("schedule" in condition for condition in weekly)


def test_the_image_is_built_from_the_lock_file():
    text = (ROOT / "envs/Dockerfile").read_text()
    instructions = [
        line.split() for line in text.replace("\\\n", " ").splitlines() if line and line[0] != "#"
    ]
    assert instructions[0][0] == "FROM"
    copied = [source for words in instructions if words[0] == "COPY" for source in words[1:-1]]
    assert "envs/lock.txt" in copied and all((ROOT / source).exists() for source in copied)
    assert "pip install --no-cache-dir -r envs/lock.txt -r envs/engines.txt" in text
    ignored = (ROOT / ".dockerignore").read_text().split()
    assert not {"src", "config", "workflow", "models", "envs", "Snakefile"} & set(ignored)


def test_the_plugins_are_locked_to_what_goes_with_the_lock_file():
    lock, engines = versions("lock.txt"), versions("engines.txt")
    wanted = set(re.findall(r"^([\w-]+)", (ROOT / "envs/engines.in").read_text(), re.M))
    assert wanted <= set(engines)
    shared = lock.keys() & engines.keys()
    assert len(shared) > 10 and {name: lock[name] for name in shared} == {
        name: engines[name] for name in shared
    }


def versions(name: str) -> dict[str, str]:
    return dict(re.findall(r"^([\w.-]+)==([\w.+!-]+)", (ROOT / "envs" / name).read_text(), re.M))


@pytest.mark.parametrize("name", ["default", "slurm", "kubernetes"])
def test_the_scheduler_looks_for_jobs_every_minute(name: str) -> None:
    """Each job that ends starts one more timer, which by Snakemake's default goes off every second."""
    profile = yaml.safe_load((ROOT / f"profiles/{name}/config.yaml").read_text())
    assert profile["max-jobs-per-timespan"].endswith("/60s")
