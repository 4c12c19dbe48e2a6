"""The network on the test split and on real LiDAR: reconstructions, and the errors of Table 1."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, Protocol

import numpy as np

from p2wss.config import Reconstruct
from p2wss.eval.cases import LIDAR, SYNTHETIC, Case, Medians
from p2wss.inference import Building, Predictor, Reconstruction, ground_z_m, reconstruct
from p2wss.metrics.absolute_error import absolute_error, vertex_error

Method = Callable[[Sequence[Building], Reconstruct], list[Reconstruction]]


class MaskedPredictor(Predictor, Protocol):
    """The part of :class:`p2wss.model.Predictor` that Table 1 needs."""

    def reconstruct_all_masked(
        self, points_m: Sequence[np.ndarray], footprints_m: Sequence[np.ndarray], signs_visible: bool = True
    ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        """Heights (b,), footprints (v, 2) and angles (v,) with all numerical tokens masked."""
        ...


def for_dataset(config: Reconstruct, dataset: str) -> Reconstruct:
    """Simulated buildings keep their footprint, to which the labels belong; real ones are simplified."""
    return config.model_copy(update={"simplify_m": 0.0}) if dataset == SYNTHETIC else config


def predict(cases: Sequence[Case], predictor: Predictor, config: Reconstruct) -> list[Reconstruction]:
    """One reconstruction per case, in order."""
    return by_dataset(cases, lambda buildings, own: reconstruct(buildings, predictor, own), config)


def by_dataset(cases: Sequence[Case], method: Method, config: Reconstruct) -> list[Reconstruction]:
    """``method(buildings, config)`` for each data set with its own config; in the order of the cases."""
    found: dict[int, Reconstruction] = {}
    for dataset in (SYNTHETIC, LIDAR):
        rows = [i for i, case in enumerate(cases) if case.dataset == dataset]
        if rows:
            made = method([cases[i].building for i in rows], for_dataset(config, dataset))
            found |= dict(zip(rows, made, strict=True))
    return [found[i] for i in range(len(cases))]


def parameter_errors(
    cases: Sequence[Case],
    reconstructions: Sequence[Reconstruction],
    predictor: MaskedPredictor,
    medians: Medians,
) -> dict[str, Any]:
    """The content of ``parameters.json``: MAE, deviation and count per setting and parameter (Table 1).

    Settings: ``all_masked`` as in the paper (signs visible), ``all_masked_signs`` (signs masked too),
    ``footprint_given`` (what Table 2 uses), ``constant`` (the medians of the train split). Heights are
    compared above the ground that the cloud shows, which moves the label; a constant footprint is its centre.
    """
    labelled = [
        (case, found)
        for case, found in zip(cases, reconstructions, strict=True)
        if case.dataset == SYNTHETIC and case.angle_deg is not None and found.angle_deg is not None
    ]
    sequences = [
        case
        for case, _ in labelled
        if len(case.building.rings) == 1 and len(case.building.rings[0]) <= predictor.max_num_vertices
    ]
    settings = {
        "all_masked": _all_masked(sequences, predictor, signs_visible=True),
        "all_masked_signs": _all_masked(sequences, predictor, signs_visible=False),
        "footprint_given": _errors(
            [case for case, _ in labelled],
            np.array([found.eave_height_m for _, found in labelled], float),
            [found.angle_deg for _, found in labelled if found.angle_deg is not None],
            None,
        ),
        "constant": _errors(
            sequences,
            np.full(len(sequences), medians.eave_height_m),
            [np.full(len(case.building.rings[0]), medians.angle_deg) for case in sequences],
            [np.tile(_middle(case.building), (len(case.building.rings[0]), 1)) for case in sequences],
        ),
    }
    num_buildings = sum(case.dataset == SYNTHETIC for case in cases)
    return {
        "settings": settings,
        "num_buildings": num_buildings,
        "num_left_out": num_buildings - len(sequences),
    }


def target_height_m(case: Case) -> float:
    """The label's eave above the ground that the cloud shows."""
    assert case.eave_height_m is not None and case.label_ground_z_m is not None
    return case.eave_height_m + case.label_ground_z_m - ground_z_m(case.building)


def _all_masked(
    cases: Sequence[Case], predictor: MaskedPredictor, signs_visible: bool
) -> dict[str, dict[str, float]]:
    if not cases:
        return {}
    height, xy, angle = predictor.reconstruct_all_masked(
        [case.building.point_m - [0, 0, ground_z_m(case.building)] for case in cases],
        [case.building.rings[0] for case in cases],
        signs_visible,
    )
    return _errors(cases, height, angle, xy)


def _errors(
    cases: Sequence[Case],
    height_m: np.ndarray,
    angle_deg: Sequence[np.ndarray],
    xy_m: Sequence[np.ndarray] | None,
) -> dict[str, dict[str, float]]:
    if not cases:
        return {}
    errors = {
        "height_m": absolute_error(height_m, np.array([target_height_m(case) for case in cases])),
        "angle_deg": absolute_error(
            np.concatenate(list(angle_deg)),
            np.concatenate([case.angle_deg for case in cases if case.angle_deg is not None]),
        ),
    }
    if xy_m is not None:
        predicted = np.concatenate(list(xy_m))
        truth = np.concatenate([case.building.rings[0] for case in cases])
        errors["coordinate_m"] = absolute_error(predicted, truth)
        errors["vertex_m"] = vertex_error(predicted, truth)
    return {name: asdict(error) for name, error in errors.items()}


def _middle(building: Building) -> np.ndarray:
    return building.point_m[:, :2].mean(axis=0)
