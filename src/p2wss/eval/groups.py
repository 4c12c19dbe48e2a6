"""Errors by kind of building, and calibration of the stated confidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from p2wss.eval.metrics import calibration as metrics
from p2wss.eval.metrics.calibration import Calibration
from p2wss.eval.tables import numbers, rows_of
from p2wss.reconstruct.product import FIT, NETWORK, NETWORK_AND_FIT

KIND = "kind"
BY = {
    KIND: "Roof",
    "num_vertices": "Edges of the footprint",
    "density_per_m2": "Points per m²",
    "visible_roof_share": "Visible share of the roof",
    "confidence": "Confidence",
}
# methods that state a confidence, the best first
STATED = (NETWORK_AND_FIT, FIT, NETWORK)
MEDIANS = ("chamfer_m", "roof_chamfer_m", "points_to_mesh_m", "height_rmse_m")
MEANS = ("height_error_m", "angle_error_deg")
HEADER_COLUMNS = ("dataset", "tile", "building_id", "method", "roof_type", "roof_kind")
HEADER = ("dataset", "by", "group", "method", "num_buildings", "num_meshes")


def table(measures: pa.Table, datasets: Sequence[str]) -> list[list[Any]]:
    """Header, then a row per data set, property (:data:`BY`), group and method.

    A row counts buildings and meshes and has the medians of :data:`MEDIANS` and the means of :data:`MEANS`. A group
    holds the same buildings for every method.
    """
    rows: list[list[Any]] = [
        [*HEADER, *(f"median_{name}" for name in MEDIANS), *(f"mean_{name}" for name in MEANS)]
    ]
    columns = measures.select([*HEADER_COLUMNS, *MEDIANS, *MEANS, *(by for by in BY if by != KIND)])
    for dataset in datasets:
        frame = _frame(columns.filter(pc.equal(columns["dataset"], dataset)))
        methods = list(frame["method"].unique())
        for by in BY:
            groups = group_of_building(frame, by)
            group = groups.reindex(frame["building"]).to_numpy()
            for name in groups.unique():
                in_group = frame[group == name]
                for method in methods:
                    part = in_group[in_group["method"] == method]
                    if len(part):
                        rows.append([dataset, by, name, method, *_statistics(part)])
    return rows


def _frame(measures: pa.Table) -> pd.DataFrame:
    """Measures of a data set with numbers as float64 and the number of the building, in order of first rows."""
    columns = {name: numbers(measures, name) for name in measures.schema.names if name not in HEADER_COLUMNS}
    texts = measures.select(["method", "roof_type", "roof_kind"]).to_pandas()
    key = measures["tile"].to_pandas(), measures["building_id"].to_pandas()
    building = pd.MultiIndex.from_arrays(key).factorize()[0]
    return pd.DataFrame({"building": building, **columns}).join(texts)


def group_of_building(frame: pd.DataFrame, by: str) -> pd.Series:
    """The group of each building of one data set, in the order of the groups; indexed by the building.

    A numerical property gives four groups of about equal size. Empty if all buildings are in the same group or the
    property is unknown.
    """
    if by == KIND:
        groups = _kinds(frame).sort_values(kind="stable")
    else:
        values = _values(frame, by).sort_values(kind="stable")
        groups = pd.Series(_quarters(values.to_numpy()), values.index, dtype=object)
    return groups if groups.nunique() > 1 else groups[:0]


def calibration(measures: pa.Table, dataset: str, method: str) -> Calibration:
    """The stated confidence of a method against the observed share of correct values."""
    rows = rows_of(measures.select(["dataset", "method", "confidence", "right_share"]), dataset, method)
    return metrics.calibration(numbers(rows, "confidence"), numbers(rows, "right_share"))


def calibration_table(measures: pa.Table, datasets: Sequence[str]) -> list[list[Any]]:
    """Header, then a row per data set, method of ours and bin; the last row of each method is all bins together."""
    rows: list[list[Any]] = [
        ["dataset", "method", "from", "to", "num_buildings", "stated", "observed", "mean_gap", "auc",
         "correlation"]
    ]  # fmt: skip
    for dataset in datasets:
        for method in STATED:
            scores = calibration(measures, dataset, method)
            for b in scores.bins:
                rows.append(
                    [dataset, method, b.low, b.high, b.count, b.stated, b.observed,
                     abs(b.stated - b.observed), None, None]
                )  # fmt: skip
            if scores.bins:
                rows.append(
                    [dataset, method, 0.0, 1.0, scores.count, scores.stated, scores.observed, scores.gap,
                     _finite(scores.auc), _finite(scores.correlation)]
                )  # fmt: skip
    return rows


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _values(frame: pd.DataFrame, by: str) -> pd.Series:
    """A numerical property of each building from the first row that has it; the confidence is our best variant's."""
    if by == "confidence":
        methods = set(frame["method"])
        frame = frame[frame["method"] == next((method for method in STATED if method in methods), None)]
    rows = frame[np.isfinite(frame[by])].drop_duplicates("building")
    return pd.Series(rows[by].to_numpy(), rows["building"])


def _kinds(frame: pd.DataFrame) -> pd.Series:
    """The roof type of each building by its label; without a label, by the angles of our best reconstruction."""
    rank = frame["method"].map({NETWORK_AND_FIT: 0, FIT: 1, NETWORK: 2})
    kind = frame["roof_type"].where(frame["roof_type"].notna(), frame["roof_kind"].where(rank.notna()))
    rows = frame.assign(kind=kind, rank=rank.fillna(3)).sort_values("rank", kind="stable")
    rows = rows[rows["kind"].notna()].drop_duplicates("building")
    return pd.Series(rows["kind"].to_numpy(), rows["building"], dtype=object)


def _statistics(part: pd.DataFrame) -> list[Any]:
    row: list[Any] = [len(part), int(part["chamfer_m"].notna().sum())]
    for names, statistic in ((MEDIANS, np.median), (MEANS, np.mean)):
        for name in names:
            values = part[name].dropna().to_numpy()
            row.append(float(statistic(values)) if len(values) else None)
    return row


def _quarters(values: np.ndarray) -> list[str]:
    """For each value the quarter that it belongs to, named by the least and greatest value in it."""
    if not len(values):
        return []
    edges = np.unique(np.quantile(values, [0.25, 0.5, 0.75]))
    group = np.searchsorted(edges, values, side="left")
    labels = {}
    for g in np.unique(group):
        members = values[group == g]
        low, high = f"{members.min():.3g}", f"{members.max():.3g}"
        labels[g] = low if low == high else f"{low} to {high}"
    return [labels[g] for g in group]
