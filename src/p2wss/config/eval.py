"""Section eval: metrics, tables and the report."""

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section

# settings that are read by: only the rules and the report; only the baseline roofer; only the measures
_REPORT_ONLY = ("attribution", "baselines", "lidar_name", "num_resamples", "num_worst", "shards_per_job")
_ROOFER_ONLY = ("roofer_command", "roofer_recorded", "roofer_timeout_s")
_MEASURES_ONLY = ("max_num_points", "num_samples", "seed")
NOT_OF_ROOFER = _REPORT_ONLY + _MEASURES_ONLY
NOT_OF_MEASURES = _REPORT_ONLY + _ROOFER_ONLY


class Eval(Section):
    """Stage eval: Tables 1 and 2 of the paper, and the report."""

    seed: int = Field(0, ge=0, description="seed of the points sampled on meshes")
    baselines: list[Literal["lod1", "constant", "roofer"]] = Field(
        ["lod1", "constant", "roofer"], description="baseline methods; roofer only if it is installed"
    )
    shards_per_job: int = Field(
        16,
        ge=1,
        description="number of shards (tiles) that one job reconstructs or measures, one after the other",
    )
    lidar_name: str = Field(
        "",
        description="name of the clouds of region.lidar_tiles in the report; '' = LiDAR HD, or the path of the clouds",
    )
    attribution: list[str] = Field(
        [], description="lines in the footer of the report: sources of the data other than IGN's services"
    )
    num_samples: int = Field(
        2048, gt=0, description="number of points sampled on each mesh for the Chamfer distance"
    )
    max_num_points: int = Field(
        2048,
        gt=0,
        description="maximum number of points of a cloud used for the Chamfer distance (a random subset)",
    )
    num_resamples: int = Field(
        1000, ge=10, description="number of bootstrap resamples for each 95 % interval"
    )
    num_worst: int = Field(20, ge=0, le=100, description="number of worst buildings shown per dataset")
    roofer_command: str = Field(
        "roofer",
        description="command and options of Roofer ({folder} = the folder with its files, for containers); "
        "'' = never",
    )
    roofer_recorded: str = Field(
        "tests/mini/roofer",
        description="recorded outputs of Roofer (a folder of CityJSON), used if it is not installed; '' = none",
    )
    roofer_timeout_s: float = Field(3600, gt=0, description="time limit of Roofer for one tile")
