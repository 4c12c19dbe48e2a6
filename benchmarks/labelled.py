"""The fit on simulated buildings, whose eave and angles are known: errors beside their bars, and why.

Which edges are seen: :func:`p2wss.eval.parameters.seen_edges`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from p2wss import skeleton
from p2wss.config import Config, Reconstruct
from p2wss.data.building import Reconstruction
from p2wss.data.schemas.crops import SIMULATED
from p2wss.eval import cases, parameters, predict
from p2wss.eval.cases import Case
from p2wss.eval.measure import points_on_building
from p2wss.fit import fitting
from p2wss.reconstruct.network import reconstruct_with_network
from p2wss.skeleton.types import Polygons

BARS = {"height_mae_m": 0.05, "angle_mae_deg": 0.5}
_CLUTTER_M, _CLUTTER_SHARE = 0.3, 0.1


@dataclass(frozen=True)
class Error:
    """Of one building. seen: bool per edge. height_m, angle_deg: signed, found - true. clutter: share of the
    points inside more than 0.3 m from the true roof."""

    case: Case
    seen: np.ndarray
    height_m: float
    angle_deg: np.ndarray
    found_deg: np.ndarray
    clutter: float


def read(manifest: Path) -> list[Case]:
    """The labelled test split."""
    listed = cases.test_cases(cases.read_manifest(manifest))
    return [case for case in listed if case.dataset == SIMULATED and case.angle_deg is not None]


def config() -> Reconstruct:
    """As the evaluation does: footprints as labelled, one height."""
    return predict.for_dataset(Config().reconstruct, SIMULATED).model_copy(update={"max_parts": 1})


def errors(labelled: list[Case], made: list[Reconstruction]) -> list[Error]:
    # without an answer only the label tells what there is to see
    told = [
        case.angle_deg if one.angle_deg is None else one.angle_deg
        for case, one in zip(labelled, made, strict=True)
    ]
    seen = parameters.seen_edges(labelled, told)
    return [_error(case, found, own) for case, found, own in zip(labelled, made, seen, strict=True)]


def _error(case: Case, found: Reconstruction, seen: np.ndarray) -> Error:
    building, true_deg = case.building, case.angle_deg
    assert true_deg is not None and case.eave_height_m is not None and case.label_terrain_z_m is not None
    eave_z_m = case.eave_height_m + case.label_terrain_z_m
    point_m = building.point_m[points_on_building(case)]
    polygons = Polygons.from_rings([list(building.rings)])
    roof = skeleton.roof_points(polygons, true_deg, eave_z_m, point_m[:, :2], np.zeros(len(point_m), int))
    clutter = np.abs(point_m[:, 2] - roof.z_m) > _CLUTTER_M
    height, angle = found.eave_height_m, found.angle_deg
    return Error(
        case,
        seen,
        np.nan if height is None else height + found.ground_z_m - eave_z_m,
        np.full(len(true_deg), np.nan) if angle is None else angle - true_deg,
        np.full(len(true_deg), np.nan) if angle is None else angle,
        float(clutter.mean()) if len(point_m) else 0.0,
    )


def summary(found: list[Error]) -> dict[str, float]:
    """Mean absolute errors of eaves, of the angles of edges that are seen and of all."""
    height = np.array([abs(e.height_m) for e in found])
    angle = np.concatenate([np.abs(e.angle_deg[e.seen]) for e in found])
    every = np.concatenate([np.abs(e.angle_deg) for e in found])
    return {
        "buildings": len(found),
        "height_mae_m": float(np.nanmean(height)),
        "height_median_m": float(np.nanmedian(height)),
        "angle_mae_deg": float(np.nanmean(angle)),
        "angle_median_deg": float(np.nanmedian(angle)),
        "angle_mae_all_deg": float(np.nanmean(every)),
        "edges_seen": float(np.concatenate([e.seen for e in found]).mean()),
        "class_right": float(np.mean(np.concatenate([_class_right(e)[e.seen] for e in found]))),
    }


def _kind(angle_deg: np.ndarray) -> np.ndarray:
    return np.where(angle_deg == 0, 0, np.where(angle_deg == 90, 2, 1))


def _class_right(error: Error) -> np.ndarray:
    assert error.case.angle_deg is not None
    return _kind(error.case.angle_deg) == _kind(error.found_deg)


def causes(found: list[Error]) -> dict[str, float]:
    """Shares of the summed errors where the roof is seen: degrees by what the class became, metres by whether
    a class is wrong or the points are cluttered."""
    names = ("0", "slope", "90")
    total = sum(np.nansum(np.abs(e.angle_deg[e.seen])) for e in found) or 1.0
    shares: dict[str, float] = {}
    for e in found:
        assert e.case.angle_deg is not None
        for true, got, off, seen in zip(
            _kind(e.case.angle_deg), _kind(e.found_deg), np.abs(e.angle_deg), e.seen, strict=True
        ):
            if seen and off > 0:
                key = f"degrees, {names[true]} as {names[got]}"
                shares[key] = shares.get(key, 0.0) + float(off) / total
    known = [e for e in found if np.isfinite(e.height_m)]
    metres = sum(abs(e.height_m) for e in known) or 1.0
    for e in known:
        wrong = not _class_right(e)[e.seen].all()
        cluttered = e.clutter > _CLUTTER_SHARE
        key = "metres, " + ("class wrong" if wrong else "cluttered" if cluttered else "else")
        shares[key] = shares.get(key, 0.0) + abs(e.height_m) / metres
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def figures(manifest: Path, predictor: Any) -> dict[str, Any]:
    """Errors on the test split, fitted from nothing and, if there is a network, from it and by it alone."""
    labelled = read(manifest)
    buildings = [case.building for case in labelled]
    made = {"fit": fitting.fit(buildings, config())}
    if predictor is not None:
        known = reconstruct_with_network(buildings, predictor, config())
        made |= {"network": known, "network and fit": fitting.fit(buildings, config(), known)}
    result: dict[str, Any] = {}
    for name, rows in made.items():
        found = errors(labelled, rows)
        result[f"simulated, {name}"] = told = summary(found)
        bars = [
            f"{key} {told[key]:.3f} (bar {bar:g}{'' if told[key] <= bar else ' MISSED'})"
            for key, bar in BARS.items()
        ]
        rest = [f"{key} {value:.3f}" for key, value in told.items() if key not in BARS]
        print(f"simulated, {name}: " + ", ".join(bars + rest), flush=True)
        print("    " + ", ".join(f"{key} {share:.0%}" for key, share in causes(found).items()), flush=True)
    return result
