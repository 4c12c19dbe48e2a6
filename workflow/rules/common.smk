"""What all rules share: the validated config, its sections as parameters, paths that the config decides."""

import os
import re
import sys
import threading
from functools import cache
from pathlib import Path

from snakemake.exceptions import WorkflowError

from p2wss import config as configs
from p2wss.data.tiling import TILE_PATTERN
from p2wss.storage.messages import InputError
from p2wss.config import roofer_command
from p2wss.storage.provenance import fingerprint

# numpy asks the kernel for huge pages, which costs a scan a fifth of its time
os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
# a training stops, with a checkpoint, when the Snakemake that started it was killed
os.environ.update(P2WSS_WORKFLOW_PROCESS=str(os.getpid()))

try:
    settings = configs.load(dict(config))
except InputError as error:
    raise WorkflowError(str(error)) from None


wildcard_constraints:
    place=configs.PLACE_PATTERN,
    tile=TILE_PATTERN,
    vintage=r"[A-Za-z0-9_.-]+",
    group=r"\d+",
    method=r"point2wss|(point2wss\+)?fit|masked|lod1|constant|roofer",


def cancel_timers():
    """Exit at once: Snakemake would wait for its timers, of a minute each by ``max-jobs-per-timespan`` of the profiles."""
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer):
            thread.cancel()


def print_causes(logs_of_run):
    """At the end of a run that failed, the last line of each failed job's log: among the commands it is hard to find."""
    text = "".join(Path(path).read_text() for path in logs_of_run)
    for name in dict.fromkeys(re.findall(r"^ +log: (\S+) \(check log", text, re.MULTILINE)):
        lines = Path(name).read_text().split("\n") if Path(name).is_file() else []
        print(f"{name}: {next(filter(None, reversed(lines)), 'empty')}", file=sys.stderr)


@cache
def at(place):
    """The config of a place."""
    return configs.place_config(settings, place)


def section(*names, without=()):
    """Sections of the config, of the place of the job if it has one, as one string: tracked by Snakemake, readable
    in the printed command."""
    return lambda wildcards: configs.section_json(at(wildcards.get("place", "")), *names, without=without)


# how many processes train: the networks depend on it through rounding and through the random draws of each process
RULE_ONLY = ("compute.num_gpus",)
# of section model: weights from elsewhere are used in place of a training, which does not depend on them
NOT_OF_TRAINING = ("weights", *RULE_ONLY)


def program(section):
    """The words of the command p2wss, or of torchrun that starts it in several processes: as many as the job has GPUs
    by a profile, else as the config says.

    What depends on resources is not tracked: the number of processes reruns nothing.
    """

    def words(wildcards, resources):
        num_processes = resources.get("gpu", section.compute.num_gpus)
        torchrun = ["torchrun", "--standalone", "--nproc-per-node", num_processes, "-m", "p2wss.cli"]
        return torchrun if num_processes > 1 else ["p2wss"]

    return words


def variant_section(wildcards):
    """The section of a model of the ablation."""
    return configs.section_json(
        configs.ablated(settings, wildcards.variant), "model", without=NOT_OF_TRAINING
    )


def start_of(model):
    """The weights that a training starts from, if any: a file of the user, wherever results are stored."""
    return local(model.start) if model.start else []


# no tile depends on which other tiles are processed: neither its rules run again when a tile is added, nor are
# thousands of names part of each command
TILE_LISTS = configs.TILE_LISTS
EVERY_TILE_LIST = (*TILE_LISTS, *(f"members.*.region.{name}" for name in TILE_LISTS))
OF_CLOUDS = configs.OF_CLOUDS


def roofer_state(wildcards):
    """What a method depends on beside the code: another version of Roofer runs it again."""
    return roofer_command.state(settings.eval) if wildcards.method == "roofer" else ""


weights = local(settings.model.weights) if settings.model.weights else "<results>/model/model.safetensors"
if settings.model.weights and not os.path.isfile(settings.model.weights):
    raise WorkflowError(f"config: model.weights: {settings.model.weights}: no such file")
# outputs of an earlier run of Roofer, used where it cannot be run
try:
    RECORDED = local(roofer_command.recorded_files(settings.eval))
except InputError as error:
    raise WorkflowError(f"config: {error}") from None
