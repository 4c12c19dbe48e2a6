"""The table of the ablation: the errors of variants of the section model."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from p2wss.config import DeviceName
from p2wss.nets.predictor import load_predictor
from p2wss.training.dataset import TrainingLimits, load_dataset, training_limits
from p2wss.training.model import prediction_errors


def measure(manifest: Path, paths: Sequence[Path], device: DeviceName = "auto") -> pd.DataFrame:
    """Mean and standard deviation of absolute errors on the test split, with footprints known.

    A row per model, named by the folder of its file. All models are measured on the buildings that every one of them
    supports.

    Raises :class:`InputError` for an unusable manifest or model.
    """
    predictors = [load_predictor(path, device) for path in paths]
    limits = [training_limits(each.module.config, each.dvae_config) for each in predictors]
    strictest = TrainingLimits(
        max(each.min_points for each in limits),
        min(each.max_vertices for each in limits),
        min(each.max_length_m for each in limits),
    )
    test, rows = load_dataset(manifest, ["test"], strictest, labelled=True), []
    for path, predictor in zip(paths, predictors, strict=True):
        height, angle = (np.abs(error) for error in prediction_errors(predictor, test, np.arange(len(test))))
        rows.append((path.parent.name, len(test), height.mean(), height.std(), angle.mean(), angle.std()))
    names = ["height_mae_m", "height_std_m", "angle_mae_deg", "angle_std_deg"]
    return pd.DataFrame(rows, columns=["variant", "num_buildings", *names])


def spreads(table: pd.DataFrame) -> pd.DataFrame:
    """Mean and standard deviation over the seeds of each variant trained with several seeds: ``a``, ``a_seed_1`` and so
    on."""
    errors = table.groupby(table["variant"].str.partition("_seed_")[0])[["height_mae_m", "angle_mae_deg"]]
    return errors.agg(["count", "mean", "std"]).dropna()
