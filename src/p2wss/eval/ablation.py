"""The table of the ablation: what each switch of the section model is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2wss.eval import cases
from p2wss.nets.compute import DeviceName
from p2wss.nets.predictor import load_predictor
from p2wss.nets.shards import load_dataset

HEADER = (
    "variant",
    "num_buildings",
    "height_mae_m",
    "height_std_m",
    "height_mae_constant_m",
    "angle_mae_deg",
    "angle_std_deg",
    "angle_mae_constant_deg",
)


@dataclass(frozen=True)
class Row:
    """Mean and standard deviation of absolute errors on the test split, footprint given, one variant."""

    variant: str
    num_buildings: int
    height_mae_m: float
    height_std_m: float
    height_mae_constant_m: float
    angle_mae_deg: float
    angle_std_deg: float
    angle_mae_constant_deg: float


def measure(manifest: Path, paths: Sequence[Path], device: DeviceName = "auto") -> list[Row]:
    """One row per model; a model is named by its folder. The constants: :func:`p2wss.eval.cases.train_medians`.

    Raises :class:`InputError` for an unusable manifest or model.
    """
    constant = cases.train_medians(cases.read_manifest(manifest))
    rows = []
    for path in paths:
        predictor = load_predictor(path, device)
        test = load_dataset(manifest, ["test"], predictor.limits, labelled=True, include_real=False)
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
    return "\n".join([",".join(HEADER), *(",".join(_cells(row, 4)) for row in rows)]) + "\n"


def markdown(rows: Sequence[Row]) -> str:
    lines = [HEADER, ["---"] * len(HEADER), *(_cells(row, 2) for row in rows)]
    table = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([*table, *(["", *spreads(rows)] if spreads(rows) else [])]) + "\n"


def spreads(rows: Sequence[Row]) -> list[str]:
    """What another seed changes: one line per variant that was trained with several, named ``.._seed_1``, .."""
    seeds: dict[str, list[Row]] = {}
    for row in rows:
        seeds.setdefault(row.variant.partition("_seed_")[0], []).append(row)
    return [
        f"{variant} over {len(own)} seeds: height {_spread([row.height_mae_m for row in own])} m, "
        f"angle {_spread([row.angle_mae_deg for row in own])} degrees (mean of the errors above "
        "± standard deviation between seeds)"
        for variant, own in seeds.items()
        if len(own) > 1
    ]


def _spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):.3f} ± {np.std(values, ddof=1):.3f}"


def _cells(row: Row, digits: int) -> list[str]:
    values = [getattr(row, name) for name in HEADER]
    return [f"{value:.{digits}f}" if isinstance(value, float) else str(value) for value in values]
