"""Errors by kind of building, and whether the confidence is what it says."""

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
    """Header and a row per data set, property (:data:`BY`), group and method: buildings, meshes, medians of
    :data:`MEDIANS`, means of :data:`MEANS`. A group holds the same buildings whatever the method."""
    rows: list[list[Any]] = [
        [*HEADER, *(f"median_{name}" for name in MEDIANS), *(f"mean_{name}" for name in MEANS)]
    ]
    for dataset in datasets:
        own = measures.filter(pc.equal(measures["dataset"], dataset))
        for by in BY:
            groups = group_of_building(own, by)
            for group in dict.fromkeys(groups.values()):
                for method in dict.fromkeys(own["method"].to_pylist()):
                    chosen = pc.and_(
                        pc.equal(own["method"], method),
                        pa.array([groups.get(key) == group for key in _keys(own)]),
                    )
                    part = own.filter(chosen)
                    if len(part):
                        rows.append([dataset, by, group, method, *_statistics(part)])
    return rows


def group_of_building(measures: pa.Table, by: str) -> dict[tuple[str, str], str]:
    """Group of each building (tile, id) of one data set, in the order of the groups. Numbers make four groups
    of about equal size. Empty where all are in one group or nothing is known."""
    if by == KIND:
        kinds = _kinds(measures)
        found = sorted(set(kinds.values()))
        return {key: name for name in found for key in kinds if kinds[key] == name} if len(found) > 1 else {}
    values = _values(measures, by)
    if len(set(values.values())) < 2:
        return {}
    keys = sorted(values, key=lambda key: values[key])
    names = _quarters(np.array([values[key] for key in keys], float))
    return dict(zip(keys, names, strict=True)) if len(set(names)) > 1 else {}


def calibration(measures: pa.Table, dataset: str, method: str) -> Calibration:
    """The stated confidence against the observed share of right values."""
    own = measures.filter(
        pc.and_(pc.equal(measures["dataset"], dataset), pc.equal(measures["method"], method))
    )
    return metrics.calibration(numbers(own, "confidence"), numbers(own, "right_share"))


def calibration_table(measures: pa.Table, datasets: Sequence[str]) -> list[list[Any]]:
    """Header and a row per data set, method of ours and bin; the last of each is all of them together."""
    rows: list[list[Any]] = [
        ["dataset", "method", "from", "to", "num_buildings", "stated", "observed", "mean_gap", "auc",
         "correlation"]
    ]  # fmt: skip
    for dataset in datasets:
        for method in STATED:
            found = calibration(measures, dataset, method)
            for own in found.bins:
                rows.append(
                    [dataset, method, own.low, own.high, own.count, own.stated, own.observed,
                     abs(own.stated - own.observed), None, None]
                )  # fmt: skip
            if found.bins:
                rows.append(
                    [dataset, method, 0.0, 1.0, found.count, found.stated, found.observed, found.gap,
                     _known(found.auc), _known(found.correlation)]
                )  # fmt: skip
    return rows


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _keys(measures: pa.Table) -> list[tuple[str, str]]:
    return list(zip(measures["tile"].to_pylist(), measures["building_id"].to_pylist(), strict=True))


def _values(measures: pa.Table, by: str) -> dict[tuple[str, str], float]:
    """What is known of each building by the first row that knows it; the confidence of our best variant."""
    found: dict[tuple[str, str], float] = {}
    methods = measures["method"].to_pylist()
    best = next((method for method in STATED if method in methods), None)
    for key, value, method in zip(_keys(measures), measures[by].to_pylist(), methods, strict=True):
        if value is not None and np.isfinite(value) and (by != "confidence" or method == best):
            found.setdefault(key, float(value))
    return found


def _kinds(measures: pa.Table) -> dict[tuple[str, str], str]:
    """The label of the roof; without one the kind by the edges of our best reconstruction."""
    found: dict[tuple[str, str], str] = {}
    rank = {NETWORK_AND_FIT: 0, FIT: 1, NETWORK: 2}
    rows = measures.select(["tile", "building_id", "method", "roof_type", "roof_kind"]).to_pylist()
    for row in sorted(rows, key=lambda row: rank.get(row["method"], 3)):
        kind = row["roof_type"] or (row["roof_kind"] if row["method"] in rank else None)
        if kind is not None:
            found.setdefault((row["tile"], row["building_id"]), kind)
    return found


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
    """For each value the range of its quarter, as the values in it have it."""
    edges = np.unique(np.quantile(values, [0.25, 0.5, 0.75]))
    group = np.searchsorted(edges, values, side="left")
    labels = {}
    for g in np.unique(group):
        own = values[group == g]
        low, high = f"{own.min():.3g}", f"{own.max():.3g}"
        labels[g] = low if low == high else f"{low} to {high}"
    return [labels[g] for g in group]
