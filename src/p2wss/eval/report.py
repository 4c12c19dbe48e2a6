"""``report.html``, one file that needs no other and no network, and its tables as CSV and LaTeX."""

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
from p2wss.data.schemas.measures import MEASURES
from p2wss.data.schemas.reconstructions import read_reconstructions
from p2wss.errors import InputError
from p2wss.eval import figures, groups, parameters, tables, texts
from p2wss.eval.cases import Case, read_manifest, test_cases
from p2wss.eval.gallery import Gallery, Shown, counts_of_reasons
from p2wss.eval.viewer import viewer
from p2wss.reconstruct.product import NETWORK, NETWORK_AND_FIT

Key = tuple[str, str, str]
# methods whose meshes stand in a picture, as far as they were run: with the points, four panels
PICTURED = (NETWORK, NETWORK_AND_FIT, "roofer")
PICTURED_ELSE = ("fit", "lod1")


@dataclass(frozen=True)
class Inputs:
    """All that the report shows. ``parameters``: errors of Table 1. ``cpu_ms``: per building, by method and
    data set. ``training``: records of ``metrics.jsonl`` per stage. ``provenance``: the metadata that each file
    carries. ``scans``: tile to PNG as a data: address."""

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
    """What the report calls the data sets."""
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
    """The report's inputs from files; a stage of training is named after the folder of its metrics."""
    tables_of = {}
    runs = []
    made_by: dict[str, dict[str, Any]] = {}
    for path in reconstructions:
        facts = files.read_metadata(path)
        method = str(facts.get("method", path.stem))
        runs.append(tables.Run(method, str(facts.get("status", "ok")), str(facts.get("roofer", ""))))
        tables_of[method] = read_reconstructions(path)
        made_by[path.name] = facts
    cases = {case.key: case for case in test_cases(read_manifest(manifest))}
    listed = files.read_json(manifest)
    made_by[manifest.name] = {name: value for name, value in listed.items() if name != "shards"}
    made_by[measures.name] = files.read_metadata(measures)
    times = [files.read_json(path) for path in cpu]
    return Inputs(
        region,
        files.read_table(measures, MEASURES),
        parameters.with_reconstructions(files.read_json(masked), cases, tables_of),
        runs,
        tables_of,
        cases,
        {path.parent.name: read_training(path) for path in metrics},
        made_by,
        config,
        {time["method"]: time["cpu_ms"] for time in times},
        {path.stem: figures.png_uri(path.read_bytes()) for path in scans},
    )


# name of the files: caption
CAPTIONS = {
    "table1": "Parameters: mean absolute errors on the simulated test split, ours and the paper's.",
    "table2": "Buildings: Chamfer distance (m) and number of triangles, ours and the paper's.",
    "table2_more": "Buildings: what the paper leaves out. Means with 95 % bootstrap intervals over buildings.",
    "without_mesh": "Buildings without a mesh, or with a flat roof instead, and why.",
    "groups": "Errors by kind of building: medians of distances, means of errors against the labels.",
    "calibration": "Stated confidence and observed share of heights and angles within 0.5 m and 5°.",
    "worst": "The buildings that our best variant does worst, and why.",
}


def documents(inputs: Inputs) -> dict[str, str]:
    """The files of the report, name to text: ``report.html``, and each of :data:`CAPTIONS` as CSV and LaTeX."""
    details = tables.details(inputs.measures, inputs.config, inputs.cpu_ms)
    gallery = Gallery(inputs.cases, inputs.reconstructions, inputs.measures.to_pylist())
    rows = _tables(inputs, details, gallery)
    found = {"report.html": render(inputs, details, gallery)}
    for name, caption in CAPTIONS.items():
        found[f"{name}.csv"] = texts.to_csv(rows[name])
        found[f"{name}.tex"] = texts.to_latex(rows[name], caption, f"tab:p2wss-{name.replace('_', '-')}")
    return found


def _tables(inputs: Inputs, details: Sequence[tables.Detail], gallery: Gallery) -> dict[str, list[list[Any]]]:
    names = dataset_names(inputs.config)
    columns = tables.columns_2(details, inputs.runs)
    worst: list[list[Any]] = [["dataset", "tile", "building_id", "method", "points_to_mesh_m", "CD_m", "why"]]
    for dataset in names:
        for shown in gallery.worst(dataset, inputs.config.num_worst):
            row = gallery.rows[dataset, shown.method][shown.key]
            worst.append(
                [*shown.key, shown.method, row["points_to_mesh_m"], row["chamfer_m"], shown.sentence]
            )
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
            {"about": own, "pictures": _pictures(inputs, own.shown, methods, gallery)}
            for own in gallery.counterparts(inputs.config.num_pictures)
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
    """What every method is called, recorded ones as such."""
    return tables.METHOD_NAMES | {run.method: run.name for run in runs}


_ROW_TITLES = ("μ CD (m)", "Q1 CD (m)", "Q2 CD (m)", "Q3 CD (m)", "σ CD (m)", "μ #T", "σ #T")


def read_training(path: Path) -> list[dict[str, Any]]:
    """Records of a ``metrics.jsonl``. Raises :class:`InputError` for a line that is no JSON object."""
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
    """Per data set and property a table: groups, and per method the median distance from points to mesh, with
    labels also the mean errors of height and angles of our best variant."""
    header, *rows = groups.table(inputs.measures, list(names))
    records = [dict(zip(header, row, strict=True)) for row in rows]
    main = tables.main_method(list(inputs.reconstructions))
    found = []
    for dataset in names:
        for by, title in groups.BY.items():
            own = [r for r in records if r["dataset"] == dataset and r["by"] == by]
            if own:
                used = [name for name in methods if any(r["method"] == name for r in own)]
                lines = []
                for group in dict.fromkeys(r["group"] for r in own):
                    cells = {r["method"]: r for r in own if r["group"] == group}
                    lines.append((group, [cells.get(name) for name in used], cells.get(main)))
                labelled = any(r["mean_height_error_m"] is not None for r in own)
                found.append(
                    {
                        "dataset": dataset,
                        "title": title,
                        "methods": used,
                        "lines": lines,
                        "labelled": labelled,
                    }
                )
    return found


def _calibration(
    inputs: Inputs, names: Mapping[str, str], methods: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Reliability diagrams of the data sets with labels, with a few numbers per method."""
    found = []
    for dataset, title in names.items():
        made = {method: groups.calibration(inputs.measures, dataset, method) for method in groups.STATED}
        known = {method: own for method, own in made.items() if own.bins}
        if known:
            bins = {method: own.bins for method, own in known.items()}
            image = figures.data_uri(figures.reliability_diagram(bins, methods, f"{title}: confidence"))
            told = [(methods[method], own) for method, own in known.items()]
            found.append({"image": image, "told": told, "title": title})
    return found


def _distributions(inputs: Inputs, names: Mapping[str, str], methods: Mapping[str, str]) -> list[str]:
    found = []
    for dataset, title in names.items():
        own = inputs.measures.filter(pc.equal(inputs.measures["dataset"], dataset))
        for column, label in (
            ("chamfer_m", "Chamfer distance (m)"),
            ("points_to_mesh_m", "points to mesh (m)"),
        ):
            values = {
                run.method: np.array(
                    own.filter(pc.equal(own["method"], run.method))[column].drop_null().to_pylist(), float
                )
                for run in tables.ordered(inputs.runs)
            }
            values = {method: sample for method, sample in values.items() if len(sample)}
            if values:
                found.append(figures.data_uri(figures.cumulative(values, methods, label, title)))
    return found


def _training(stages: Mapping[str, Sequence[dict[str, Any]]]) -> list[tuple[str, str]]:
    """(stage, image) with the curves of every number that a record has beside its step."""
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
    """Curves grouped by what they measure: losses, errors in metres, errors in degrees."""
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
    return {title: {name: curves[name] for name in found} for title, found in groups.items() if found}


def _worst(
    inputs: Inputs, names: Mapping[str, str], methods: Mapping[str, str], gallery: Gallery
) -> list[dict[str, Any]]:
    """Per data set the worst buildings with pictures, and how often each reason is found."""
    found = []
    for dataset, title in names.items():
        shown = gallery.worst(dataset, inputs.config.num_worst)
        if shown:
            pictures = _pictures(inputs, shown, methods, gallery)
            reasons = counts_of_reasons(gallery, dataset)
            found.append({"title": title, "pictures": pictures, "reasons": reasons})
    return found


def _pictures(
    inputs: Inputs, shown: Sequence[Shown], methods: Mapping[str, str], gallery: Gallery
) -> list[dict[str, Any]]:
    return [_picture(inputs, own, methods, gallery) for own in shown]


def _picture(inputs: Inputs, shown: Shown, methods: Mapping[str, str], gallery: Gallery) -> dict[str, Any]:
    """A building's points, and with them our meshes and Roofer's (without it the fit's or the flat roof)."""
    key = shown.key
    panels: list[tuple[str, Reconstruction]] = []
    for method in (*PICTURED, *PICTURED_ELSE):
        made = inputs.reconstructions.get(method, {}).get(key)
        if made is not None and made.has_mesh and len(panels) < len(PICTURED):
            own = gallery.rows[key[0], method][key]
            off = own["points_to_mesh_m"]
            told = f"{own['num_triangles']} triangles, CD {_number(own['chamfer_m'])} m"
            told += f", points {_number(off)} m" if off is not None else ""
            panels.append((f"{methods[method]}\n{told}", made))
    image = figures.data_uri(figures.building(inputs.cases[key], panels), 85)
    return {"row": gallery.rows[key[0], shown.method][key], "image": image, "sentence": shown.sentence}
