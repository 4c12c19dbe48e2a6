"""``report.html``, a single file that needs no other file and no network, and its tables as CSV and LaTeX."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from p2wss.config import Eval
from p2wss.data import files
from p2wss.data.building import Reconstruction
from p2wss.data.schemas.crops import REAL, SIMULATED
from p2wss.data.schemas.manifest import read_manifest
from p2wss.data.schemas.measures import MEASURES
from p2wss.data.schemas.reconstructions import read_reconstructions
from p2wss.errors import InputError
from p2wss.eval import figures, groups, parameters, tables, texts
from p2wss.eval.cases import Case, test_cases
from p2wss.eval.gallery import Exhibit, Gallery, cause_counts
from p2wss.eval.viewer import viewer
from p2wss.reconstruct.product import NETWORK, NETWORK_AND_FIT

Key = tuple[str, str, str]
# methods whose meshes a picture shows, as far as they were run: with the points four panels
PICTURED = (NETWORK, NETWORK_AND_FIT, "roofer")
PICTURED_INSTEAD = ("fit", "lod1")


@dataclass(frozen=True)
class Inputs:
    """All that the report shows.

    parameters: errors of Table 1. cpu_ms: per building, by method and data set. training: the records of
    ``metrics.jsonl`` by stage. provenance: the metadata of each file. scans: PNGs as ``data:`` URIs, by tile.
    """

    region: str
    measures: pa.Table
    parameters: dict[str, Any]
    runs: Sequence[tables.Run]
    reconstructions: Mapping[str, Mapping[Key, Reconstruction]]
    cases: Mapping[Key, Case]
    training: Mapping[str, Sequence[dict[str, Any]]]
    provenance: Mapping[str, dict[str, Any]]
    config: Eval
    cpu_ms: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scans: Mapping[str, str] = field(default_factory=dict)


def dataset_names(config: Eval) -> dict[str, str]:
    """Titles of the data sets."""
    return {SIMULATED: "Simulated", REAL: config.lidar_name}


def read(
    region: str,
    manifest: Path,
    measures: Path,
    masked: Path,
    reconstructions: Sequence[Path],
    cpu: Sequence[Path],
    metrics: Sequence[Path],
    config: Eval,
    scans: Sequence[Path] = (),
) -> Inputs:
    """Read the report's inputs; a stage of training is named after the folder of its metrics.

    Raises :class:`InputError` if a file is missing or malformed.
    """
    by_method = {}
    runs = []
    provenance: dict[str, dict[str, Any]] = {}
    for path in reconstructions:
        facts = files.read_metadata(path)
        method = str(facts.get("method", path.stem))
        runs.append(tables.Run(method, str(facts.get("status", "ok")), str(facts.get("roofer", ""))))
        by_method[method] = read_reconstructions(path)
        provenance[path.name] = facts
    cases = {case.key: case for case in test_cases(read_manifest(manifest))}
    content = files.read_json(manifest)
    provenance[manifest.name] = {name: value for name, value in content.items() if name != "shards"}
    provenance[measures.name] = files.read_metadata(measures)
    times = [files.read_json(path) for path in cpu]
    return Inputs(
        region,
        files.read_table(measures, MEASURES),
        parameters.with_reconstructions(files.read_json(masked), cases, by_method),
        runs,
        by_method,
        cases,
        {path.parent.name: read_training(path) for path in metrics},
        provenance,
        config,
        {time["method"]: time["cpu_ms"] for time in times},
        {path.stem: figures.png_uri(path.read_bytes()) for path in scans},
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
    gallery = Gallery(inputs.cases, inputs.reconstructions, inputs.measures.to_pylist())
    rows = _tables(inputs, details, gallery)
    texts_by_name = {"report.html": render(inputs, details, gallery)}
    for name, caption in CAPTIONS.items():
        texts_by_name[f"{name}.csv"] = texts.to_csv(rows[name])
        texts_by_name[f"{name}.tex"] = texts.to_latex(
            rows[name], caption, f"tab:p2wss-{name.replace('_', '-')}"
        )
    return texts_by_name


def _tables(inputs: Inputs, details: Sequence[tables.Detail], gallery: Gallery) -> dict[str, list[list[Any]]]:
    names = dataset_names(inputs.config)
    columns = tables.columns_2(details, inputs.runs)
    worst: list[list[Any]] = [
        ["dataset", "tile", "building_id", "method", "points_to_mesh_m", "CD_m", "cause"]
    ]
    for dataset in names:
        for exhibit in gallery.worst(dataset, inputs.config.num_worst):
            row = gallery.rows[dataset, exhibit.method][exhibit.key]
            distances = [row["points_to_mesh_m"], row["chamfer_m"]]
            worst.append([*exhibit.key, exhibit.method, *distances, exhibit.sentence])
    return {
        "table1": tables.table_1(inputs.parameters),
        "table2": tables.table_2(columns, names),
        "table2_more": tables.table_2_more(columns, names),
        "without_mesh": tables.without_mesh(details, inputs.runs, names),
        "groups": groups.table(inputs.measures, list(names)),
        "calibration": groups.calibration_table(inputs.measures, list(names)),
        "worst": worst,
    }


def render(inputs: Inputs, details: Sequence[tables.Detail], gallery: Gallery) -> str:
    """The HTML of the report."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("p2wss.eval"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = _number
    names = dataset_names(inputs.config)
    methods = method_names(inputs.runs)
    return environment.get_template("report.html.j2").render(
        region=inputs.region,
        names=names,
        methods=methods,
        main=gallery.main,
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
        worst=_worst(inputs, names, methods, gallery),
        counterparts=[
            {"about": counterpart, "pictures": _pictures(inputs, counterpart.exhibits, methods, gallery)}
            for counterpart in gallery.counterparts(inputs.config.num_pictures)
        ]
        if inputs.config.num_pictures
        else [],
        viewer=viewer(
            inputs.cases,
            inputs.reconstructions,
            inputs.measures.to_pylist(),
            names,
            methods,
            gallery.main,
        ),
        scans=inputs.scans,
        attribution=inputs.config.attribution,
        provenance=inputs.provenance,
    )


def method_names(runs: Sequence[tables.Run]) -> dict[str, str]:
    """Names of the methods, with a remark where the outputs are recorded."""
    return tables.METHOD_NAMES | {run.method: run.name for run in runs}


_ROW_TITLES = ("μ CD (m)", "Q1 CD (m)", "Q2 CD (m)", "Q3 CD (m)", "σ CD (m)", "μ #T", "σ #T")


def read_training(path: Path) -> list[dict[str, Any]]:
    """Records of a ``metrics.jsonl``. Raises :class:`InputError` if it cannot be read or a line is not JSON."""
    records = []
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    for number, line in enumerate(lines, 1):
        if line.strip():
            try:
                record = json.loads(line)
            except json.JSONDecodeError as error:
                raise InputError(f"{path}: line {number} is not JSON: {error}") from error
            records.append(record)
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
    main = tables.main_method(list(inputs.reconstructions))
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
        rows = inputs.measures.filter(pc.equal(inputs.measures["dataset"], dataset))
        for column, label in (
            ("chamfer_m", "Chamfer distance (m)"),
            ("points_to_mesh_m", "points to mesh (m)"),
        ):
            values = {
                run.method: np.array(
                    rows.filter(pc.equal(rows["method"], run.method))[column].drop_null().to_pylist(), float
                )
                for run in tables.ordered(inputs.runs)
            }
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


def _worst(
    inputs: Inputs, names: Mapping[str, str], methods: Mapping[str, str], gallery: Gallery
) -> list[dict[str, Any]]:
    """Per data set the worst buildings with pictures, and how often each cause occurs."""
    sections = []
    for dataset, title in names.items():
        exhibits = gallery.worst(dataset, inputs.config.num_worst)
        if exhibits:
            pictures = _pictures(inputs, exhibits, methods, gallery)
            sections.append({"title": title, "pictures": pictures, "causes": cause_counts(gallery, dataset)})
    return sections


def _pictures(
    inputs: Inputs, exhibits: Sequence[Exhibit], methods: Mapping[str, str], gallery: Gallery
) -> list[dict[str, Any]]:
    return [_picture(inputs, exhibit, methods, gallery) for exhibit in exhibits]


def _picture(
    inputs: Inputs, exhibit: Exhibit, methods: Mapping[str, str], gallery: Gallery
) -> dict[str, Any]:
    """The points of a building with our meshes and Roofer's; if that was not run, the fit's or the flat roof."""
    key = exhibit.key
    panels: list[tuple[str, Reconstruction]] = []
    for method in (*PICTURED, *PICTURED_INSTEAD):
        reconstruction = inputs.reconstructions.get(method, {}).get(key)
        if reconstruction is not None and reconstruction.has_mesh and len(panels) < len(PICTURED):
            row = gallery.rows[key[0], method][key]
            caption = f"{row['num_triangles']} triangles, CD {_number(row['chamfer_m'])} m"
            if row["points_to_mesh_m"] is not None:
                caption += f", points {_number(row['points_to_mesh_m'])} m"
            panels.append((f"{methods[method]}\n{caption}", reconstruction))
    image = figures.data_uri(figures.building(inputs.cases[key], panels), 85)
    return {"row": gallery.rows[key[0], exhibit.method][key], "image": image, "sentence": exhibit.sentence}
