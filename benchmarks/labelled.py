"""The fit on simulated buildings with known eave height and angles: errors beside their bars, and their causes.

Used by real.py. Which edges count as seen: :func:`p2wss.eval.measure.seen_edges`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from p2wss import skeleton
from p2wss.config import Config, Reconstruct
from p2wss.data.building import Reconstruction
from p2wss.data.manifest import read_manifest
from p2wss.eval import cases, measure, methods
from p2wss.eval.cases import Case
from p2wss.fit import fitting
from p2wss.reconstruction.product import FIT, NETWORK, reconstruct_with_network
from p2wss.skeleton.types import Polygons
from p2wss.storage.schemas.crops import SIMULATED

BARS = {"height_mae_m": 0.05, "angle_mae_deg": 0.5}
_CLUTTER_M, _CLUTTER_SHARE = 0.3, 0.1


@dataclass(frozen=True)
class Error:
    """Errors of one building.

    is_seen: bool per edge. height_m, angle_deg: signed, reconstruction minus label. fitted_deg: angles of the
    reconstruction. clutter: share of the points on the building that are more than 0.3 m above or below the true roof.
    """

    case: Case
    is_seen: np.ndarray
    height_m: float
    angle_deg: np.ndarray
    fitted_deg: np.ndarray
    clutter: float


def read(manifest: Path) -> list[Case]:
    """The labelled test split."""
    every = [case for of_shard in cases.test_cases(read_manifest(manifest)) for case in of_shard]
    return [case for case in every if case.dataset == SIMULATED and case.angle_deg is not None]


def config() -> Reconstruct:
    """The settings of the evaluation: footprints as labelled, parametric buildings."""
    return methods.for_dataset(Config().reconstruct, SIMULATED)


def errors(labelled: list[Case], reconstructions: list[Reconstruction]) -> list[Error]:
    """Errors of the reconstructions, one per labelled building."""
    # where the reconstruction has no angles, the label alone decides which edges are seen
    angle_deg = [
        cast(np.ndarray, case.angle_deg if row.angle_deg is None else row.angle_deg)
        for case, row in zip(labelled, reconstructions, strict=True)
    ]
    masks = measure.seen_edges(labelled, angle_deg)
    return [_error(*pair) for pair in zip(labelled, reconstructions, masks, strict=True)]


def _error(case: Case, reconstruction: Reconstruction, is_seen: np.ndarray) -> Error:
    building, true_deg = case.building, case.angle_deg
    assert true_deg is not None and case.eave_height_m is not None and case.label_terrain_z_m is not None
    eave_m = case.eave_height_m + case.label_terrain_z_m - building.ground_z_m
    point_m = building.point_m[case.building.is_on_building]
    polygons = Polygons.from_rings([list(building.rings)])
    roof = skeleton.roof_points(polygons, true_deg, eave_m, point_m[:, :2], np.zeros(len(point_m), int))
    clutter = np.abs(point_m[:, 2] - roof.z_m) > _CLUTTER_M
    height, angle = reconstruction.eave_height_m, reconstruction.angle_deg
    return Error(
        case,
        is_seen,
        np.nan if height is None else height - eave_m,
        np.full(len(true_deg), np.nan) if angle is None else angle - true_deg,
        np.full(len(true_deg), np.nan) if angle is None else angle,
        float(clutter.mean()) if len(point_m) else 0.0,
    )


def summary(rows: list[Error]) -> dict[str, float]:
    """Mean and median absolute errors of eave heights, of the angles of seen edges and of all edges."""
    height = np.array([abs(e.height_m) for e in rows])
    angle = np.concatenate([np.abs(e.angle_deg[e.is_seen]) for e in rows])
    every = np.concatenate([np.abs(e.angle_deg) for e in rows])
    return {
        "buildings": len(rows),
        "height_mae_m": float(np.nanmean(height)),
        "height_median_m": float(np.nanmedian(height)),
        "angle_mae_deg": float(np.nanmean(angle)),
        "angle_median_deg": float(np.nanmedian(angle)),
        "angle_mae_all_deg": float(np.nanmean(every)),
        "edges_seen": float(np.concatenate([e.is_seen for e in rows]).mean()),
        "class_correct": float(np.mean(np.concatenate([_is_class_correct(e)[e.is_seen] for e in rows]))),
    }


def _kind(angle_deg: np.ndarray) -> np.ndarray:
    return np.where(angle_deg == 0, 0, np.where(angle_deg == 90, 2, 1))


def _is_class_correct(error: Error) -> np.ndarray:
    assert error.case.angle_deg is not None
    return _kind(error.case.angle_deg) == _kind(error.fitted_deg)


def causes(rows: list[Error]) -> dict[str, float]:
    """Shares of the summed errors, by cause, the largest first.

    Degrees of seen edges by true and reconstructed class; metres by whether a class is wrong or the points are
    cluttered.
    """
    names = ("0", "slope", "90")
    total = sum(np.nansum(np.abs(e.angle_deg[e.is_seen])) for e in rows) or 1.0
    shares: dict[str, float] = {}
    for e in rows:
        assert e.case.angle_deg is not None
        for true, fitted, degrees, is_seen in zip(
            _kind(e.case.angle_deg), _kind(e.fitted_deg), np.abs(e.angle_deg), e.is_seen, strict=True
        ):
            if is_seen and degrees > 0:
                key = f"degrees, {names[true]} as {names[fitted]}"
                shares[key] = shares.get(key, 0.0) + float(degrees) / total
    with_height = [e for e in rows if np.isfinite(e.height_m)]
    metres = sum(abs(e.height_m) for e in with_height) or 1.0
    for e in with_height:
        wrong = not _is_class_correct(e)[e.is_seen].all()
        cluttered = e.clutter > _CLUTTER_SHARE
        key = "metres, " + ("class wrong" if wrong else "cluttered" if cluttered else "else")
        shares[key] = shares.get(key, 0.0) + abs(e.height_m) / metres
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def figures(manifest: Path, predictor: Any) -> dict[str, Any]:
    """Errors on the test split: of the fit and, with a predictor, of the network."""
    labelled = read(manifest)
    buildings = [case.building for case in labelled]
    by_method = {FIT: fitting.fit(buildings, config())}
    if predictor is not None:
        by_method[NETWORK] = reconstruct_with_network(buildings, predictor, config())
    result: dict[str, Any] = {}
    for name, reconstructions in by_method.items():
        rows = errors(labelled, reconstructions)
        result[f"simulated, {name}"] = row = summary(rows)
        bars = [
            f"{key} {row[key]:.3f} (bar {bar:g}{'' if row[key] <= bar else ' MISSED'})"
            for key, bar in BARS.items()
        ]
        rest = [f"{key} {value:.3f}" for key, value in row.items() if key not in BARS]
        print(f"simulated, {name}: " + ", ".join(bars + rest), flush=True)
        print("    " + ", ".join(f"{key} {share:.0%}" for key, share in causes(rows).items()), flush=True)
    return result
