"""Every setting of the pipeline: its type, bounds, default (the miniature's) and one line that explains it.

``config/default.yaml`` and ``config/schema.json`` are generated from here by ``make config``. Imports
nothing heavy: the Snakefile reads this module at each start.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from p2wss.errors import InputError

Share = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, values cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


# --- region -----------------------------------------------------------------------------------------------


class Region(Section):
    """Where: a place, cut into tiles."""

    name: str = Field("mini", pattern=r"^[A-Za-z0-9_-]+$", description="names the folder results/<name>")
    vintage: str = Field(
        "mini", pattern=r"^[A-Za-z0-9_.-]+$", description="edition of the data; names resources/ign/<vintage>"
    )
    crs: str = Field(
        "EPSG:2154", description="projected, metric; footprints, terrain and LiDAR must all be in it"
    )
    bounds_m: tuple[float, float, float, float] = Field(
        (652000, 6860000, 654000, 6862000), description="x_min, y_min, x_max, y_max in the CRS"
    )
    tile_size_m: float = Field(1000, gt=0, le=10000, description="edge of a scene")
    tiles: list[str] = Field(
        ["0652_6862", "0653_6862", "0652_6861"],
        description="tiles to make; [] = every tile of the bounds that has buildings (found by index_scenes)",
    )
    lidar_tiles: list[str] = Field(
        ["0653_6861"], description="tiles whose real (or stand-in) LiDAR is cropped; [] = none"
    )

    @model_validator(mode="after")
    def _bounds_in_order(self) -> Self:
        x_min, y_min, x_max, y_max = self.bounds_m
        if x_min >= x_max or y_min >= y_max:
            raise ValueError("bounds_m must be x_min, y_min, x_max, y_max")
        return self


# --- fetch ------------------------------------------------------------------------------------------------


class Fetch(Section):
    """Get footprints, terrain and LiDAR."""


# --- scenes -----------------------------------------------------------------------------------------------


class Scenes(Section):
    """Cut tiles, clean footprints, draw heights and roof angles."""

    seed: int = Field(0, ge=0, description="of heights and angles")


# --- buildings --------------------------------------------------------------------------------------------


class Buildings(Section):
    """Parametric buildings by weighted straight skeleton."""

    max_roof_height_m: float = Field(12, gt=0, description="a roof that would rise further is cut flat")
    max_failed_fraction: Share = Field(0.02, description="share of rejected buildings past which the job fails")


# --- scans ------------------------------------------------------------------------------------------------


class Scans(Section):
    """Simulated LiDAR survey."""

    seed: int = Field(0, ge=0, description="of the survey and its noise")


# --- crops ------------------------------------------------------------------------------------------------


class Crops(Section):
    """Points of each building, in shards, with splits."""

    seed: int = Field(0, ge=0, description="of the split")


# --- dvae -------------------------------------------------------------------------------------------------


class Dvae(Section):
    """Discrete VAE that turns patches of points into tokens."""

    seed: int = Field(0, ge=0, description="of weights, batches and augmentation")


# --- model ------------------------------------------------------------------------------------------------


class Model(Section):
    """Point2WSS, the multimodal transformer."""

    seed: int = Field(0, ge=0, description="of weights, batches and augmentation")


# --- eval -------------------------------------------------------------------------------------------------


class Eval(Section):
    """Tables 1 and 2 of the paper, and the report."""

    seed: int = Field(0, ge=0, description="of the points sampled on meshes")
    baselines: list[Literal["lod1", "constant", "roofer"]] = Field(
        ["lod1", "constant", "roofer"], description="methods beside ours; roofer only where it is installed"
    )
    lidar_name: str = Field(
        "stand-in LiDAR", min_length=1, description="what the report calls the clouds of region.lidar_tiles"
    )
    attribution: list[str] = Field(
        ["Miniature: footprints, terrain and LiDAR drawn by tests/mini/make.py; no real data"],
        description="sources and licences of the data, for the report's footer",
    )
    num_samples: int = Field(2048, gt=0, description="points sampled on each mesh for the Chamfer distance")
    max_num_points: int = Field(2048, gt=0, description="points of a cloud used for it: a subset by the seed")
    num_resamples: int = Field(1000, ge=10, description="bootstrap draws behind each 95 % interval")
    num_pictures: int = Field(
        4, ge=0, le=20, description="buildings shown per data set: best, middle and worst, each"
    )
    roofer_command: str = Field(
        "roofer",
        description="Roofer and its options ({folder} = folder of its input and output, for containers); '' = never",
    )
    roofer_timeout_s: float = Field(3600, gt=0, description="for one run of Roofer, one tile")


# --- reconstruct ------------------------------------------------------------------------------------------


class Reconstruct(Section):
    """Buildings from the user's own LiDAR."""

    buffer_m: float = Field(1, ge=0, le=20, description="points within this distance of a footprint are its cloud")
    min_num_points: int = Field(10, ge=1, description="a building with fewer gets a flat roof, none without any")
    simplify_m: float = Field(
        0.3, ge=0, le=5, description="Douglas-Peucker tolerance for real footprints; 0 = as they are"
    )
    min_eave_height_m: float = Field(1, gt=0, description="lower predictions are raised to this")
    max_roof_height_m: float = Field(12, gt=0, description="a roof that would rise further is cut flat")
    batch_size: int = Field(64, gt=0, description="buildings per call of the network")


# --- the whole --------------------------------------------------------------------------------------------


class Config(Section):
    """All sections, in the order of the pipeline."""

    region: Region = Region()
    fetch: Fetch = Fetch()
    scenes: Scenes = Scenes()
    buildings: Buildings = Buildings()
    scans: Scans = Scans()
    crops: Crops = Crops()
    dvae: Dvae = Dvae()
    model: Model = Model()
    eval: Eval = Eval()
    reconstruct: Reconstruct = Reconstruct()


def load(*documents: str | Path | dict[str, Any]) -> Config:
    """The config of the given YAML files or mappings, later ones over earlier ones, over the defaults.

    A string that starts with ``{`` is JSON. Raises :class:`InputError` that names the key and what is wrong.
    """
    merged: dict[str, Any] = {}
    for document in documents:
        sections = _parse(document).items()
        _merge(merged, {name: {} if section is None else section for name, section in sections})
    try:
        return Config.model_validate(merged)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "config"
        reason = "no such key" if first["type"] == "extra_forbidden" else first["msg"]
        raise InputError(f"config: {key}: {reason}{_suggestion(first)}") from error


def section_json(config: Config, *names: str) -> str:
    """The named sections as one line of JSON, which :func:`load` reads back."""
    return json.dumps({name: getattr(config, name).model_dump(mode="json") for name in names}, sort_keys=True)


def _parse(document: str | Path | dict[str, Any]) -> dict[str, Any]:
    if isinstance(document, dict):
        return document
    text = str(document)
    if not text.lstrip().startswith("{"):
        try:
            text = Path(document).read_text()
        except OSError as error:
            raise InputError(f"config: {document}: {error.strerror}") from error
    try:
        parsed = yaml.safe_load(text) or {}
    except yaml.YAMLError as error:
        raise InputError(f"config: {document}: not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(parsed, dict):
        raise InputError(f"config: {document}: expected sections with keys, found {type(parsed).__name__}")
    return parsed


def _merge(into: dict[str, Any], other: dict[str, Any]) -> None:
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = json.loads(json.dumps(value)) if isinstance(value, dict) else value


def _suggestion(error: Any) -> str:
    if error["type"] != "extra_forbidden":
        return ""
    from difflib import get_close_matches

    model: Any = Config
    for part in error["loc"][:-1]:
        if isinstance(part, str) and part in getattr(model, "model_fields", {}):
            model = model.model_fields[part].annotation
    near = get_close_matches(str(error["loc"][-1]), getattr(model, "model_fields", {}), n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def default_yaml() -> str:
    """Every key with its default and its one-line description, as YAML."""
    lines = [
        "# Every setting, with the miniature's value. Generated from src/p2wss/config.py by `make config`.",
        "# yaml-language-server: $schema=schema.json",
    ]
    _emit(Config(), lines, "")
    return "\n".join(lines) + "\n"


def _emit(model: Section, lines: list[str], indent: str) -> None:
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, Section):
            about = field.description or (type(value).__doc__ or "").split("\n")[0]
            lines += ([""] if not indent else []) + [f"{indent}{name}:  # {about}"]
            _emit(value, lines, indent + "  ")
        else:
            plain = json.dumps(model.model_dump(mode="json")[name], ensure_ascii=False)
            lines.append(
                f"{indent}{name}: {plain}" + (f"  # {field.description}" if field.description else "")
            )


def main(folder: str = "config") -> None:
    """Write ``default.yaml`` and ``schema.json``."""
    Path(folder, "default.yaml").write_text(default_yaml())
    Path(folder, "schema.json").write_text(json.dumps(Config.model_json_schema(), indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
