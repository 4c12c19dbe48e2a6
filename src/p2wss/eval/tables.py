"""Tables 1 and 2 with the rows of the paper, its figures beside ours, and measures that the paper does not report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from p2wss.config import Eval
from p2wss.data.seeds import generator
from p2wss.eval.baselines import RECORDED
from p2wss.eval.metrics.summary import Summary, summarize
from p2wss.reconstruct.product import FIT, NETWORK, NETWORK_AND_FIT
from p2wss.storage.schemas.crops import REAL, SIMULATED

# in the order of the columns
METHOD_NAMES = {
    "roofer": "Roofer",
    NETWORK: "Point2WSS",
    NETWORK_AND_FIT: "Point2WSS + fit",
    FIT: "Fit alone",
    "lod1": "LoD1 (flat)",
    "constant": "Constant",
}
OURS = (NETWORK, NETWORK_AND_FIT, FIT)

# Queffelec et al., Point2WSS, Table 1: MAE and standard deviation
PAPER_TABLE_1 = {"height_m": (0.23, 0.9), "angle_deg": (2.34, 5.35), "coordinate_m": (0.41, 0.93)}
# Table 2: mean, Q1, Q2, Q3 and standard deviation of CD, mean and standard deviation of the triangles
PAPER_TABLE_2 = {
    (SIMULATED, "roofer"): (1.25, 0.63, 0.95, 1.48, 1.08, 24.9, 17.1),
    (SIMULATED, NETWORK): (1.43, 0.59, 0.95, 1.72, 1.72, 17.2, 4.8),
    (REAL, "roofer"): (0.97, 0.57, 0.73, 1.01, 0.93, 25.6, 19.2),
    (REAL, NETWORK): (2.14, 0.98, 1.55, 2.45, 2.23, 17.3, 5.2),
}
PAPER_DATASETS = {SIMULATED: "Simulated", REAL: "HD LiDAR"}
ROWS_1 = {
    "height_m": "Height (m)",
    "angle_deg": "Angles (°)",
    "coordinate_m": "Footprint (m)",
    "vertex_m": "Footprint, Euclidean (m)",
    "height_seen_m": "Height, roof seen (m)",
    "angle_seen_deg": "Angles, roof face seen (°)",
}
SETTINGS_1 = {
    "all_masked": "Point2WSS, all masked",
    "all_masked_fit": "Point2WSS + fit, all masked",
    "all_masked_signs": "Point2WSS, signs masked too",
    "footprint_given": "Point2WSS, footprint given",
    NETWORK_AND_FIT: "Point2WSS + fit",
    FIT: "Fit alone",
    "constant": "Constant predictor",
}
ROWS_2 = ("mu_CD", "Q1_CD", "Q2_CD", "Q3_CD", "sigma_CD", "mu_#T", "sigma_#T")
# column of the measures: title, digits. Means with bootstrap intervals
MEANS = {
    "chamfer_m": ("CD (m)", 2),
    "roof_chamfer_m": ("Roof CD (m)", 2),
    "points_to_mesh_m": ("Points to mesh (m)", 2),
    "height_rmse_m": ("Height RMSE (m)", 2),
    "num_triangles": ("Triangles", 1),
    "num_mesh_vertices": ("Vertices", 1),
}
SHARES = {"watertight": "Watertight (%)", "manifold": "Manifold (%)", "planar": "Planar faces (%)"}


@dataclass(frozen=True)
class Run:
    """A method of the comparison.

    status: ``"ok"``, ``"recorded"`` or ``"not run: <reason>"``. note: a remark from the file, such as the version.
    """

    method: str
    status: str
    note: str = ""

    @property
    def was_run(self) -> bool:
        """Whether there are reconstructions, recorded ones included."""
        return self.status in ("ok", RECORDED)

    @property
    def name(self) -> str:
        """Name of the method, with a remark if its outputs are recorded."""
        name = METHOD_NAMES.get(self.method, self.method)
        return f"{name} ({RECORDED})" if self.status == RECORDED else name


@dataclass(frozen=True)
class Detail:
    """Statistics of a method on a data set.

    means: by the keys of :data:`MEANS`, over the buildings with a mesh. shares: by the keys of :data:`SHARES`, of
    the meshes. reasons: number of buildings without a mesh, by their status. flat_reasons: number of buildings with a
    flat roof instead, by their status. cpu_ms: CPU time per building.
    """

    dataset: str
    method: str
    num_buildings: int
    reasons: Mapping[str, int]
    means: Mapping[str, Summary]
    shares: Mapping[str, float]
    cpu_ms: float | None
    flat_reasons: Mapping[str, int] = field(default_factory=dict)

    @property
    def num_without_mesh(self) -> int:
        """The number of buildings without a mesh, for any reason."""
        return sum(self.reasons.values())

    @property
    def instead(self) -> dict[str, Mapping[str, int]]:
        """The reasons by what the buildings have instead of a mesh of the method."""
        return {"no mesh": self.reasons, "flat roof": self.flat_reasons}


@dataclass(frozen=True)
class Column:
    """One column of Table 2.

    values: the seven rows of :data:`ROWS_2`, None if the method was not run. detail: all statistics, None for the
    paper's columns. note: a remark for the title.
    """

    dataset: str
    method: str
    name: str
    source: str  # "paper" or "measured"
    values: Sequence[float] | None
    detail: Detail | None = None
    note: str = ""


def ordered(runs: Sequence[Run]) -> list[Run]:
    """The runs in the order of the columns."""
    names = list(METHOD_NAMES)
    return sorted(runs, key=lambda run: names.index(run.method) if run.method in names else len(names))


def table_1(parameters: Mapping[str, Any]) -> list[list[Any]]:
    """Header, then a row per parameter: MAE and deviation of the paper, then those of each setting with the count."""
    header = ["Parameter", "Paper MAE", "Paper std"]
    for name in SETTINGS_1.values():
        header += [f"{name} MAE", f"{name} std", f"{name} count"]
    rows: list[list[Any]] = [header]
    for key, title in ROWS_1.items():
        row: list[Any] = [title, *PAPER_TABLE_1.get(key, (None, None))]
        for setting in SETTINGS_1:
            error = parameters["settings"].get(setting, {}).get(key)
            row += [error["mean"], error["std"], error["count"]] if error else [None, None, None]
        rows.append(row)
    return rows


def columns_2(details: Sequence[Detail], runs: Sequence[Run]) -> list[Column]:
    """Columns of Table 2: per data set the paper's two, then one per method; without values if it was not run."""
    columns = []
    for dataset in (SIMULATED, REAL):
        for method, name in (("roofer", "Roofer"), (NETWORK, "Ours")):
            columns.append(Column(dataset, method, name, "paper", PAPER_TABLE_2[dataset, method]))
        by_method = {detail.method: detail for detail in details if detail.dataset == dataset}
        for run in ordered(runs):
            if run.method in by_method:
                detail = by_method[run.method]
                columns.append(Column(dataset, run.method, run.name, "measured", values_2(detail), detail))
            else:
                note = "no outputs recorded" if run.status == RECORDED else run.status
                columns.append(
                    Column(dataset, run.method, METHOD_NAMES.get(run.method, run.method), "measured", None, None,
                           "not run" if note == "ok" else note)
                )  # fmt: skip
    return columns


def values_2(detail: Detail) -> list[float]:
    """The seven values of :data:`ROWS_2`."""
    cd, triangles = detail.means["chamfer_m"], detail.means["num_triangles"]
    return [cd.mean, cd.q1, cd.median, cd.q3, cd.std, triangles.mean, triangles.std]


def table_2(columns: Sequence[Column], dataset_names: Mapping[str, str]) -> list[list[Any]]:
    """Header, then the paper's seven rows; the title of a column names data set, source and method."""
    rows: list[list[Any]] = [["Statistic", *_titles(columns, dataset_names)]]
    for i, name in enumerate(ROWS_2):
        rows.append([name, *(column.values[i] if column.values else None for column in columns)])
    return rows


def table_2_more(columns: Sequence[Column], dataset_names: Mapping[str, str]) -> list[list[Any]]:
    """Header, then the rows beyond the paper's, for the methods that were run.

    The rows are means with the bounds of their 95 % intervals, shares of the meshes, numbers of buildings, CPU time.
    """
    measured = [column for column in columns if column.detail is not None]
    details = [column.detail for column in measured if column.detail is not None]
    rows: list[list[Any]] = [["Measure", *_titles(measured, dataset_names)]]
    for key, (title, _) in MEANS.items():
        rows.append([title, *(detail.means[key].mean for detail in details)])
        rows.append([f"{title}, 95 % low", *(detail.means[key].low for detail in details)])
        rows.append([f"{title}, 95 % high", *(detail.means[key].high for detail in details)])
    for key, title in SHARES.items():
        rows.append([title, *(100 * detail.shares[key] for detail in details)])
    rows.append(["Buildings", *(detail.num_buildings for detail in details)])
    rows.append(["Without a mesh", *(detail.num_without_mesh for detail in details)])
    rows.append(["CPU time per building (ms)", *(detail.cpu_ms for detail in details)])
    return rows


def without_mesh(
    details: Sequence[Detail], runs: Sequence[Run], dataset_names: Mapping[str, str]
) -> list[Any]:
    """Header and rows of data set, method, what the buildings have instead, reason, number of buildings."""
    names = {run.method: run.name for run in runs}
    rows: list[list[Any]] = [["Data set", "Method", "Instead", "Reason", "Buildings"]]
    for detail in details:
        title = [dataset_names[detail.dataset], names.get(detail.method, detail.method)]
        for instead, reasons in detail.instead.items():
            rows += [[*title, instead, reason, count] for reason, count in sorted(reasons.items())]
    return rows


def _titles(columns: Sequence[Column], dataset_names: Mapping[str, str]) -> list[str]:
    titles = []
    for column in columns:
        names = PAPER_DATASETS if column.source == "paper" else dataset_names
        source = "paper: " if column.source == "paper" else ""
        title = f"{names[column.dataset]} / {source}{column.name}"
        titles.append(f"{title} ({column.note})" if column.note else title)
    return titles


def details(
    measures: pa.Table, config: Eval, cpu_ms: Mapping[str, Mapping[str, float]] | None = None
) -> list[Detail]:
    """Statistics per data set and method, in the order of their first rows in ``measures``.

    cpu_ms: milliseconds per building, by method and data set.
    """
    statistics = []
    keys = (
        measures.select(["dataset", "method"])
        .group_by(["dataset", "method"], use_threads=False)
        .aggregate([])
    )
    columns = measures.select(["dataset", "method", "status", *MEANS, *SHARES])
    for dataset, method in zip(keys["dataset"].to_pylist(), keys["method"].to_pylist(), strict=True):
        rows = rows_of(columns, dataset, method)
        without_mesh = pc.is_null(rows["num_triangles"])
        is_flat = pc.and_not(pc.fill_null(pc.not_equal(rows["status"], "ok"), False), without_mesh)
        statistics.append(
            Detail(
                dataset,
                method,
                len(rows),
                _counts(rows.filter(without_mesh)["status"].to_pylist()),
                {name: _summary(rows, name, config, dataset, method) for name in MEANS},
                {name: _share(rows, name) for name in SHARES},
                (cpu_ms or {}).get(method, {}).get(dataset),
                _counts(rows.filter(is_flat)["status"].to_pylist()),
            )
        )
    return statistics


def _counts(values: Sequence[str]) -> dict[str, int]:
    return {value: values.count(value) for value in dict.fromkeys(values)}


def _share(table: pa.Table, name: str) -> float:
    values = numbers(table, name)
    values = values[~np.isnan(values)]
    return float(np.mean(values)) if len(values) else float("nan")


def _summary(table: pa.Table, name: str, config: Eval, dataset: str, method: str) -> Summary:
    draw = generator(config.seed, "eval.bootstrap", dataset, method, name)
    return summarize(numbers(table, name), draw, config.num_resamples)


def rows_of(measures: pa.Table, dataset: str, method: str) -> pa.Table:
    """The rows of a data set and a method."""
    return measures.filter(
        pc.and_(pc.equal(measures["dataset"], dataset), pc.equal(measures["method"], method))
    )


def numbers(table: pa.Table, name: str) -> np.ndarray:
    """A column as float64, with NaN for null."""
    return pc.fill_null(table[name].cast(pa.float64()), np.nan).to_numpy()
