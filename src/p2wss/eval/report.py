"""``report.html``, a single file that needs no other file and no network, and its tables as CSV and LaTeX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import TypeAdapter

from p2wss.config import Eval
from p2wss.data.building import Reconstruction
from p2wss.errors import reading
from p2wss.eval import figures, groups, tables, texts
from p2wss.eval.attribution import UNKNOWN_LIDAR
from p2wss.eval.cases import Key
from p2wss.eval.gallery import Counterpart, Exhibit, Gallery
from p2wss.eval.parameters import MergedErrors
from p2wss.eval.parts import Methods, Part
from p2wss.eval.samples import Samples, read_samples
from p2wss.eval.viewer import choices, viewer
from p2wss.formats import html
from p2wss.reconstruct.product import NETWORK, NETWORK_AND_FIT
from p2wss.storage import files, integrity
from p2wss.storage.schemas.crops import REAL, SIMULATED
from p2wss.storage.schemas.manifest import read_manifest
from p2wss.storage.schemas.measures import MEASURES

# methods whose meshes a picture shows, as far as they were run: with the points four panels
PICTURED = (NETWORK, NETWORK_AND_FIT, "roofer")
PICTURED_INSTEAD = ("fit", "lod1")


# a line of metrics.jsonl
_RECORD: TypeAdapter[dict[str, float | None]] = TypeAdapter(dict[str, float | None])


@dataclass(frozen=True)
class Exhibits:
    """The buildings to show: the worst by data set, counterparts of the paper's figures, those of the 3D view."""

    main: str
    worst: Mapping[str, Sequence[Exhibit]]
    cause_counts: Mapping[str, Sequence[tuple[str, int]]]
    counterparts: Sequence[Counterpart]
    viewed: Sequence[tuple[str, Key]]

    def keys(self) -> set[Key]:
        """The buildings whose points and meshes are needed."""
        exhibits = chain(*self.worst.values(), *(counterpart.exhibits for counterpart in self.counterparts))
        return {exhibit.key for exhibit in exhibits} | {key for _, key in self.viewed}


@dataclass(frozen=True)
class Inputs:
    """All that the report shows.

    parameters: errors of Table 1. cpu_ms: per building, by method and data set. samples: the buildings of the
    exhibits. training: the records of ``metrics.jsonl`` by stage. provenance: the metadata of each file. scans: PNGs
    as ``data:`` URIs, by tile. dvae_saw_real: whether the dvae was trained on the real clouds that are evaluated.
    """

    region: str
    measures: pa.Table
    parameters: dict[str, Any]
    runs: Sequence[tables.Run]
    exhibits: Exhibits
    samples: Samples
    training: Mapping[str, Sequence[dict[str, Any]]]
    provenance: Mapping[str, dict[str, Any]]
    config: Eval
    cpu_ms: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scans: Mapping[str, str] = field(default_factory=dict)
    dvae_saw_real: bool = False


def dataset_names(config: Eval) -> dict[str, str]:
    """Titles of the data sets."""
    return {SIMULATED: "Simulated", REAL: config.lidar_name or UNKNOWN_LIDAR}


def read(
    region: str,
    manifest: Path,
    measures: Path,
    errors: Path,
    methods: Path,
    parts: Sequence[Path],
    metrics: Sequence[Path],
    config: Eval,
    scans: Sequence[Path] = (),
) -> Inputs:
    """Read the report's inputs; a stage of training is named after the folder of its metrics.

    Raises :class:`InputError` if a file is missing or malformed.
    """
    content = files.read_json(manifest, dict[str, Any])
    provenance = {manifest.name: {name: value for name, value in content.items() if name != "shards"}}
    provenance[measures.name] = files.read_metadata(measures)
    records = files.read_json(methods, Methods)["methods"]
    for record in records:
        provenance[record["method"]] = {name: value for name, value in record.items() if name != "cpu_ms"}
    runs = [
        tables.Run(record["method"], record["status"], str(record.get("roofer", ""))) for record in records
    ]
    names = [run.method for run in runs]
    table = files.read_table(measures, MEASURES)
    chosen = choose_exhibits(table, names, config)
    folders = [Part(folder) for folder in parts]
    training = {path.parent.name: read_training(path) for path in metrics}
    uses_lidar = any(
        facts.get("model", {}).get("dvae_config", {}).get("use_lidar", False) for facts in provenance.values()
    )
    listed = read_manifest(manifest)
    is_chosen = REAL in listed.selection
    return Inputs(
        region,
        table,
        files.read_json(errors, MergedErrors),
        runs,
        chosen,
        read_samples(chosen.keys(), listed, table, folders, names),
        training,
        provenance,
        config,
        {record["method"]: record["cpu_ms"] for record in records},
        {_place_and_tile(path): figures.png_uri(_scan_picture(path)) for path in scans},
        # trained here, not read from elsewhere, and on clouds that were not chosen for one purpose or the other
        bool(training) and uses_lidar and REAL in table["dataset"].unique().to_pylist() and not is_chosen,
    )


def _place_and_tile(path: Path) -> str:
    """Which tile of which draw a picture shows: its path below the folder of the stage, if it stands in one."""
    parts = path.with_suffix("").parts
    return "/".join(parts[parts.index("scans") + 1 :]) if "scans" in parts else path.stem


def choose_exhibits(measures: pa.Table, methods: Sequence[str], config: Eval) -> Exhibits:
    """The buildings to show, chosen by their measures (schema ``MEASURES``)."""
    gallery, names = Gallery(measures, methods), dataset_names(config)
    return Exhibits(
        gallery.main,
        {dataset: gallery.worst(dataset, config.num_worst) for dataset in names},
        {dataset: gallery.cause_counts(dataset) for dataset in names},
        gallery.counterparts(config.num_pictures) if config.num_pictures else [],
        choices(measures, names, gallery.main),
    )


# stem of the files: caption
CAPTIONS = {
    "table1": "Parameters: mean absolute errors on the simulated test split, ours and the paper's.",
    "table2": "Buildings: Chamfer distance (m) and number of triangles, ours and the paper's.",
    "table2_more": "Buildings: measures beyond the paper's. Means with 95 % bootstrap intervals over buildings.",
    "without_mesh": "Buildings without a mesh, or with a flat roof instead, by reason.",
    "groups": "Errors by kind of building: medians of distances, means of errors against the labels.",
    "calibration": "Stated confidence and observed share of eave heights within 0.5 m and angles within 5°.",
    "worst": "The worst buildings of our best variant, each with the cause.",
}


def documents(inputs: Inputs) -> dict[str, str]:
    """The files of the report, text by name: ``report.html``, and each of :data:`CAPTIONS` as CSV and LaTeX."""
    details = tables.details(inputs.measures, inputs.config, inputs.cpu_ms)
    rows = _tables(inputs, details)
    texts_by_name = {"report.html": render(inputs, details)}
    for name, caption in CAPTIONS.items():
        texts_by_name[f"{name}.csv"] = texts.to_csv(rows[name])
        texts_by_name[f"{name}.tex"] = texts.to_latex(
            rows[name], caption, f"tab:p2wss-{name.replace('_', '-')}"
        )
    return texts_by_name


def _tables(inputs: Inputs, details: Sequence[tables.Detail]) -> dict[str, list[list[Any]]]:
    names = dataset_names(inputs.config)
    columns = tables.columns_2(details, inputs.runs)
    worst: list[list[Any]] = [
        ["dataset", "tile", "building_id", "method", "points_to_mesh_m", "CD_m", "cause"]
    ]
    for dataset in names:
        for exhibit in inputs.exhibits.worst[dataset]:
            row = inputs.samples.rows[exhibit.key, exhibit.method]
            distances = [row["points_to_mesh_m"], row["chamfer_m"]]
            worst.append([*exhibit.key, exhibit.method, *distances, _sentence(inputs, exhibit)])
    return {
        "table1": tables.table_1(inputs.parameters),
        "table2": tables.table_2(columns, names),
        "table2_more": tables.table_2_more(columns, names),
        "without_mesh": tables.without_mesh(details, inputs.runs, names),
        "groups": groups.table(inputs.measures, list(names)),
        "calibration": groups.calibration_table(inputs.measures, list(names)),
        "worst": worst,
    }


def _sentence(inputs: Inputs, exhibit: Exhibit) -> str:
    if exhibit.sentence is not None:
        return exhibit.sentence
    return inputs.samples.cause(exhibit.key, exhibit.method).sentence


def render(inputs: Inputs, details: Sequence[tables.Detail]) -> str:
    """The HTML of the report."""
    environment = html.environment("p2wss.eval")
    environment.filters["number"] = _number
    names = dataset_names(inputs.config)
    methods = method_names(inputs.runs)
    return environment.get_template("report.html.j2").render(
        region=inputs.region,
        names=names,
        methods=methods,
        main=inputs.exhibits.main,
        ours=tables.OURS,
        parameters=inputs.parameters,
        settings=tables.SETTINGS_1,
        rows_1=tables.ROWS_1,
        paper_1=tables.PAPER_TABLE_1,
        rows_2=_ROW_TITLES,
        columns_2=tables.columns_2(details, inputs.runs),
        paper_datasets=tables.PAPER_DATASETS,
        means=tables.MEANS,
        shares=tables.SHARES,
        details=details,
        runs=tables.ordered(inputs.runs),
        breakdowns=_breakdowns(inputs, names, methods),
        calibration=_calibration(inputs, names, methods),
        distributions=_distributions(inputs, names, methods),
        training=_training(inputs.training),
        worst=_worst(inputs, names, methods),
        counterparts=[
            {"about": counterpart, "pictures": _pictures(inputs, counterpart.exhibits, methods)}
            for counterpart in inputs.exhibits.counterparts
        ],
        viewer=viewer(inputs.samples, inputs.exhibits.viewed, methods, inputs.exhibits.main),
        scans=inputs.scans,
        dvae_saw_real=inputs.dvae_saw_real,
        attribution=inputs.config.attribution,
        provenance=inputs.provenance,
    )


def method_names(runs: Sequence[tables.Run]) -> dict[str, str]:
    """Names of the methods, with a remark where the outputs are recorded."""
    return tables.METHOD_NAMES | {run.method: run.name for run in runs}


_ROW_TITLES = ("μ CD (m)", "Q1 CD (m)", "Q2 CD (m)", "Q3 CD (m)", "σ CD (m)", "μ #T", "σ #T")


def _scan_picture(path: Path) -> bytes:
    """A PNG without what follows its end, the checksum."""
    integrity.verify(path)
    content = path.read_bytes()
    return content[: content.rfind(b"IEND") + len("IEND") + 4]


def read_training(path: Path) -> list[dict[str, Any]]:
    """Records of a ``metrics.jsonl``.

    Raises :class:`InputError` if it cannot be read or a line is no JSON object with a ``step``.
    """
    records: list[dict[str, Any]] = []
    for number, line in enumerate(integrity.read_lines(path), 1):
        if line.strip():
            with reading(path, f"JSON lines of numbers by name: line {number}"):
                records.append(_RECORD.validate_json(line))
                if all(records[-1].get(name) is None for name in _STEP_NAMES):
                    raise ValueError(f"it has no {' or '.join(_STEP_NAMES)}")
    return records


def _number(value: Any, digits: int = 2) -> str:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "–"
    return f"{value:.{digits}f}"


def _breakdowns(inputs: Inputs, names: Mapping[str, str], methods: Mapping[str, str]) -> list[dict[str, Any]]:
    """A table per data set and property of the buildings, with a line per group.

    A line has the measures of each method, and those of our best variant once more for the errors against labels.
    """
    header, *rows = groups.table(inputs.measures, list(names))
    records = [dict(zip(header, row, strict=True)) for row in rows]
    main = inputs.exhibits.main
    breakdowns = []
    for dataset in names:
        for by, title in groups.BY.items():
            part = [r for r in records if r["dataset"] == dataset and r["by"] == by]
            if part:
                used = [name for name in methods if any(r["method"] == name for r in part)]
                lines = []
                for group in dict.fromkeys(r["group"] for r in part):
                    cells = {r["method"]: r for r in part if r["group"] == group}
                    lines.append((group, [cells.get(name) for name in used], cells.get(main)))
                labelled = any(r["mean_height_error_m"] is not None for r in part)
                breakdowns.append(
                    {
                        "dataset": dataset,
                        "title": title,
                        "methods": used,
                        "lines": lines,
                        "labelled": labelled,
                    }
                )
    return breakdowns


def _calibration(
    inputs: Inputs, names: Mapping[str, str], methods: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Reliability diagrams of the data sets with labels, with scores per method."""
    diagrams = []
    for dataset, title in names.items():
        by_method = {method: groups.calibration(inputs.measures, dataset, method) for method in groups.STATED}
        by_method = {method: scores for method, scores in by_method.items() if scores.bins}
        if by_method:
            bins = {method: scores.bins for method, scores in by_method.items()}
            image = figures.data_uri(figures.reliability_diagram(bins, methods, f"{title}: confidence"))
            named = [(methods[method], scores) for method, scores in by_method.items()]
            diagrams.append({"image": image, "scores": named, "title": title})
    return diagrams


def _distributions(inputs: Inputs, names: Mapping[str, str], methods: Mapping[str, str]) -> list[str]:
    images = []
    for dataset, title in names.items():
        for column, label in (
            ("chamfer_m", "Chamfer distance (m)"),
            ("points_to_mesh_m", "points to mesh (m)"),
        ):
            measures = inputs.measures.select(["dataset", "method", column])
            values = {
                run.method: tables.numbers(tables.rows_of(measures, dataset, run.method), column)
                for run in tables.ordered(inputs.runs)
            }
            values = {method: sample[~np.isnan(sample)] for method, sample in values.items()}
            values = {method: sample for method, sample in values.items() if len(sample)}
            if values:
                images.append(figures.data_uri(figures.cumulative(values, methods, label, title)))
    return images


def _training(stages: Mapping[str, Sequence[dict[str, Any]]]) -> list[tuple[str, str]]:
    """(stage, image) with the curves of every number in the records."""
    images = []
    for stage, records in stages.items():
        for title, chosen in _panels(records).items():
            figure = figures.curves(chosen, _step_name(records), f"{stage}: {title}")
            images.append((stage, figures.data_uri(figure)))
    return images


_STEP_NAMES = ("step", "epoch")


def _step_name(records: Sequence[dict[str, Any]]) -> str:
    return next((name for name in _STEP_NAMES if any(name in record for record in records)), "record")


def _panels(records: Sequence[dict[str, Any]]) -> dict[str, dict[str, tuple[list[float], list[float]]]]:
    """Curves grouped by quantity: losses, errors in metres, errors in degrees."""
    step = _step_name(records)
    curves: dict[str, tuple[list[float], list[float]]] = {}
    for position, record in enumerate(records):
        for name, value in record.items():
            if name not in _STEP_NAMES and isinstance(value, int | float) and np.isfinite(value):
                x, y = curves.setdefault(name, ([], []))
                x.append(record.get(step, position))
                y.append(value)
    groups = {
        "losses": [name for name in curves if "loss" in name],
        "errors (m)": [name for name in curves if name.endswith("_m")],
        "errors (°)": [name for name in curves if name.endswith("_deg")],
    }
    return {title: {name: curves[name] for name in members} for title, members in groups.items() if members}


def _worst(inputs: Inputs, names: Mapping[str, str], methods: Mapping[str, str]) -> list[dict[str, Any]]:
    """Per data set the worst buildings with pictures, and how often each cause occurs."""
    sections = []
    for dataset, title in names.items():
        exhibits = inputs.exhibits.worst[dataset]
        if exhibits:
            pictures = _pictures(inputs, exhibits, methods)
            causes = inputs.exhibits.cause_counts[dataset]
            sections.append({"title": title, "pictures": pictures, "causes": causes})
    return sections


def _pictures(
    inputs: Inputs, exhibits: Sequence[Exhibit], methods: Mapping[str, str]
) -> list[dict[str, Any]]:
    return [_picture(inputs, exhibit, methods) for exhibit in exhibits]


def _picture(inputs: Inputs, exhibit: Exhibit, methods: Mapping[str, str]) -> dict[str, Any]:
    """The points of a building with our meshes and Roofer's; if that was not run, the fit's or the flat roof."""
    key, samples = exhibit.key, inputs.samples
    panels: list[tuple[str, Reconstruction]] = []
    for method in (*PICTURED, *PICTURED_INSTEAD):
        reconstruction = samples.reconstructions.get(method, {}).get(key)
        if reconstruction is not None and reconstruction.has_mesh and len(panels) < len(PICTURED):
            row = samples.rows[key, method]
            caption = f"{row['num_triangles']} triangles, CD {_number(row['chamfer_m'])} m"
            if row["points_to_mesh_m"] is not None:
                caption += f", points {_number(row['points_to_mesh_m'])} m"
            panels.append((f"{methods[method]}\n{caption}", reconstruction))
    image = figures.data_uri(figures.building(samples.cases[key], panels), 85)
    row = samples.rows[key, exhibit.method]
    return {"row": row, "image": image, "sentence": _sentence(inputs, exhibit)}
