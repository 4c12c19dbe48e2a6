"""The table of the ablation: the errors of variants of the section model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pandas as pd

from p2wss.eval import cases
from p2wss.nets.compute import DeviceName
from p2wss.nets.dataset import training_limits
from p2wss.nets.predictor import load_predictor
from p2wss.nets.shards import load_dataset
from p2wss.storage.schemas.manifest import read_manifest


@dataclass(frozen=True)
class Row:
    """One variant: mean and standard deviation of absolute errors on the test split, with footprints known."""

    variant: str
    num_buildings: int
    height_mae_m: float
    height_std_m: float
    height_mae_constant_m: float
    angle_mae_deg: float
    angle_std_deg: float
    angle_mae_constant_deg: float


HEADER = [field.name for field in fields(Row)]


def measure(manifest: Path, paths: Sequence[Path], device: DeviceName = "auto") -> list[Row]:
    """One row per model, which is named by its folder. The errors of a constant predictor are those of
    :func:`p2wss.eval.cases.train_medians`.

    Raises :class:`InputError` for an unusable manifest or model.
    """
    constant = cases.train_medians(read_manifest(manifest))
    rows = []
    for path in paths:
        predictor = load_predictor(path, device)
        limits = training_limits(predictor.module.config, predictor.dvae_config)
        test = load_dataset(manifest, ["test"], limits, labelled=True)
        height, angle = (np.abs(error) for error in predictor.errors(test, np.arange(len(test))))
        rows.append(
            Row(
                path.parent.name,
                len(test),
                float(height.mean()),
                float(height.std()),
                float(np.abs(test.height_m - constant.eave_height_m).mean()),
                float(angle.mean()),
                float(angle.std()),
                float(np.abs(test.angle_deg - constant.angle_deg).mean()),
            )
        )
    return rows


def csv(rows: Sequence[Row]) -> str:
    """The table as CSV."""
    table = pd.DataFrame(rows, columns=HEADER)
    return table.to_csv(index=False, float_format="%.4f", na_rep="nan", lineterminator="\n")


def markdown(rows: Sequence[Row]) -> str:
    """The table as Markdown, followed by the :func:`spreads`."""
    lines = [HEADER, ["---"] * len(HEADER), *map(_cells, rows)]
    table = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([*table, *(["", *spreads(rows)] if spreads(rows) else [])]) + "\n"


def spreads(rows: Sequence[Row]) -> list[str]:
    """Spread between seeds: a line per variant that was trained with several, named ``variant_seed_1`` and so on."""
    variants: dict[str, list[Row]] = {}
    for row in rows:
        variants.setdefault(row.variant.partition("_seed_")[0], []).append(row)
    return [
        f"{variant} over {len(repeats)} seeds: height {_spread([row.height_mae_m for row in repeats])} m, "
        f"angle {_spread([row.angle_mae_deg for row in repeats])} degrees (mean of the errors above "
        "± standard deviation between seeds)"
        for variant, repeats in variants.items()
        if len(repeats) > 1
    ]


def _spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):.3f} ± {np.std(values, ddof=1):.3f}"


def _cells(row: Row) -> list[str]:
    values = [getattr(row, name) for name in HEADER]
    return [f"{value:.2f}" if isinstance(value, float) else str(value) for value in values]
