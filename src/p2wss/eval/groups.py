"""Errors by kind of building, and calibration of the stated confidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from p2wss.eval.tables import numbers
from p2wss.metrics import calibration as metrics
from p2wss.metrics.calibration import Calibration
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
HEADER = ("dataset", "by", "group", "method", "num_buildings", "num_meshes")


def table(measures: pa.Table, datasets: Sequence[str]) -> list[list[Any]]:
    """Header, then a row per data set, property (:data:`BY`), group and method.

    A row counts buildings and meshes and has the medians of :data:`MEDIANS` and the means of :data:`MEANS`. A group
    holds the same buildings for every method.
    """
    rows: list[list[Any]] = [
        [*HEADER, *(f"median_{name}" for name in MEDIANS), *(f"mean_{name}" for name in MEANS)]
    ]
    for dataset in datasets:
        of_dataset = measures.filter(pc.equal(measures["dataset"], dataset))
        for by in BY:
            groups = group_of_building(of_dataset, by)
            for group in dict.fromkeys(groups.values()):
                for method in dict.fromkeys(of_dataset["method"].to_pylist()):
                    mask = pc.and_(
                        pc.equal(of_dataset["method"], method),
                        pa.array([groups.get(key) == group for key in _keys(of_dataset)]),
                    )
                    part = of_dataset.filter(mask)
                    if len(part):
                        rows.append([dataset, by, group, method, *_statistics(part)])
    return rows


def group_of_building(measures: pa.Table, by: str) -> dict[tuple[str, str], str]:
    """The group of each building (tile, id) of one data set, in the order of the groups.

    A numerical property gives four groups of about equal size. Empty if all buildings are in the same group or the
    property is unknown.
    """
    if by == KIND:
        kinds = _kinds(measures)
        names = sorted(set(kinds.values()))
        return {key: name for name in names for key in kinds if kinds[key] == name} if len(names) > 1 else {}
    values = _values(measures, by)
    if len(set(values.values())) < 2:
        return {}
    keys = sorted(values, key=lambda key: values[key])
    quarters = _quarters(np.array([values[key] for key in keys], float))
    return dict(zip(keys, quarters, strict=True)) if len(set(quarters)) > 1 else {}


def calibration(measures: pa.Table, dataset: str, method: str) -> Calibration:
    """The stated confidence of a method against the observed share of correct values."""
    rows = measures.filter(
        pc.and_(pc.equal(measures["dataset"], dataset), pc.equal(measures["method"], method))
    )
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


def _keys(measures: pa.Table) -> list[tuple[str, str]]:
    return list(zip(measures["tile"].to_pylist(), measures["building_id"].to_pylist(), strict=True))


def _values(measures: pa.Table, by: str) -> dict[tuple[str, str], float]:
    """A numerical property of each building from the first row that has it; the confidence is our best variant's."""
    values: dict[tuple[str, str], float] = {}
    methods = measures["method"].to_pylist()
    best = next((method for method in STATED if method in methods), None)
    for key, value, method in zip(_keys(measures), measures[by].to_pylist(), methods, strict=True):
        if value is not None and np.isfinite(value) and (by != "confidence" or method == best):
            values.setdefault(key, float(value))
    return values


def _kinds(measures: pa.Table) -> dict[tuple[str, str], str]:
    """The roof type of each building by its label; without a label, by the angles of our best reconstruction."""
    kinds: dict[tuple[str, str], str] = {}
    rank = {NETWORK_AND_FIT: 0, FIT: 1, NETWORK: 2}
    rows = measures.select(["tile", "building_id", "method", "roof_type", "roof_kind"]).to_pylist()
    for row in sorted(rows, key=lambda row: rank.get(row["method"], 3)):
        kind = row["roof_type"] or (row["roof_kind"] if row["method"] in rank else None)
        if kind is not None:
            kinds.setdefault((row["tile"], row["building_id"]), kind)
    return kinds


def _statistics(part: pa.Table) -> list[Any]:
    cd = numbers(part, "chamfer_m")
    row: list[Any] = [len(part), int((~np.isnan(cd)).sum())]
    for names, statistic in ((MEDIANS, np.median), (MEANS, np.mean)):
        for name in names:
            values = numbers(part, name)
            values = values[~np.isnan(values)]
            row.append(float(statistic(values)) if len(values) else None)
    return row


def _quarters(values: np.ndarray) -> list[str]:
    """For each value the quarter that it belongs to, named by the least and greatest value in it."""
    edges = np.unique(np.quantile(values, [0.25, 0.5, 0.75]))
    group = np.searchsorted(edges, values, side="left")
    labels = {}
    for g in np.unique(group):
        members = values[group == g]
        low, high = f"{members.min():.3g}", f"{members.max():.3g}"
        labels[g] = low if low == high else f"{low} to {high}"
    return [labels[g] for g in group]
