"""Reconstructions without the network: flat roofs, constant parameters, Roofer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from p2wss.config import Eval, Reconstruct
from p2wss.data.building import Reconstruction
from p2wss.errors import InputError
from p2wss.eval import roofer, roofer_command
from p2wss.eval.cases import Case, Key, Manifest, Medians, train_medians
from p2wss.eval.clock import CpuClock
from p2wss.eval.predict import by_dataset
from p2wss.eval.recording import Recording
from p2wss.reconstruct.flat import constant, lod1

RECORDED = "recorded"


def baseline(
    name: str,
    cases: Sequence[Case],
    manifest: Manifest,
    eval_config: Eval,
    config: Reconstruct,
    clock: CpuClock | None = None,
    medians: Medians | None = None,
    recording: Recording | None = None,
) -> tuple[Mapping[Key, Reconstruction], dict[str, str]]:
    """Reconstructions of a baseline by the keys of the cases, and facts of the run.

    medians: of the constant predictor; without them those of the labels that the manifest lists. recording: outputs
    of an earlier run of Roofer, for where it cannot be run.

    The fact ``status`` is ``ok``, ``recorded`` (outputs of an earlier run of Roofer, for real LiDAR only) or
    ``not run: <reason>``, then without any reconstruction. name: lod1, constant or roofer. Raises
    :class:`InputError` for any other name.
    """
    if name == "lod1":
        return _by_key(cases, by_dataset(cases, lod1, config, clock)), {"status": "ok"}
    if name == "constant":
        return _constant(cases, medians or train_medians(manifest), config, clock)
    if name == roofer.METHOD:
        return _roofer(cases, manifest, eval_config, clock, recording)
    raise InputError(f"unknown baseline {name}: choose lod1, constant or roofer")


def _roofer(
    cases: Sequence[Case],
    manifest: Manifest,
    config: Eval,
    clock: CpuClock | None,
    recording: Recording | None,
) -> tuple[Mapping[Key, Reconstruction], dict[str, str]]:
    command = roofer_command.find(config.roofer_command)
    if isinstance(command, roofer_command.Roofer):
        rows = roofer.run(command, cases, manifest.crs(), config, clock)
        return _by_key(cases, rows), {"status": "ok", "roofer": command.version}
    if recording is None:
        return {}, {"status": command}
    if not recording.num_evaluated:
        return {}, {"status": f"not run, and none of the buildings is in the recorded {recording.names}"}
    return roofer.recorded(recording, cases), {
        "status": RECORDED,
        "roofer": f"recorded outputs: {recording.names}",
        "sha256": recording.sha256,
    }


def _constant(
    cases: Sequence[Case], medians: Medians, config: Reconstruct, clock: CpuClock | None
) -> tuple[Mapping[Key, Reconstruction], dict[str, str]]:
    """Every building with the median height and the median angle of the train split."""
    if not np.isfinite(medians.eave_height_m):
        return {}, {"status": "not run: no building has a label"}
    rows = by_dataset(
        cases,
        lambda buildings, settings: constant(
            buildings, np.full(len(buildings), medians.eave_height_m), medians.angle_deg, settings
        ),
        config,
        clock,
    )
    return _by_key(cases, rows), {
        "status": "ok",
        "medians": f"{medians.eave_height_m:.3f} m, {medians.angle_deg:.1f} degrees",
    }


def _by_key(cases: Sequence[Case], rows: Sequence[Reconstruction]) -> dict[Key, Reconstruction]:
    return {case.key: row for case, row in zip(cases, rows, strict=True)}
