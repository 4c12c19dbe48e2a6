"""Table 1: errors of heights, angles and footprints against the labels of the simulated test split."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Any, NotRequired

import numpy as np
from pydantic import AfterValidator, Field
from typing_extensions import TypedDict

from p2wss.config import Reconstruct
from p2wss.data.building import Building, Reconstruction
from p2wss.eval.cases import Case, Key, Medians
from p2wss.eval.masked import MaskedParameters, MaskedPredictor, fit_all_masked, read_all_masked
from p2wss.eval.metrics.absolute_error import AbsoluteError, absolute_error, pooled, vertex_error
from p2wss.reconstruct.product import FIT, NETWORK, NETWORK_AND_FIT
from p2wss.skeleton.queries import roof_points
from p2wss.skeleton.types import Polygons
from p2wss.storage.schemas.crops import SIMULATED

# a roof counts as seen with this many points on it, an edge with this many over its sloped face
MIN_SEEN_POINTS = 10
# the method behind a setting of Table 1
SETTING_OF_METHOD = {NETWORK: "footprint_given", NETWORK_AND_FIT: NETWORK_AND_FIT, FIT: FIT}
# how many simulated buildings there are, and how many of them the masked settings cannot take
COUNTS = {"num_buildings", "num_left_out"}
# metres or degrees: an error above is of a damaged file
_MAX_ERROR = 1e5


def _plausible(value: float) -> float:
    if not (math.isnan(value) or 0 <= value <= _MAX_ERROR):
        raise ValueError(f"{value:g} is not a plausible error of a building")
    return value


class StoredError(TypedDict):
    """An absolute error as in a file."""

    mean: Annotated[float, AfterValidator(_plausible)]
    std: Annotated[float, AfterValidator(_plausible)]
    count: Annotated[int, Field(ge=0)]


class _Settings(TypedDict):
    settings: dict[str, dict[str, StoredError]]


class StoredErrors(_Settings):
    """The content of the files that ``parameters.json`` is merged from."""

    num_buildings: NotRequired[int]
    num_left_out: NotRequired[int]


class MergedErrors(_Settings):
    """The content of ``parameters.json``."""

    num_buildings: int
    num_left_out: int


def masked_errors(
    cases: Sequence[Case],
    reconstructions: Sequence[Reconstruction],
    predictor: MaskedPredictor,
    medians: Medians,
    config: Reconstruct,
) -> dict[str, Any]:
    """MAE, deviation and count per setting and parameter (Table 1), as in ``parameters.json``.

    Settings: ``all_masked`` as in the paper (signs visible), ``all_masked_fit`` (the
    same in two passes with a fit, see :mod:`p2wss.eval.masked`), ``all_masked_signs`` (signs masked too),
    ``footprint_given`` (as for Table 2), ``constant`` (the medians of the train split; every vertex of the footprint
    is predicted at the mean of the points). Heights are compared above the ground of the cloud: the label is
    re-based to it.
    """
    labelled = [pair for pair in zip(cases, reconstructions, strict=True) if is_labelled(pair[0])]
    sequences = [
        case
        for case, reconstruction in labelled
        if reconstruction.angle_deg is not None
        and len(case.building.rings) == 1
        and len(case.building.rings[0]) <= predictor.max_num_vertices
    ]
    buildings = [case.building for case in sequences]
    reading = read_all_masked(buildings, predictor, signs_visible=True)
    fitted = fit_all_masked(buildings, reading, predictor, config)
    settings = {
        "all_masked": errors_of_masked(sequences, reading),
        "all_masked_fit": errors_of_masked(sequences, fitted),
        "all_masked_signs": errors_of_masked(
            sequences, read_all_masked(buildings, predictor, signs_visible=False)
        ),
        "footprint_given": errors_of(labelled),
        "constant": _errors(
            sequences,
            np.full(len(sequences), medians.eave_height_m),
            [np.full(len(case.building.rings[0]), medians.angle_deg) for case in sequences],
            [np.tile(_mean_xy_m(case.building), (len(case.building.rings[0]), 1)) for case in sequences],
        ),
    }
    num_buildings = sum(case.dataset == SIMULATED for case in cases)
    return {
        "settings": settings,
        "num_buildings": num_buildings,
        "num_left_out": num_buildings - len(sequences),
    }


def variant_errors(
    cases: Sequence[Case], reconstructions: Mapping[str, Mapping[Key, Reconstruction]]
) -> dict[str, Any]:
    """The same for the settings of our variants (:data:`SETTING_OF_METHOD`), from their reconstructions."""
    labelled = [case for case in cases if is_labelled(case)]
    settings = {}
    for method, setting in SETTING_OF_METHOD.items():
        by_key = reconstructions.get(method, {})
        errors = errors_of([(case, by_key[case.key]) for case in labelled if case.key in by_key])
        if errors:
            settings[setting] = errors
    return {"settings": settings}


def merged(parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """The errors over the buildings of all parts, of :func:`masked_errors` or of :func:`variant_errors`."""
    settings: dict[str, dict[str, list[AbsoluteError]]] = {}
    counts: dict[str, int] = {}
    for part in parts:
        for setting, errors in part["settings"].items():
            by_name = settings.setdefault(setting, {})
            for name, error in errors.items():
                by_name.setdefault(name, []).append(AbsoluteError(**error))
        for name in COUNTS & part.keys():
            counts[name] = counts.get(name, 0) + part[name]
    return {
        "settings": {
            setting: {name: asdict(pooled(errors)) for name, errors in by_name.items()}
            for setting, by_name in settings.items()
        },
        **counts,
    }


def is_labelled(case: Case) -> bool:
    """Whether the true heights and angles of a case are known."""
    return case.dataset == SIMULATED and case.angle_deg is not None


def errors_of(pairs: Sequence[tuple[Case, Reconstruction]]) -> dict[str, dict[str, float]]:
    """Errors of height and angles: ``height_m`` and ``angle_deg`` over all values, ``height_seen_m`` and
    ``angle_seen_deg`` over those that the points determine (:func:`seen_edges`).

    Reconstructions without parameters, or with other edges than the label, are excluded.
    """
    usable = [
        (case, reconstruction, reconstruction.angle_deg)
        for case, reconstruction in pairs
        if reconstruction.eave_height_m is not None
        and reconstruction.angle_deg is not None
        and case.angle_deg is not None
        and len(reconstruction.angle_deg) == len(case.angle_deg)
    ]
    if not usable:
        return {}
    cases = [case for case, _, _ in usable]
    height = np.array([reconstruction.eave_height_m for _, reconstruction, _ in usable], float)
    angle = [angle for _, _, angle in usable]
    errors = _errors(cases, height, angle, None)
    edge_mask = np.concatenate(seen_edges(cases, angle))
    case_mask = np.array([case.building.is_on_building.sum() >= MIN_SEEN_POINTS for case in cases])
    target = np.array([target_height_m(case) for case in cases])
    truth = np.concatenate([case.angle_deg for case in cases if case.angle_deg is not None])
    errors["height_seen_m"] = asdict(absolute_error(height[case_mask], target[case_mask]))
    errors["angle_seen_deg"] = asdict(absolute_error(np.concatenate(angle)[edge_mask], truth[edge_mask]))
    return errors


def seen_edges(cases: Sequence[Case], angle_deg: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Mask of the edges that the points determine, per labelled case: bool, one value per edge over all rings.

    angle_deg: the angles by a method. An edge is seen if ten points on the building lie over its sloped face, in the
    roof of the label or of the method. A gable that the method predicts as such has no face, and a wall under a flat
    roof is the same with 0 and with 90 degrees: neither counts as seen.
    """
    polygons = Polygons.from_rings([list(case.building.rings) for case in cases])
    point = [case.building.point_m[case.building.is_on_building, :2] for case in cases]
    index = np.repeat(np.arange(len(cases)), [len(xy) for xy in point])
    xy = np.concatenate([*point, np.zeros((0, 2))])
    first = np.concatenate([[0], np.cumsum([len(angle) for angle in angle_deg])])
    count = np.zeros(first[-1], int)
    truth = [case.angle_deg for case in cases if case.angle_deg is not None]
    for angles in (truth, angle_deg):
        roof = roof_points(polygons, np.concatenate(list(angles)), 0.0, xy, index)
        over = roof.edge >= 0
        np.maximum(count, np.bincount(first[index[over]] + roof.edge[over], minlength=first[-1]), out=count)
    return np.split(count >= MIN_SEEN_POINTS, first[1:-1])


def target_height_m(case: Case) -> float:
    """The eave height of the label, re-based to the ground of the cloud."""
    assert case.eave_height_m is not None and case.label_terrain_z_m is not None
    return case.eave_height_m + case.label_terrain_z_m - case.building.ground_z_m


def errors_of_masked(cases: Sequence[Case], parameters: MaskedParameters) -> dict[str, dict[str, float]]:
    """As :func:`errors_of`, for parameters that the network predicted with some masked; coordinates included."""
    return _errors(cases, parameters.eave_height_m, parameters.angle_deg, parameters.xy_m)


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


def _mean_xy_m(building: Building) -> np.ndarray:
    return building.point_m[:, :2].mean(axis=0)
