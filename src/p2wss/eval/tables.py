"""Tables 1 and 2 with the paper's rows, its figures and ours side by side, and what the paper leaves out."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from p2wss.config import Eval
from p2wss.eval.cases import LIDAR, SYNTHETIC
from p2wss.metrics.summary import Summary, summarize
from p2wss.seeds import generator

OURS = "point2wss"
METHOD_NAMES = {OURS: "Ours", "roofer": "Roofer", "lod1": "LoD1 (flat)", "constant": "Constant"}

# Queffelec et al., Point2WSS, Table 1: MAE and standard deviation
PAPER_TABLE_1 = {"height_m": (0.23, 0.9), "angle_deg": (2.34, 5.35), "coordinate_m": (0.41, 0.93)}
# Table 2: mean, Q1, Q2, Q3 and standard deviation of CD, mean and standard deviation of the triangles
PAPER_TABLE_2 = {
    (SYNTHETIC, "roofer"): (1.25, 0.63, 0.95, 1.48, 1.08, 24.9, 17.1),
    (SYNTHETIC, OURS): (1.43, 0.59, 0.95, 1.72, 1.72, 17.2, 4.8),
    (LIDAR, "roofer"): (0.97, 0.57, 0.73, 1.01, 0.93, 25.6, 19.2),
    (LIDAR, OURS): (2.14, 0.98, 1.55, 2.45, 2.23, 17.3, 5.2),
}
PAPER_DATASETS = {SYNTHETIC: "Synthetic", LIDAR: "HD LiDAR"}
ROWS_1 = {
    "height_m": "Height (m)",
    "angle_deg": "Angles (°)",
    "coordinate_m": "Footprint (m)",
    "vertex_m": "Footprint, Euclidean (m)",
}
SETTINGS_1 = {
    "all_masked": "Ours, all masked",
    "all_masked_signs": "Ours, signs masked too",
    "footprint_given": "Ours, footprint given",
    "constant": "Constant predictor",
}
ROWS_2 = ("mu_CD", "Q1_CD", "Q2_CD", "Q3_CD", "sigma_CD", "mu_#T", "sigma_#T")


@dataclass(frozen=True)
class Run:
    """A method of the comparison and whether it was run: ``"ok"``, or ``"not run: .."``."""

    method: str
    status: str

    @property
    def was_run(self) -> bool:
        return self.status == "ok"


@dataclass(frozen=True)
class Column:
    """One column of Table 2: whose figures, on which data set, the seven values of :data:`ROWS_2` or None."""

    dataset: str
    method: str
    source: str  # "paper", or "measured"
    values: Sequence[float] | None
    note: str = ""


@dataclass(frozen=True)
class Detail:
    """What the paper does not report, of one data set and method. Shares are of the meshes."""

    dataset: str
    method: str
    num_buildings: int
    num_without_mesh: int
    chamfer_m: Summary
    roof_chamfer_m: Summary
    points_to_mesh_m: Summary
    num_triangles: Summary
    watertight_share: float


def table_1(parameters: dict[str, Any]) -> list[list[Any]]:
    """Header and rows: per parameter the paper's MAE and deviation, then each setting's with its count."""
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
    """Columns of Table 2: per data set the paper's two, then one per method; one not run has no values."""
    columns = []
    for dataset in (SYNTHETIC, LIDAR):
        for method in ("roofer", OURS):
            columns.append(Column(dataset, method, "paper", PAPER_TABLE_2[dataset, method]))
        found = {detail.method: detail for detail in details if detail.dataset == dataset}
        for run in runs:
            if run.method in found:
                columns.append(Column(dataset, run.method, "measured", values_2(found[run.method])))
            elif not run.was_run:
                columns.append(Column(dataset, run.method, "measured", None, run.status))
    return columns


def values_2(detail: Detail) -> list[float]:
    """The seven values of :data:`ROWS_2`."""
    cd, triangles = detail.chamfer_m, detail.num_triangles
    return [cd.mean, cd.q1, cd.median, cd.q3, cd.std, triangles.mean, triangles.std]


def table_2(columns: Sequence[Column], dataset_names: dict[str, str]) -> list[list[Any]]:
    """Header and the paper's seven rows; a column's title tells data set, source and method."""
    header = ["Statistic"]
    for column in columns:
        names = PAPER_DATASETS if column.source == "paper" else dataset_names
        source = "paper: " if column.source == "paper" else ""
        title = f"{names[column.dataset]} / {source}{METHOD_NAMES.get(column.method, column.method)}"
        header.append(f"{title} ({column.note})" if column.note else title)
    rows: list[list[Any]] = [header]
    for i, name in enumerate(ROWS_2):
        rows.append([name, *(column.values[i] if column.values else None for column in columns)])
    return rows


def details(measures: pa.Table, config: Eval) -> list[Detail]:
    """Statistics per data set and method, in the order of their first rows."""
    found = []
    keys = list(
        dict.fromkeys(zip(measures["dataset"].to_pylist(), measures["method"].to_pylist(), strict=True))
    )
    for dataset, method in keys:
        own = measures.filter(
            pc.and_(pc.equal(measures["dataset"], dataset), pc.equal(measures["method"], method))
        )
        watertight = [value for value in own["watertight"].to_pylist() if value is not None]
        cd, roof, to_mesh, triangles = (
            _summary(own, name, config, dataset, method)
            for name in ("chamfer_m", "roof_chamfer_m", "points_to_mesh_m", "num_triangles")
        )
        found.append(
            Detail(
                dataset,
                method,
                num_buildings=len(own),
                num_without_mesh=len(own) - len(watertight),
                chamfer_m=cd,
                roof_chamfer_m=roof,
                points_to_mesh_m=to_mesh,
                num_triangles=triangles,
                watertight_share=float(np.mean(watertight)) if watertight else float("nan"),
            )
        )
    return found


def breakdown(
    measures: pa.Table, dataset: str, by: str, method: str = OURS
) -> list[tuple[str, int, float, float]]:
    """(group, buildings with a mesh, median CD, median points-to-mesh) of a method, by a column of the
    measures: text as it is, numbers in four groups of equal size."""
    own = measures.filter(
        pc.and_(pc.equal(measures["dataset"], dataset), pc.equal(measures["method"], method))
    )
    own = own.filter(pc.is_valid(own["chamfer_m"]))
    values = own[by].to_pylist()
    if not values or all(value is None for value in values):
        return []
    names = values if isinstance(values[0], str) else _quarters(np.array(values, float))
    chamfer = _numbers(own, "chamfer_m")
    to_mesh = _numbers(own, "points_to_mesh_m")
    groups = []
    for name in dict.fromkeys(names[i] for i in np.argsort(values, kind="stable")):
        chosen = np.array([n == name for n in names])
        known = to_mesh[chosen][~np.isnan(to_mesh[chosen])]
        groups.append(
            (
                str(name),
                int(chosen.sum()),
                float(np.median(chamfer[chosen])),
                float(np.median(known)) if len(known) else float("nan"),
            )
        )
    return groups


def to_csv(rows: Sequence[Sequence[Any]]) -> str:
    """Comma-separated text; numbers with four decimals, None and NaN as empty cells."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([[_cell(value) for value in row] for row in rows])
    return text.getvalue()


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:.4f}" if isinstance(value, float) else str(value)


def _summary(table: pa.Table, name: str, config: Eval, dataset: str, method: str) -> Summary:
    draw = generator(config.seed, "eval.bootstrap", dataset, method, name)
    return summarize(_numbers(table, name), draw, config.num_resamples)


def _numbers(table: pa.Table, name: str) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in table[name].to_pylist()], float)


def _quarters(values: np.ndarray) -> list[str]:
    """For each value the range of its quarter, as the values in it have it."""
    edges = np.unique(np.quantile(values, [0.25, 0.5, 0.75]))
    group = np.searchsorted(edges, values, side="left")
    labels = {}
    for g in np.unique(group):
        own = values[group == g]
        low, high = f"{own.min():.3g}", f"{own.max():.3g}"
        labels[g] = low if low == high else f"{low} to {high}"
    return [labels[g] for g in group]
