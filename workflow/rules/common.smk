"""What all rules share: the validated config, its sections as parameters, the tiles, paths that the config decides."""

import os

from snakemake.exceptions import WorkflowError

from p2wss.config import ablated, load, section_json
from p2wss.data.tiling import TILE_PATTERN, neighbours
from p2wss.errors import InputError
from p2wss.eval import roofer_command
from p2wss.provenance import fingerprint

# numpy asks the kernel for huge pages, which costs a scan a fifth of its time
os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")

try:
    settings = load(dict(config))
except InputError as error:
    raise WorkflowError(str(error)) from None


wildcard_constraints:
    tile=TILE_PATTERN,
    method=r"(point2wss\+)?fit",
    baseline="lod1|constant|roofer",


def section(*names, without=()):
    """Sections of the config as one string: tracked by Snakemake, readable in the printed command."""
    return section_json(settings, *names, without=without)


def variant_section(wildcards):
    """The section of a model of the ablation."""
    return section_json(ablated(settings, wildcards.variant), "model")


def tiles(wildcards):
    """The pinned tiles, or those in which index_scenes found buildings."""
    if settings.region.tiles:
        return settings.region.tiles
    with checkpoints.index_scenes.get().output.index.open() as index:
        return [line.split("\t")[0] for line in list(index)[1:]]


def every_tile(path):
    """An input function: ``path`` for every tile."""
    return lambda wildcards: expand(path, tile=tiles(wildcards))


def around(path):
    """An input function: ``path`` of a LiDAR tile and of those of its neighbours that the config lists."""

    def paths(wildcards):
        names = [wildcards.tile, *neighbours(wildcards.tile, settings.region.tile_size_m)]
        return expand(path, tile=[name for name in names if name in settings.region.lidar_tiles])

    return paths


def drawn_town(path):
    """``path`` of the config if it is in a town that rule draw_town draws."""
    return path if settings.fetch.source == "folder" and str(path).startswith("resources/towns/") else []


def baseline_state(wildcards):
    """What a baseline depends on beside the code: another version of Roofer runs it again."""
    return roofer_command.state(settings.eval) if wildcards.baseline == "roofer" else ""


weights = settings.model.weights or "<results>/model/model.safetensors"
if settings.model.weights and not os.path.isfile(settings.model.weights):
    raise WorkflowError(f"config: model.weights: {settings.model.weights}: no such file")
# outputs of an earlier run of Roofer, used where it cannot be run
try:
    RECORDED = roofer_command.recorded_files(settings.eval)
except InputError as error:
    raise WorkflowError(f"config: {error}") from None
