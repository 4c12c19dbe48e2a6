"""``report.html``: one file that needs no other and no network."""

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

from p2wss import io
from p2wss.config import Eval
from p2wss.errors import InputError
from p2wss.eval import figures, tables
from p2wss.eval.cases import LIDAR, SYNTHETIC, Case, read_manifest, read_reconstructions, test_cases
from p2wss.eval.viewer import viewer
from p2wss.inference import Reconstruction

Key = tuple[str, str, str]
BREAKDOWNS = {
    "roof_type": "Roof type",
    "num_vertices": "Footprint vertices",
    "num_points": "Points",
    "visible_roof_share": "Visible share of the roof",
    "confidence": "Confidence",
}


@dataclass(frozen=True)
class Inputs:
    """All that the report shows. ``training``: records of ``metrics.jsonl`` per stage; ``provenance``: the
    metadata that each file carries."""

    region: str
    measures: pa.Table
    parameters: dict[str, Any]
    runs: Sequence[tables.Run]
    reconstructions: Mapping[str, Mapping[Key, Reconstruction]]
    cases: Mapping[Key, Case]
    training: Mapping[str, Sequence[dict[str, Any]]]
    provenance: Mapping[str, dict[str, Any]]
    config: Eval
    scans: Mapping[str, str] = field(default_factory=dict)  # tile to PNG as a data: address


def dataset_names(config: Eval) -> dict[str, str]:
    """What the report calls the data sets."""
    return {SYNTHETIC: "Synthetic", LIDAR: config.lidar_name}


def read(
    region: str,
    manifest: Path,
    measures: Path,
    parameters: Path,
    reconstructions: Sequence[Path],
    metrics: Sequence[Path],
    config: Eval,
    scans: Sequence[Path] = (),
) -> Inputs:
    """The report's inputs from files; a stage of training is named after the folder of its metrics."""
    tables_of = {}
    runs = []
    made_by: dict[str, dict[str, Any]] = {}
    for path in reconstructions:
        facts = io.read_metadata(path)
        method = str(facts.get("method", path.stem))
        runs.append(tables.Run(method, str(facts.get("status", "ok"))))
        tables_of[method] = read_reconstructions(path)
        made_by[path.name] = facts
    found = test_cases(read_manifest(manifest))
    listed = io.read_json(manifest)
    made_by[manifest.name] = {name: value for name, value in listed.items() if name != "shards"}
    made_by[measures.name] = io.read_metadata(measures)
    return Inputs(
        region,
        io.read_table(measures, io.MEASURES),
        io.read_json(parameters),
        runs,
        tables_of,
        {case.key: case for case in found},
        {path.parent.name: read_training(path) for path in metrics},
        made_by,
        config,
        {path.stem: figures.png_uri(path.read_bytes()) for path in scans},
    )


def documents(inputs: Inputs) -> dict[str, str]:
    """The files of the report: ``table1.csv``, ``table2.csv`` and ``report.html``, name to text."""
    details = tables.details(inputs.measures, inputs.config)
    columns = tables.columns_2(details, inputs.runs)
    return {
        "table1.csv": tables.to_csv(tables.table_1(inputs.parameters)),
        "table2.csv": tables.to_csv(tables.table_2(columns, dataset_names(inputs.config))),
        "report.html": render(inputs),
    }


def render(inputs: Inputs) -> str:
    """The HTML of the report."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("p2wss.eval"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = _number
    details = tables.details(inputs.measures, inputs.config)
    names = dataset_names(inputs.config)
    return environment.get_template("report.html.j2").render(
        region=inputs.region,
        names=names,
        methods=tables.METHOD_NAMES,
        parameters=inputs.parameters,
        settings=tables.SETTINGS_1,
        rows_1=tables.ROWS_1,
        paper_1=tables.PAPER_TABLE_1,
        rows_2=_ROW_TITLES,
        columns_2=tables.columns_2(details, inputs.runs),
        paper_datasets=tables.PAPER_DATASETS,
        details=details,
        runs=inputs.runs,
        failures=_failures(inputs.measures),
        breakdowns=_breakdowns(inputs.measures, names),
        distributions=_distributions(inputs, names),
        training=_training(inputs.training),
        pictures=_pictures(inputs),
        viewer=viewer(
            inputs.cases,
            inputs.reconstructions,
            inputs.measures.to_pylist(),
            names,
            tables.METHOD_NAMES,
            tables.OURS,
        ),
        scans=inputs.scans,
        attribution=inputs.config.attribution,
        provenance=inputs.provenance,
    )


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


def _failures(measures: pa.Table) -> list[tuple[str, str, str, int]]:
    """(data set, method, reason, buildings) of what has no mesh."""
    lost = measures.filter(pc.is_null(measures["num_triangles"]))
    counts: dict[tuple[str, str, str], int] = {}
    for row in lost.select(["dataset", "method", "status"]).to_pylist():
        key = (row["dataset"], row["method"], row["status"])
        counts[key] = counts.get(key, 0) + 1
    return [(*key, count) for key, count in sorted(counts.items())]


def _breakdowns(measures: pa.Table, names: Mapping[str, str]) -> list[dict[str, Any]]:
    found = []
    for dataset in names:
        for by, title in BREAKDOWNS.items():
            groups = tables.breakdown(measures, dataset, by)
            if len(groups) > 1:
                found.append({"dataset": names[dataset], "title": title, "groups": groups})
    return found


def _distributions(inputs: Inputs, names: Mapping[str, str]) -> list[str]:
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
                for run in inputs.runs
            }
            values = {method: sample for method, sample in values.items() if len(sample)}
            if values:
                found.append(figures.data_uri(figures.cumulative(values, label, title)))
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


def _pictures(inputs: Inputs) -> list[dict[str, Any]]:
    """Groups of pictures: the best, middle and worst buildings of our method by CD, beside the baselines."""
    measured = {
        (row["dataset"], row["tile"], row["building_id"], row["method"]): row
        for row in inputs.measures.to_pylist()
    }
    groups = []
    for dataset, title in dataset_names(inputs.config).items():
        ranked = sorted(
            (
                row
                for key, row in measured.items()
                if key[0] == dataset and key[3] == tables.OURS and row["chamfer_m"] is not None
            ),
            key=lambda row: (row["chamfer_m"], row["tile"], row["building_id"]),
        )
        for group, chosen in choose(len(ranked), inputs.config.num_pictures).items():
            pictures = [_picture(inputs, measured, ranked[i]) for i in chosen]
            if pictures:
                groups.append({"title": f"{title}: {group}", "pictures": pictures})
    return groups


def _picture(inputs: Inputs, measured: Mapping[Any, dict[str, Any]], row: dict[str, Any]) -> dict[str, Any]:
    key = (row["dataset"], row["tile"], row["building_id"])
    panels = []
    for method, found in inputs.reconstructions.items():
        if method != "constant" and key in found and found[key].has_mesh:
            own = measured[*key, method]
            name = tables.METHOD_NAMES.get(method, method)
            title = f"{name}\nCD {_number(own['chamfer_m'])} m, {own['num_triangles']} triangles"
            panels.append((title, found[key]))
    image = figures.data_uri(figures.building(inputs.cases[key], panels), 90)
    return {"row": row, "image": image}


def choose(count: int, per_group: int) -> dict[str, list[int]]:
    """Ranks of the best, the middle and the worst of ``count``, no rank twice.

    >>> choose(9, 2)
    {'best': [0, 1], 'median': [3, 4], 'worst': [7, 8]}
    """
    best = list(range(min(per_group, count)))
    worst = [i for i in range(max(count - per_group, 0), count) if i not in best]
    first = max((count - per_group) // 2, 0)
    middle = [i for i in range(first, min(first + per_group, count)) if i not in best and i not in worst]
    return {"best": best, "median": middle, "worst": worst}
