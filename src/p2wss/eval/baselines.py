"""Reconstructions without the network: flat roofs, constant parameters, Roofer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss import inference
from p2wss.config import Eval, Reconstruct
from p2wss.errors import InputError
from p2wss.eval import roofer
from p2wss.eval.cases import Case, Manifest, train_medians
from p2wss.eval.predict import by_dataset
from p2wss.inference import Reconstruction


def baseline(
    name: str, cases: Sequence[Case], manifest: Manifest, eval_config: Eval, config: Reconstruct
) -> tuple[list[Reconstruction], dict[str, str]]:
    """Reconstructions of a baseline, one per case in order, and facts of the run: ``status`` is ``ok``, or
    ``not run: ..`` with no reconstruction at all.

    Raises :class:`InputError` for another name than lod1, constant, roofer.
    """
    if name == "lod1":
        return by_dataset(cases, inference.lod1, config), {"status": "ok"}
    if name == "constant":
        return _constant(cases, manifest, config)
    if name == roofer.METHOD:
        found = roofer.find(eval_config.roofer_command)
        if isinstance(found, str):
            return [], {"status": found}
        rows = roofer.run(found, cases, manifest.crs(), eval_config)
        return rows, {"status": "ok", "roofer": found.version}
    raise InputError(f"no baseline is named {name}: choose lod1, constant or roofer")


def _constant(
    cases: Sequence[Case], manifest: Manifest, config: Reconstruct
) -> tuple[list[Reconstruction], dict[str, str]]:
    """Every building with the median height and the median angle of the train split."""
    medians = train_medians(manifest)
    if not np.isfinite(medians.eave_height_m):
        return [], {"status": "not run: the manifest has no train split"}
    rows = by_dataset(
        cases,
        lambda buildings, own: inference.constant(
            buildings, np.full(len(buildings), medians.eave_height_m), medians.angle_deg, own
        ),
        config,
    )
    return rows, {
        "status": "ok",
        "medians": f"{medians.eave_height_m:.3f} m, {medians.angle_deg:.1f} degrees",
    }
