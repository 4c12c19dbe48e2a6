"""Every setting of the pipeline with its type, bounds, default (for the miniature) and description.

``config/default.yaml`` and ``config/schema.json`` are generated from this package by ``make config``. It
imports no slow modules, because the Snakefile imports it at every start.
"""

from p2wss.config.base import Section
from p2wss.config.crops import Crops, Dataset, Member
from p2wss.config.eval import Eval
from p2wss.config.fetch import IGN, Fetch, Folder, Geoplateforme, Prepare
from p2wss.config.load import as_config, load, measure_json, method_json, section_json
from p2wss.config.places import (
    PLACE_PATTERN,
    dataset_name,
    draw_places,
    member_place,
    member_places,
    place_config,
)
from p2wss.config.reconstruct import (
    ERRORS_SUFFIX,
    OUTPUT_SUFFIXES,
    TABLES_AND_MODELS,
    WEDGES_SUFFIX,
    Outlines,
    Output,
    Reconstruct,
    SchemaName,
)
from p2wss.config.region import ALL, CLASSES_ALONE, OF_CLOUDS, TILE_LISTS, Classes, ClassPreset, Region
from p2wss.config.scans import Clutter, PatternShares, Scans
from p2wss.config.scenes import Buildings, RoofShares, Scenes
from p2wss.config.sections import Config, ablated
from p2wss.config.training import (
    Ablation,
    Augmentation,
    Compute,
    Decoding,
    DeviceName,
    Dvae,
    LossWeights,
    Masking,
    Model,
    ModelOptimiser,
    Optimiser,
)

__all__ = [
    "ALL",
    "CLASSES_ALONE",
    "ERRORS_SUFFIX",
    "IGN",
    "OF_CLOUDS",
    "OUTPUT_SUFFIXES",
    "PLACE_PATTERN",
    "TABLES_AND_MODELS",
    "TILE_LISTS",
    "WEDGES_SUFFIX",
    "Ablation",
    "Augmentation",
    "Buildings",
    "ClassPreset",
    "Classes",
    "Clutter",
    "Compute",
    "Config",
    "Crops",
    "Dataset",
    "Decoding",
    "DeviceName",
    "Dvae",
    "Eval",
    "Fetch",
    "Folder",
    "Geoplateforme",
    "LossWeights",
    "Masking",
    "Member",
    "Model",
    "ModelOptimiser",
    "Optimiser",
    "Outlines",
    "Output",
    "PatternShares",
    "Prepare",
    "Reconstruct",
    "Region",
    "RoofShares",
    "Scans",
    "Scenes",
    "SchemaName",
    "Section",
    "ablated",
    "as_config",
    "dataset_name",
    "draw_places",
    "load",
    "measure_json",
    "member_place",
    "member_places",
    "method_json",
    "place_config",
    "section_json",
]
