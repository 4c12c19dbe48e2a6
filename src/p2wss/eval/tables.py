"""The tables of the report: Tables 1 and 2 with the rows and figures of the paper, and tables that the paper lacks."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from scipy import stats

from p2wss.config import Eval
from p2wss.data import reasons
from p2wss.data.seeds import generator
from p2wss.eval.methods import MASKED
from p2wss.reconstruction.product import FIT, NETWORK
from p2wss.storage.schemas.crops import REAL, SIMULATED

# in the order of the columns
METHOD_NAMES = {
    "roofer": "Roofer",
    NETWORK: "Point2WSS",
    FIT: "Fit alone",
    "lod1": "LoD1 (flat)",
    "constant": "Constant",
}

# Queffelec et al., Point2WSS, Table 1: MAE and standard deviation
PAPER_TABLE_1 = {"Height (m)": (0.23, 0.9), "Angles (°)": (2.34, 5.35), "Footprint (m)": (0.41, 0.93)}
# Table 2: mean, Q1, Q2, Q3 and standard deviation of CD, mean and standard deviation of the triangles
PAPER_TABLE_2 = {
    SIMULATED: {
        "Simulated / paper: Roofer": (1.25, 0.63, 0.95, 1.48, 1.08, 24.9, 17.1),
        "Simulated / paper: Ours": (1.43, 0.59, 0.95, 1.72, 1.72, 17.2, 4.8),
    },
    REAL: {
        "HD LiDAR / paper: Roofer": (0.97, 0.57, 0.73, 1.01, 0.93, 25.6, 19.2),
        "HD LiDAR / paper: Ours": (2.14, 0.98, 1.55, 2.45, 2.23, 17.3, 5.2),
    },
}
SETTINGS_1 = {
    "all_masked": "Point2WSS, all masked",
    "all_masked_signs": "Point2WSS, signs masked too",
    NETWORK: "Point2WSS, footprint given",
    FIT: "Fit alone",
    "constant": "Constant predictor",
}
ROWS_2 = ("mu_CD", "Q1_CD", "Q2_CD", "Q3_CD", "sigma_CD", "mu_#T", "sigma_#T")
# column of the measures: title
MEANS = {
    "chamfer_m": "CD (m)",
    "roof_chamfer_m": "Roof CD (m)",
    "points_to_mesh_m": "Points to mesh (m)",
    "height_rmse_m": "Height RMSE (m)",
    "num_triangles": "Triangles",
    "false_edge_share": "False roof edges (share)",
    "missing_edge_share": "Missing roof edges (share)",
}
SHARES = {"watertight": "Watertight (%)", "manifold": "Manifold (%)", "planar": "Planar faces (%)"}
# properties of buildings by which errors are shown
GROUPS = {
    "roof_kind": "Roof",
    "num_vertices": "Edges of the footprint",
    "density_per_m2": "Points per m²",
    "visible_roof_share": "Visible share of the roof",
}


class Run(NamedTuple):
    """A method of the comparison.

    status: ``"ok"``, ``"recorded"`` or ``"not run: <reason>"``. note: a remark from the file, such as the version.
    """

    method: str
    status: str
    note: str = ""

    @property
    def name(self) -> str:
        """Name of the method, with a remark if its outputs are recorded or if it was not run."""
        name = METHOD_NAMES.get(self.method, self.method)
        return name if self.status == "ok" else f"{name} ({self.status})"


def ordered(runs: Sequence[Run]) -> list[Run]:
    """The runs of methods that make meshes, in the order of the columns."""
    return sorted(
        (run for run in runs if run.method in METHOD_NAMES),
        key=lambda run: list(METHOD_NAMES).index(run.method),
    )


def frame_of(measures: pa.Table, runs: Sequence[Run]) -> pd.DataFrame:
    """The measures of meshes, without errors per edge; ``method`` is in the order of the runs, numbers are floats.

    ``roof_kind`` is the label, or else the kind of the best of our variants.
    """
    is_list = [pa.types.is_list(field.type) for field in measures.schema]
    names = [name for name, skipped in zip(measures.column_names, is_list, strict=True) if not skipped]
    frame = measures.select(names).to_pandas(strings_to_categorical=True)
    numeric = [*MEANS, *SHARES, "height_error_m"]
    frame = frame.astype(dict.fromkeys(numeric, float)).assign(
        method=frame["method"].cat.set_categories([run.method for run in runs], ordered=True)
    )
    frame = frame[frame["method"].notna()]
    key = ["dataset", "tile", "building_id"]
    best = frame[frame["method"] == main_method(runs)].set_index(key)["roof_kind"].astype(object)
    kind = best.reindex(pd.MultiIndex.from_frame(frame[key])).to_numpy()
    return frame.assign(roof_kind=frame["roof_type"].astype(object).where(frame["roof_type"].notna(), kind))


def main_method(runs: Sequence[Run]) -> str:
    """Our best variant: the fit if it was run, else the network."""
    return FIT if any(run.method == FIT for run in runs) else NETWORK


def table_1(measures: pa.Table) -> pd.DataFrame:
    """A row per parameter: MAE and deviation in the paper, then MAE, deviation and count of each setting."""
    columns = {
        f"Paper {name}": {title: values[i] for title, values in PAPER_TABLE_1.items()}
        for i, name in enumerate(("MAE", "std"))
    }
    for method, title in SETTINGS_1.items():
        rows = measures.filter(pc.equal(measures["method"], method))
        height_m, is_height_seen = rows["height_error_m"].to_numpy(), rows["is_height_seen"].to_numpy()
        angle_deg, is_angle_seen, offset_m = (
            pc.list_flatten(rows[name]).to_numpy()
            for name in ("angle_error_deg", "is_angle_seen", "coordinate_error_m")
        )
        errors = {
            "Height (m)": height_m,
            "Angles (°)": angle_deg,
            "Footprint (m)": offset_m,
            "Footprint, Euclidean (m)": np.hypot(offset_m[::2], offset_m[1::2]),
            "Height, roof seen (m)": height_m[is_height_seen.astype(bool)],
            "Angles, roof face seen (°)": angle_deg[is_angle_seen.astype(bool)],
        }
        known = {name: pd.Series(values, dtype=float).dropna() for name, values in errors.items()}
        columns[f"{title} MAE"] = {name: values.mean() for name, values in known.items()}
        columns[f"{title} std"] = {name: values.std(ddof=0) for name, values in known.items()}
        columns[f"{title} count"] = {name: len(values) for name, values in known.items()}
    return pd.DataFrame(columns, list(errors)).rename_axis("Parameter").reset_index()


def compared(frame: pd.DataFrame) -> pd.Series:
    """Mask of the rows whose building has a mesh of every method. A method without any mesh in a data set does not
    count there."""
    has_mesh = frame["num_triangles"].notna()
    rows = frame[has_mesh]
    num_methods = rows.groupby("dataset", observed=True)["method"].nunique()
    num = rows.groupby(["dataset", "tile", "building_id"], observed=True).size()
    keys = num[num == num_methods.reindex(num.index.get_level_values("dataset")).to_numpy()].index
    return has_mesh & pd.MultiIndex.from_frame(frame[list(keys.names)]).isin(keys)


def was_not_run(frame: pd.DataFrame) -> pd.Series:
    """Mask of the rows for which a method has no recorded output: it did not fail there."""
    return frame["status"].isin([reasons.NOT_RECORDED, reasons.OTHER_CLOUDS])


def _title(run: Run, rows: pd.DataFrame) -> str:
    """The name of the method. It states the reason if the method has no mesh in a data set, always for the same reason,
    and it says if meshes were made from other points."""
    states = rows["status"].unique()
    if reasons.OTHER_POINTS in states:
        return f"{METHOD_NAMES[run.method]} ({run.status}, from other points of the same buildings)"
    if len(states) != 1 or rows["num_triangles"].notna().any():
        return run.name
    return f"{METHOD_NAMES[run.method]} ({'not run: ' if was_not_run(rows).all() else ''}{states[0]})"


def table_2(frame: pd.DataFrame, runs: Sequence[Run], titles: Mapping[str, str]) -> pd.DataFrame:
    """The paper's seven rows, over the buildings that every method has. A column is named by data set, source and
    method."""
    columns: dict[str, Any] = {"Statistic": ROWS_2}
    is_compared = compared(frame)
    for dataset, of_paper in PAPER_TABLE_2.items():
        columns |= of_paper
        for run in ordered(runs):
            is_of = (frame["dataset"] == dataset) & (frame["method"] == run.method)
            rows = frame[is_of & is_compared]
            cd, triangles = rows["chamfer_m"], rows["num_triangles"]
            quartiles = cd.quantile([0.25, 0.5, 0.75])
            columns[f"{titles[dataset]} / {_title(run, frame[is_of])}"] = (
                cd.mean(), *quartiles, cd.std(ddof=0), triangles.mean(), triangles.std(ddof=0)
            )  # fmt: skip
    return pd.DataFrame(columns)


def table_2_more(
    frame: pd.DataFrame, runs: Sequence[Run], titles: Mapping[str, str], config: Eval
) -> pd.DataFrame:
    """A column per data set and method: means with the bounds of their 95 % intervals and shares of the meshes, over
    the buildings that every method has; counts."""
    by_method = {run.method: run for run in runs}
    columns, is_compared = {}, compared(frame)
    for keys, part in frame.groupby(["dataset", "method"], observed=True):
        dataset, method = map(str, keys)
        column: dict[str, float] = {}
        shared = part[is_compared[part.index]]
        for name, title in MEANS.items():
            values = shared[name].dropna().to_numpy()
            draw = generator(config.seed, "eval.bootstrap", dataset, method, name)
            column[title] = shared[name].mean()
            bounds = interval(values, draw, config.num_resamples)
            column[f"{title}, 95 % low"], column[f"{title}, 95 % high"] = bounds
        column |= {title: 100 * shared[name].mean() for name, title in SHARES.items()}
        was_run = part[~was_not_run(part)]
        column |= {"Buildings": len(was_run), "Without a mesh": int(was_run["num_triangles"].isna().sum())}
        column["Compared"] = len(shared)
        columns[f"{titles[dataset]} / {_title(by_method[method], part)}"] = pd.Series(column, dtype=object)
    # as objects: a count stays a whole number beside means
    return pd.DataFrame(columns).rename_axis("Measure").reset_index()


def interval(values: np.ndarray, draw: np.random.Generator, num_resamples: int) -> tuple[float, float]:
    """Bounds of the mean with 95 % confidence by the percentile bootstrap (Efron 1979); NaN for fewer than two
    values."""
    if len(values) < 2:
        return np.nan, np.nan
    # a few resamples at a time: the draws are the same in pieces of any size
    batch = max((1 << 19) // len(values), 1)
    low, high = stats.bootstrap(
        (values,), np.mean, n_resamples=num_resamples, batch=batch, method="percentile", rng=draw
    ).confidence_interval
    return float(low), float(high)


def without_mesh(frame: pd.DataFrame, runs: Sequence[Run], titles: Mapping[str, str]) -> pd.DataFrame:
    """Numbers of buildings by reason, for buildings with no mesh of a method, with a flat roof instead, or for which
    the method was not run."""
    missing = frame["num_triangles"].isna()
    rows = frame[missing | ~frame["status"].isin([reasons.OK, reasons.OTHER_POINTS])]
    named = pd.DataFrame(
        {
            "Data set": rows["dataset"].map(titles),
            "Method": rows["method"].map({run.method: run.name for run in runs}),
            "Instead": np.where(
                was_not_run(rows), "not run", np.where(missing[rows.index], "no mesh", "flat roof")
            ),
            "Reason": rows["status"],
        }
    )
    return named.astype(str).value_counts(sort=False).rename("Buildings").reset_index()


def by_group(frame: pd.DataFrame, runs: Sequence[Run], titles: Mapping[str, str]) -> pd.DataFrame:
    """A row per data set, property (:data:`GROUPS`), group and method: medians of distances, means of errors against
    labels.

    Groups contain only buildings with a mesh of every method. A numerical property gives four groups of about equal
    size.
    """
    frame, parts = frame[compared(frame)], []
    for dataset, data_set in titles.items():
        of_dataset = frame[frame["dataset"] == dataset]
        for name, title in GROUPS.items():
            values = of_dataset[name]
            if name != "roof_kind":
                values = _quarters(values)
            if values.nunique() > 1:
                keys = [
                    values.rename("Group"),
                    of_dataset["method"].map({run.method: run.name for run in runs}),
                ]
                grouped = of_dataset.groupby(keys, observed=True)
                part = grouped[["num_vertices"]].count().set_axis(["Buildings"], axis=1)
                part = part.join(
                    grouped[list(MEANS)[:4]].median().rename(columns=lambda m: f"Median {MEANS[m]}")
                )
                part["Mean height error (m)"] = grouped["height_error_m"].mean()
                part = part.rename_axis(["Group", "Method"]).reset_index()
                parts.append(part.assign(**{"Data set": data_set, "By": title}))
    first = ["Data set", "By", "Group", "Method"]
    return pd.concat(parts).set_index(first).reset_index() if parts else pd.DataFrame(columns=first)


def _quarters(values: pd.Series) -> pd.Series:
    """For each value its quartile group, named by the least and the greatest value in the group."""
    quarters = pd.qcut(values, 4, duplicates="drop").cat.remove_unused_categories()
    limits = values.groupby(quarters, observed=True).agg(["min", "max"])
    return quarters.cat.rename_categories([f"{low:.3g} to {high:.3g}" for low, high in limits.to_numpy()])


def ranked(frame: pd.DataFrame, runs: Sequence[Run]) -> pd.DataFrame:
    """The rows of our best variant, the buildings farthest from their points first. Buildings without a mesh, or with
    too few points to measure the distance, come before them."""
    rows = frame[frame["method"] == main_method(runs)]
    rows = rows.assign(score=rows["points_to_mesh_m"].fillna(np.inf)).astype(
        {"tile": str, "building_id": str}
    )
    return rows.sort_values(["score", "tile", "building_id"], ascending=[False, True, True])


def worst(rows: pd.DataFrame, titles: Mapping[str, str], count: int) -> pd.DataFrame:
    """The first rows of each data set. rows: of :func:`ranked`."""
    chosen = rows.sort_values("dataset", kind="stable").groupby("dataset", observed=True).head(count)
    return pd.DataFrame(
        {
            "Data set": chosen["dataset"].map(titles),
            "Tile": chosen["tile"],
            "Building": chosen["building_id"],
            "Points to mesh (m)": chosen["points_to_mesh_m"],
            "CD (m)": chosen["chamfer_m"],
            "Triangles": chosen["num_triangles"].astype("Int64"),
            "Roof": chosen["roof_kind"],
            "Status": chosen["status"].astype(str),
            "Points": chosen["num_points"],
            "Visible share of the roof": chosen["visible_roof_share"],
        }
    )


def num_left_out(measures: pa.Table) -> int:
    """How many labelled buildings the masked settings could not take."""
    counts = {row["values"]: row["counts"] for row in pc.value_counts(measures["method"]).to_pylist()}
    labelled = measures.filter(pc.equal(measures["dataset"], SIMULATED))
    buildings = labelled.select(["tile", "building_id"]).group_by(["tile", "building_id"]).aggregate([])
    return len(buildings) - counts.get(MASKED[0], 0)
