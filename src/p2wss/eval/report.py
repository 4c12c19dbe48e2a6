"""``report.html``, a single file that needs no other file and no internet, and its tables as CSV and LaTeX."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
from pydantic import BaseModel

from p2wss.config import Config, dataset_name, member_places, place_config
from p2wss.config.fetch import Folder
from p2wss.data.building import Reconstruction
from p2wss.data.manifest import read_manifest
from p2wss.eval import figures, tables
from p2wss.eval.cases import Case, Key, cases_of, read_reconstructions
from p2wss.eval.viewer import View, choices, viewer
from p2wss.formats import viewer as page_parts
from p2wss.storage import files, integrity
from p2wss.storage.messages import reading
from p2wss.storage.schemas.crops import REAL, SIMULATED
from p2wss.storage.schemas.measures import MEASURES

_IGN = "IGN - BD TOPO, RGE ALTI, LiDAR HD ({vintage}), Licence Ouverte / Open Licence 2.0 (Etalab)"
_DRAWN = "Drawn by p2wss towns: footprints, terrain and LiDAR of the miniature, of no real place"
# stem of the files: caption in LaTeX
CAPTIONS = {
    "table1": "Parameters: mean absolute errors on the simulated test split, ours and the paper's.",
    "table2": r"Buildings: Chamfer distance (m) and number of triangles (\#T), ours and the paper's.",
    "table2_more": r"Buildings: measures beyond the paper's. Means with 95 \% bootstrap intervals over buildings.",
    "without_mesh": "Buildings without a mesh, or with a flat roof instead, by reason.",
    "groups": "Errors by kind of building: medians of distances, means of errors against the labels.",
    "worst": "The worst buildings of our best variant.",
}

# measures of which the least value is the best; measures of the comparison on the page, in order
LEAST = (
    "Points to mesh (m)",
    "Roof CD (m)",
    "Height RMSE (m)",
    "False roof edges (share)",
    "Missing roof edges (share)",
    "CD (m)",
)
COMPARED = (
    *LEAST[:-1],
    "Triangles",
    "Watertight (%)",
    "Planar faces (%)",
    "Without a mesh",
    "Buildings",
    "CD (m)",
)
# rows of the paper's table 2
WORDS = {
    "mu_CD": "CD mean (m)",
    "Q1_CD": "CD first quartile",
    "Q2_CD": "CD median",
    "Q3_CD": "CD third quartile",
    "sigma_CD": "CD standard deviation",
    "mu_#T": "triangles mean",
    "sigma_#T": "triangles standard deviation",
}


@dataclass(frozen=True)
class Inputs:
    """All that the report shows.

    measures: of the schema ``MEASURES``. views: the buildings in 3D, with their cases and reconstructions. training:
    the records of ``metrics.jsonl`` by stage. provenance: the metadata of each file. scans: PNGs as ``data:`` URIs, by
    tile. dvae_saw_real: whether the dvae was trained on the real clouds that are evaluated.
    """

    config: Config
    measures: pa.Table
    runs: Sequence[tables.Run]
    views: Sequence[View]
    cases: Mapping[Key, Case]
    reconstructions: Mapping[str, Mapping[Key, Reconstruction]]
    training: Mapping[str, Sequence[dict[str, Any]]]
    provenance: Mapping[str, dict[str, Any]]
    scans: Mapping[str, str]
    dvae_saw_real: bool


def titles(config: Config) -> dict[str, str]:
    """Titles of the data sets. Real clouds have the title ``eval.lidar_name``, or one from their sources."""
    places = [place_config(config, place) for place in member_places(config)]
    names = [
        "LiDAR HD"
        if place.fetch.source == "geoplateforme"
        else "Drawn LiDAR"
        if _is_drawn(place)
        else f"LiDAR of {place.fetch.folder.lidar}"
        for place in places
        if place.region.lidar_tiles
    ]
    return {
        SIMULATED: "Simulated",
        REAL: config.eval.lidar_name or ", ".join(dict.fromkeys(names)) or "LiDAR",
    }


def _is_drawn(place: Config) -> bool:
    """Whether the LiDAR of a place is the drawn one of the miniature, the default."""
    return place.fetch.source == "folder" and place.fetch.folder.lidar == Folder().lidar


def attribution(config: Config) -> list[str]:
    """The lines that name the sources: IGN's services and the drawn miniature where they are used, and the lines of the
    config."""
    places = [place_config(config, place) for place in member_places(config)]
    lines = [
        _IGN.format(vintage=place.region.vintage) for place in places if place.fetch.source == "geoplateforme"
    ]
    lines += [_DRAWN for place in places if _is_drawn(place)]
    return [*dict.fromkeys(lines), *config.eval.attribution]


def read(
    config: Config,
    manifest: Path,
    measures: Sequence[Path],
    reconstructions: Sequence[Path],
    metrics: Sequence[Path],
    scans: Sequence[Path] = (),
) -> Inputs:
    """Read the report's inputs; a stage of training is named after the folder of its metrics.

    Raises :class:`InputError` if a file is missing or malformed.
    """
    content = files.read_json(manifest, dict[str, Any])
    of_parts = [files.read_metadata(path) for path in measures]
    facts, methods = of_parts[0], dict[str, dict[str, Any]](of_parts[0]["methods"])
    for each in of_parts[1:]:
        # a method without an output for one group of tiles may have one for another
        methods |= {
            name: of for name, of in each["methods"].items() if methods[name]["status"].startswith("not run")
        }
    runs = [tables.Run(name, of["status"], str(of.get("note", ""))) for name, of in methods.items()]
    table = pa.concat_tables(files.read_table(path, MEASURES) for path in measures)
    ranked = tables.ranked(tables.frame_of(table, runs), runs)
    views = choices(ranked, titles(config), config.eval.num_worst)
    keys = {view.key for view in views}
    by_method: defaultdict[str, dict[Key, Reconstruction]] = defaultdict(dict)
    for path in reconstructions:
        for method, by_key in read_reconstructions(path, keys).items():
            by_method[method] |= by_key
    listed = read_manifest(manifest)
    training = {path.parent.name: read_training(path) for path in metrics}
    uses_lidar = any(
        of.get("model", {}).get("dvae_config", {}).get("use_lidar", False) for of in methods.values()
    )
    return Inputs(
        config=config,
        measures=table,
        runs=runs,
        views=views,
        cases=cases_of(listed, keys),
        reconstructions=by_method,
        training=training,
        provenance={
            manifest.name: {name: value for name, value in content.items() if name != "shards"},
            "measures": {name: value for name, value in facts.items() if name != "methods"},
            **methods,
        },
        scans={_place_and_tile(path): figures.image_uri(_scan_picture(path), "png") for path in scans},
        # the dvae was trained here, not read from elsewhere, and the real clouds were not divided between the two
        # purposes
        dvae_saw_real=bool(training)
        and uses_lidar
        and REAL in set(table["dataset"].unique().to_pylist()) - set(listed.selection),
    )


def _place_and_tile(path: Path) -> str:
    """The place and tile of a picture: its path below the folder of the stage scans, or its name outside such a
    folder."""
    parts = path.with_suffix("").parts
    return "/".join(parts[parts.index("scans") + 1 :]) if "scans" in parts else path.stem


def _scan_picture(path: Path) -> bytes:
    """A PNG without the checksum that follows its end."""
    integrity.verify(path)
    content = path.read_bytes()
    return content[: content.rfind(b"IEND") + len("IEND") + 4]


def documents(inputs: Inputs) -> dict[str, str]:
    """The files of the report, text by name: ``report.html``, and each of :data:`CAPTIONS` as CSV and LaTeX."""
    names = titles(inputs.config)
    frame = tables.frame_of(inputs.measures, inputs.runs)
    frames = {
        "table1": tables.table_1(inputs.measures),
        "table2": tables.table_2(frame, inputs.runs, names),
        "table2_more": tables.table_2_more(frame, inputs.runs, names, inputs.config.eval),
        "without_mesh": tables.without_mesh(frame, inputs.runs, names),
        "groups": tables.by_group(frame, inputs.runs, names),
        "worst": tables.worst(tables.ranked(frame, inputs.runs), names, inputs.config.eval.num_worst),
    }
    result = {"report.html": _render(inputs, frame, frames)}
    for name, each in frames.items():
        result[f"{name}.csv"] = each.map(partial(_cell, digits=4, unknown="")).to_csv(
            index=False, lineterminator="\n"
        )
        result[f"{name}.tex"] = _latex(each, CAPTIONS[name], f"tab:p2wss-{name.replace('_', '-')}")
    return result


def _latex(frame: pd.DataFrame, caption: str, label: str) -> str:
    r"""A ``table`` for ``\input``; needs booktabs."""
    style = frame.map(partial(_cell, unknown="--")).style.hide(axis="index").format(escape="latex")
    style = style.format_index(escape="latex", axis=1)
    return str(style.to_latex(hrules=True, caption=caption, label=label, position_float="centering"))


def _render(inputs: Inputs, frame: pd.DataFrame, frames: Mapping[str, pd.DataFrame]) -> str:
    """The HTML of the report."""
    environment = page_parts.environment("p2wss.eval", "p2wss.formats")
    environment.filters["cell"] = _cell
    names = {run.method: run.name for run in tables.ordered(inputs.runs)}
    shown = {method: name for method, name in names.items() if method != "constant"}
    main = tables.main_method(inputs.runs)
    groups = frames["groups"].groupby(["Data set", "By"], sort=False)
    return environment.get_template("report.html.j2").render(
        region=dataset_name(inputs.config),
        names=titles(inputs.config),
        main=names.get(main, main),
        settings=["Paper", *tables.SETTINGS_1.values()],
        table1=frames["table1"].to_dict("records"),
        table2=frames["table2"]
        .set_index("Statistic")
        .T.dropna(how="all")
        .rename(columns=WORDS)
        .rename_axis("Method")
        .reset_index(),
        comparisons=_comparisons(frames["table2_more"], titles(inputs.config)),
        without_mesh=frames["without_mesh"],
        groups=[(" / ".join(map(str, name)), _distances(part)) for name, part in groups],
        worst=_off(frames["worst"], inputs.config.reconstruct.not_representable_m),
        off_m=inputs.config.reconstruct.not_representable_m,
        num_buildings=len(
            frame.loc[frame["dataset"] == SIMULATED, ["tile", "building_id"]].drop_duplicates()
        ),
        num_left_out=tables.num_left_out(inputs.measures),
        runs=tables.ordered(inputs.runs),
        distributions=_distributions(frame, names, titles(inputs.config)),
        training=_training(inputs.training),
        viewer=viewer(inputs.views, inputs.cases, inputs.reconstructions, shown, main),
        scans=inputs.scans,
        dvae_saw_real=inputs.dvae_saw_real,
        attribution=attribution(inputs.config),
        provenance=inputs.provenance,
    )


def _comparisons(more: pd.DataFrame, titles: Mapping[str, str]) -> dict[str, pd.DataFrame]:
    """For each data set a table with a row per method and a column per measure that has any value: means, with
    intervals for distances, CD last. The best value is in asterisks."""
    by_measure = more.set_index("Measure")
    result = {}
    for title in titles.values():
        of_dataset = by_measure.filter(regex=f"^{re.escape(title)} / ")
        of_dataset = of_dataset.loc[:, of_dataset.loc[[*LEAST]].notna().any()]
        if of_dataset.empty:
            continue
        table = pd.DataFrame({"Method": [str(name).removeprefix(f"{title} / ") for name in of_dataset]})
        for measure in of_dataset.loc[[*COMPARED]].dropna(how="all").index:
            values = of_dataset.loc[measure].to_numpy()
            cell = partial(_cell, digits=3 if measure in LEAST else 1)
            texts = [cell(value) for value in values]
            if measure in LEAST:
                best = cell(pd.Series(values, dtype=float).min())
                bounds = (
                    of_dataset.loc[[f"{measure}, 95 % low", f"{measure}, 95 % high"]].map(cell).to_numpy()
                )
                ranges = [f"{text} ({low} to {high})" for text, low, high in zip(texts, *bounds, strict=True)]
                texts = [
                    f"*{each}*" if text == best else each for text, each in zip(texts, ranges, strict=True)
                ]
            table[measure] = texts
        result[title] = table
    return result


def _off(worst: pd.DataFrame, limit_m: float) -> pd.DataFrame:
    """The worst buildings that are farther from their points than ``limit_m``, or that have no mesh."""
    distance_m = worst["Points to mesh (m)"]
    return worst[distance_m.isna() | (distance_m > limit_m)]


def _distances(group: pd.DataFrame) -> pd.DataFrame:
    """The median distances of points to mesh for one property: a row per group, a column per method but the constant
    one."""
    wide = group.pivot_table("Median Points to mesh (m)", "Group", "Method", sort=False, observed=True)
    return wide.drop(columns="Constant", errors="ignore").map(partial(_cell, digits=3)).reset_index()


def _cell(value: Any, digits: int = 2, unknown: str = "–") -> str:
    if pd.isna(value):
        return unknown
    return f"{value:.{digits}f}" if isinstance(value, float) else str(value)


def _distributions(
    frame: pd.DataFrame, names: Mapping[str, str], titles: Mapping[str, str]
) -> list[tuple[str, str]]:
    """(image, caption) for each data set and distance, over the buildings that every method has."""
    frame, images = frame[tables.compared(frame)], []
    for dataset, title in titles.items():
        for column in ("points_to_mesh_m", "chamfer_m"):
            rows = frame[(frame["dataset"] == dataset) & frame[column].notna()]
            values = {
                str(name): part.to_numpy() for name, part in rows.groupby("method", observed=True)[column]
            }
            if values:
                name = tables.MEANS[column]
                image = figures.cumulative(values, names, name, title)
                images.append((figures.data_uri(image), f"{title}: share of the buildings by {name}"))
    return images


class _Record(BaseModel, extra="allow"):
    """A line of a ``metrics.jsonl``: numbers by name, or the step from which on another ``code`` trained."""

    step: float
    code: str = ""
    __pydantic_extra__: dict[str, float | None]


def read_training(path: Path) -> list[dict[str, Any]]:
    """Records of a ``metrics.jsonl``.

    Raises :class:`InputError` if it cannot be read or a line is no JSON object with a ``step``.
    """
    records: list[dict[str, Any]] = []
    for number, line in enumerate(integrity.read_lines(path), 1):
        if line.strip():
            with reading(path, f"JSON lines of numbers by name: line {number}"):
                records.append(_Record.model_validate_json(line).model_dump(exclude={"code"}))
    return records


def _words(name: str) -> str:
    """The name of a curve in words; the title has the unit.

    >>> _words("val_height_mae_constant_m")
    'validation height MAE constant'
    """
    name = re.sub("_(m|deg)$", "", name).replace("val_", "validation ").replace("mae", "MAE")
    return name.replace("_", " ")


def _training(stages: Mapping[str, Sequence[dict[str, Any]]]) -> list[tuple[str, str]]:
    """(image, caption) with the curves of losses, of errors in metres and of errors in degrees."""
    images = []
    for stage, records in stages.items():
        frame = pd.DataFrame(records).astype(float)
        for title, pattern in (("losses", "loss"), ("errors (m)", "_m$"), ("errors (°)", "_deg$")):
            chosen = frame.set_index("step").filter(regex=pattern)
            curves = {
                _words(str(name)): values.dropna() for name, values in chosen.items() if values.notna().any()
            }
            if curves:
                figure = figures.curves(curves, "step", title)
                images.append((figures.data_uri(figure), f"Training curves of {stage}: {title}"))
    return images
