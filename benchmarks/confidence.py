"""Is the stated confidence what it says? Labelled simulated buildings, each with all its points and with few.

    python benchmarks/confidence.py results/town/crops/manifest.json .. --model model.safetensors
    .. --fit                     # also the coefficients that half A gives, and what half B says of them
    .. --every 6                 # of every manifest only each sixth building
    .. --data ../shared/data     # beside it real clouds: is a low confidence a large distance?

Half A (every second building by id) chooses coefficients, all figures are those of half B; the last line is JSON. Take
buildings that the network was not trained on, and not those that it is reported on.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import labelled
import numpy as np
import real
from scipy import stats
from scipy.special import expit

from p2wss.config import Config
from p2wss.data import files
from p2wss.data.building import Building, Reconstruction
from p2wss.data.schemas.crops import CROPS, SIMULATED
from p2wss.eval import cases, measure
from p2wss.eval.cases import Case
from p2wss.fit import confidence, fitting
from p2wss.fit.evidence import Evidence
from p2wss.fit.points import roof_points
from p2wss.metrics.calibration import calibration
from p2wss.metrics.surface import distance_to_mesh
from p2wss.nets import decoding
from p2wss.reconstruct.network import reconstruct_with_network

FEW = (None, 200, 80, 20)
NETWORK, NETWORK_AND_FIT, FIT = "network", "network and fit", "fit"


@dataclass(frozen=True)
class Row:
    """One reconstruction. right: bool (edges + 1,), the height first. told: the evidence of the fit, or the
    probabilities of the network, likewise."""

    method: str
    num_points: int | None
    is_half_a: bool
    right: np.ndarray
    stated: float
    told: Evidence | np.ndarray

    @property
    def share(self) -> float:
        return float(self.right.mean())


def read(manifest: Path, every: int) -> list[Case]:
    """Every k-th labelled building, of any split, by tile and id."""
    found: list[Case] = []
    for path, dataset in cases.read_manifest(manifest).shards:
        if dataset == SIMULATED:
            found += cases.from_crops(files.read_table(path, CROPS), dataset)
    return sorted((case for case in found if case.angle_deg is not None), key=lambda case: case.key)[::every]


@contextmanager
def evidence_kept() -> Iterator[list[Evidence]]:
    """What each fit meanwhile states its confidence by."""
    kept: list[Evidence] = []
    share = confidence.share

    def keep(found: Evidence) -> float:
        kept.append(found)
        return share(found)

    confidence.share = keep
    try:
        yield kept
    finally:
        confidence.share = share


class Telling:
    """A network that keeps what it predicted last."""

    def __init__(self, predictor: Any) -> None:
        self.predictor, self.max_num_vertices, self.last = predictor, predictor.max_num_vertices, None

    def predict(self, points_m: list[np.ndarray], rings: list[list[np.ndarray]]) -> Any:
        self.last = self.predictor.predict(points_m, rings)
        return self.last


def rows_of(listed: list[Case], predictor: Any) -> list[Row]:
    """Every building and number of points, by each method."""
    config = labelled.config()
    found: list[Row] = []
    views = None if predictor is None else Telling(predictor)
    one_view = None if predictor is None else predictor.with_num_views(1)
    for place, case in enumerate(listed):
        for count in FEW:
            building = case.building if count is None else real.thinned(case.building, count)
            if count is not None and len(building.point_m) == len(case.building.point_m):
                continue
            own = replace(case, building=building)
            if views is not None and one_view is not None:
                (made,) = reconstruct_with_network([building], views, config)
                if made.has_mesh and views.last is not None:
                    found += _row(NETWORK, count, place, own, made, views.last.probability[0])
                known = reconstruct_with_network([building], one_view, config)
                found += _fitted(NETWORK_AND_FIT, count, place, own, known)
            found += _fitted(FIT, count, place, own, None)
    return found


def _fitted(
    method: str, count: int | None, place: int, case: Case, known: list[Reconstruction] | None
) -> list[Row]:
    with evidence_kept() as kept:
        (made,) = fitting.fit([case.building], labelled.config(), known)
    return _row(method, count, place, case, made, kept[-1]) if kept and made.has_mesh else []


def _row(
    method: str, count: int | None, place: int, case: Case, made: Reconstruction, told: Evidence | np.ndarray
) -> list[Row]:
    assert case.angle_deg is not None and case.eave_height_m is not None
    if made.angle_deg is None or made.eave_height_m is None or made.confidence is None:
        return []
    eave_m = case.eave_height_m + (case.label_terrain_z_m or 0.0) - made.ground_z_m
    right = np.append(
        abs(made.eave_height_m - eave_m) <= measure.RIGHT_M,
        np.abs(made.angle_deg - case.angle_deg) <= measure.RIGHT_DEG,
    )
    return [Row(method, count, place % 2 == 0, right, made.confidence, told)]


def logistic_fit(terms: np.ndarray, right: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Coefficients of 1 and of terms (n, k) by maximum likelihood, Newton's method with a touch of ridge."""
    design = np.column_stack([np.ones(len(terms)), terms])
    found = np.zeros(design.shape[1])
    ridge = 1e-3 * np.eye(len(found))
    for _ in range(50):
        stated = expit(design @ found)
        slope = design.T @ (weight * (right - stated)) - ridge @ found
        curve = (design.T * (weight * stated * (1 - stated))) @ design + ridge
        step = np.linalg.solve(curve, slope)
        found += step * min(1.0, 5.0 / np.abs(step).max())
        if np.abs(step).max() < 1e-6:
            break
    return found


def _both(
    rows: list[Row], edge: Callable[[Any], np.ndarray], height: Callable[[Any], np.ndarray]
) -> list[list[float]]:
    """Coefficients of edges and of heights; a building counts the same however many edges it has."""
    # of many edges only some are looked at
    rows = [row for row in rows if len(edge(row.told)) == len(row.right) - 1]
    weight = np.concatenate([np.full(len(row.right) - 1, 5 / len(row.right)) for row in rows])
    of_edges = logistic_fit(
        np.concatenate([edge(row.told) for row in rows]),
        np.concatenate([row.right[1:] for row in rows]).astype(float),
        weight,
    )
    of_heights = logistic_fit(
        np.array([height(row.told) for row in rows]),
        np.array([row.right[0] for row in rows], float),
        np.ones(len(rows)),
    )
    return [np.round(own, 2).tolist() for own in (of_edges, of_heights)]


def coefficients(rows: list[Row]) -> dict[str, Any]:
    """What half A gives for the fits, together, and for the network."""
    half = [row for row in rows if row.is_half_a]
    fits = [row for row in half if row.method != NETWORK]
    found: dict[str, Any] = {}
    found["EDGE"], found["HEIGHT"] = _both(fits, confidence.edge_terms, confidence.height_terms)
    networks = [row for row in half if row.method == NETWORK and len(row.told) == len(row.right)]
    if networks:
        found["ANGLE_CALIBRATION"], found["HEIGHT_CALIBRATION"] = _both(
            networks,
            lambda told: decoding.log_odds(told[1:])[:, None],
            lambda told: decoding.log_odds(told[:1]),
        )
    return found


def restated(rows: list[Row], found: dict[str, Any]) -> list[Row]:
    """The rows with other coefficients."""
    confidence.EDGE, confidence.HEIGHT = found["EDGE"], found["HEIGHT"]
    decoding.ANGLE_CALIBRATION, decoding.HEIGHT_CALIBRATION = (
        found.get("ANGLE_CALIBRATION", decoding.ANGLE_CALIBRATION),
        found.get("HEIGHT_CALIBRATION", decoding.HEIGHT_CALIBRATION),
    )
    return [
        replace(
            row,
            stated=confidence.share(row.told)
            if isinstance(row.told, Evidence)
            else decoding.expected_share(row.told),
        )
        for row in rows
    ]


def tables(title: str, rows: list[Row]) -> dict[str, Any]:
    """Half B by method and number of points."""
    print(f"{title}\n{'':28}buildings  stated   right     gap     AUC  correlation")
    figures: dict[str, Any] = {}
    for method in (NETWORK, NETWORK_AND_FIT, FIT):
        for count in ("all together", *FEW):
            own = [
                row
                for row in rows
                if not row.is_half_a and row.method == method and count in ("all together", row.num_points)
            ]
            if own:
                found = calibration(
                    np.array([row.stated for row in own]), np.array([row.share for row in own])
                )
                name = f"{method}, {'all points' if count is None else count}"
                numbers = (found.stated, found.observed, found.gap, found.auc, found.correlation)
                print(
                    f"{name:28}{found.count:9d}" + "".join(f"{value:8.3f}" for value in numbers), flush=True
                )
                known = (round(value, 4) if np.isfinite(value) else None for value in numbers)
                figures[f"{title}: {name}"] = [found.count, *known]
    return figures


def real_clouds(data: Path, predictor: Any) -> dict[str, Any]:
    """Of the houses in Delft: rank correlation of confidence and mean distance of the points to the mesh, and the
    confidence of those that are flagged as not representable."""
    config = Config().reconstruct
    every = real.read(data, "delft", Config())
    figures: dict[str, Any] = {}
    for name, network in ((FIT, None), (NETWORK_AND_FIT, predictor and predictor.with_num_views(1))):
        if name == NETWORK_AND_FIT and predictor is None:
            continue
        for parts in (1, config.max_parts):
            own = config.model_copy(update={"max_parts": parts})
            for count in (None, 80, 20):
                buildings = every if count is None else [real.thinned(b, count) for b in every]
                known = None if network is None else reconstruct_with_network(buildings, network, own)
                made = fitting.fit(buildings, own, known)
                pairs = [
                    (one.confidence, _distance_m(building, one))
                    for building, one in zip(every, made, strict=True)
                    if one.has_mesh and one.confidence is not None
                ]
                stated, off_m = np.array(pairs).T
                flagged = stated[off_m > config.not_representable_m]
                title = f"Delft, {name}, parts {parts}, {'all points' if count is None else count}"
                rank = float(stats.spearmanr(stated, off_m).statistic)
                told = {
                    "mean": float(stated.mean()),
                    "rank correlation with distance": rank,
                    "far off": len(flagged),
                    "their mean": float(flagged.mean()) if len(flagged) else None,
                    "their highest": float(flagged.max(initial=0.0)),
                    "mean of the others": float(stated[off_m <= config.not_representable_m].mean()),
                }
                print(f"{title}: " + ", ".join(f"{key} {_short(value)}" for key, value in told.items()))
                figures[title] = told
    return figures


def _distance_m(building: Building, made: Reconstruction) -> float:
    """Of all points on the roof, whatever it was fitted to."""
    own = roof_points(building.polygon, building.point_m, building.classification, made.ground_z_m)
    return float(distance_to_mesh(own - [0, 0, made.ground_z_m], made.vertex_m, made.triangle).mean())


def _short(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("manifests", type=Path, nargs="*", help="of crops with labels")
    parser.add_argument("--model", type=Path, default=None, help="beside the fit this network")
    parser.add_argument("--every", type=int, default=1, help="of each manifest only every k-th building")
    parser.add_argument("--fit", action="store_true", help="coefficients from half A")
    parser.add_argument("--data", type=Path, default=None, help="folder with delft_ahn3")
    arguments = parser.parse_args()
    predictor = None
    if arguments.model is not None:
        from p2wss.nets.predictor import load_predictor

        predictor = load_predictor(arguments.model)
    figures: dict[str, Any] = {}
    rows = [row for path in arguments.manifests for row in rows_of(read(path, arguments.every), predictor)]
    if rows:
        figures |= tables("as stated", rows)
        if arguments.fit:
            found = coefficients(rows)
            print(found)
            figures |= {
                "coefficients": found,
                **tables("with the coefficients of half A", restated(rows, found)),
            }
    if arguments.data is not None:
        figures |= real_clouds(arguments.data, predictor)
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
