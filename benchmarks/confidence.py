"""Calibration of the stated confidence on labelled simulated buildings, each with all its points and with few.

    python benchmarks/confidence.py results/town/crops/manifest.json .. --model model.safetensors
    .. --fit                     # also coefficients fitted to half A, and their figures on half B
    .. --every 6                 # only every sixth building of each manifest
    .. --data ../shared/data     # also real clouds: whether a low confidence goes with a large distance

Half A (every second building by id) determines coefficients, all figures are of half B; the last line is JSON. Use
buildings that the network was not trained on, and not those whose results are reported.
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
from calibration import calibration
from scipy import stats
from scipy.special import expit

from p2wss.config import Config
from p2wss.data.building import Building, Reconstruction
from p2wss.data.manifest import read_manifest
from p2wss.eval import cases
from p2wss.eval.cases import Case
from p2wss.fit import fitting
from p2wss.fit.points import roof_points
from p2wss.fit.roof import confidence
from p2wss.fit.roof.evidence import Evidence
from p2wss.mesh.surface import distance_to_mesh
from p2wss.nets import decoding
from p2wss.reconstruct.network import reconstruct_with_network
from p2wss.reconstruct.product import FIT, NETWORK, NETWORK_AND_FIT
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS, SIMULATED

FEW = (None, 200, 80, 20)
# a value within these of the label counts as correct
CORRECT_M, CORRECT_DEG = 0.5, 5.0


@dataclass(frozen=True)
class Row:
    """One reconstruction.

    is_correct: bool (edges + 1,), the height first. evidence: of the fit, or the network's probabilities (edges + 1,).
    """

    method: str
    num_points: int | None
    is_half_a: bool
    is_correct: np.ndarray
    stated: float
    evidence: Evidence | np.ndarray

    @property
    def share(self) -> float:
        return float(self.is_correct.mean())


def read(manifest: Path, every: int) -> list[Case]:
    """Every k-th labelled building of any split, in the order of tile and id."""
    every_case: list[Case] = []
    for path, dataset, _ in read_manifest(manifest).shards:
        if dataset == SIMULATED:
            every_case += cases.from_crops(files.read_table(path, CROPS), dataset)
    return sorted((case for case in every_case if case.angle_deg is not None), key=lambda case: case.key)[
        ::every
    ]


@contextmanager
def recorded_evidence() -> Iterator[list[Evidence]]:
    """Record the evidence from which each fit within the block derives its confidence."""
    record: list[Evidence] = []
    share = confidence.share

    def recording(evidence: Evidence) -> float:
        record.append(evidence)
        return share(evidence)

    confidence.share = recording
    try:
        yield record
    finally:
        confidence.share = share


class RecordingPredictor:
    """A predictor that keeps its last prediction."""

    def __init__(self, predictor: Any) -> None:
        self.predictor, self.max_num_vertices, self.last = predictor, predictor.max_num_vertices, None

    def predict(self, points_m: list[np.ndarray], rings: list[list[np.ndarray]]) -> Any:
        self.last = self.predictor.predict(points_m, rings)
        return self.last


def rows_of(every_case: list[Case], predictor: Any) -> list[Row]:
    """Rows of every building with every number of points, by each method."""
    config = labelled.config()
    rows: list[Row] = []
    views = None if predictor is None else RecordingPredictor(predictor)
    one_view = None if predictor is None else predictor.with_num_views(1)
    for number, case in enumerate(every_case):
        for count in FEW:
            building = case.building if count is None else real.thinned(case.building, count)
            if count is not None and len(building.point_m) == len(case.building.point_m):
                continue
            thinned = replace(case, building=building)
            if views is not None and one_view is not None:
                (row,) = reconstruct_with_network([building], views, config)
                if row.has_mesh and views.last is not None:
                    rows += _row(NETWORK, count, number, thinned, row, views.last.probability[0])
                starts = reconstruct_with_network([building], one_view, config)
                rows += _fitted(NETWORK_AND_FIT, count, number, thinned, starts)
            rows += _fitted(FIT, count, number, thinned, None)
    return rows


def _fitted(
    method: str, count: int | None, number: int, case: Case, starts: list[Reconstruction] | None
) -> list[Row]:
    with recorded_evidence() as record:
        (row,) = fitting.fit([case.building], labelled.config(), starts)
    return _row(method, count, number, case, row, record[-1]) if record and row.has_mesh else []


def _row(
    method: str,
    count: int | None,
    number: int,
    case: Case,
    reconstruction: Reconstruction,
    evidence: Evidence | np.ndarray,
) -> list[Row]:
    assert case.angle_deg is not None and case.eave_height_m is not None
    angle_deg, eave_height_m = reconstruction.angle_deg, reconstruction.eave_height_m
    if angle_deg is None or eave_height_m is None or reconstruction.confidence is None:
        return []
    eave_m = case.eave_height_m + (case.label_terrain_z_m or 0.0) - reconstruction.ground_z_m
    is_correct = np.append(
        abs(eave_height_m - eave_m) <= CORRECT_M,
        np.abs(angle_deg - case.angle_deg) <= CORRECT_DEG,
    )
    return [Row(method, count, number % 2 == 0, is_correct, reconstruction.confidence, evidence)]


def logistic_fit(terms: np.ndarray, is_correct: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Coefficients of 1 and of terms (n, k) by maximum likelihood: Newton's method with a small ridge penalty."""
    design = np.column_stack([np.ones(len(terms)), terms])
    coefficient = np.zeros(design.shape[1])
    ridge = 1e-3 * np.eye(len(coefficient))
    for _ in range(50):
        stated = expit(design @ coefficient)
        gradient = design.T @ (weight * (is_correct - stated)) - ridge @ coefficient
        hessian = (design.T * (weight * stated * (1 - stated))) @ design + ridge
        step = np.linalg.solve(hessian, gradient)
        coefficient += step * min(1.0, 5.0 / np.abs(step).max())
        if np.abs(step).max() < 1e-6:
            break
    return coefficient


def _both(
    rows: list[Row], edge: Callable[[Any], np.ndarray], height: Callable[[Any], np.ndarray]
) -> list[list[float]]:
    """Coefficients of edges and of heights; every building has the same weight, however many edges it has."""
    # the evidence of a building with many edges covers only some of them
    rows = [row for row in rows if len(edge(row.evidence)) == len(row.is_correct) - 1]
    weight = np.concatenate([np.full(len(row.is_correct) - 1, 5 / len(row.is_correct)) for row in rows])
    of_edges = logistic_fit(
        np.concatenate([edge(row.evidence) for row in rows]),
        np.concatenate([row.is_correct[1:] for row in rows]).astype(float),
        weight,
    )
    of_heights = logistic_fit(
        np.array([height(row.evidence) for row in rows]),
        np.array([row.is_correct[0] for row in rows], float),
        np.ones(len(rows)),
    )
    return [np.round(values, 2).tolist() for values in (of_edges, of_heights)]


def coefficients(rows: list[Row]) -> dict[str, Any]:
    """Coefficients fitted to half A: of both fits together, and of the network."""
    half = [row for row in rows if row.is_half_a]
    fits = [row for row in half if row.method != NETWORK]
    result: dict[str, Any] = {}
    result["EDGE"], result["HEIGHT"] = _both(fits, confidence.edge_terms, confidence.height_terms)
    networks = [row for row in half if row.method == NETWORK and len(row.evidence) == len(row.is_correct)]
    if networks:
        result["ANGLE_CALIBRATION"], result["HEIGHT_CALIBRATION"] = _both(
            networks,
            lambda probability: decoding.log_odds(probability[1:])[:, None],
            lambda probability: decoding.log_odds(probability[:1]),
        )
    return result


def restated(rows: list[Row], values: dict[str, Any]) -> list[Row]:
    """The rows with the confidence by other coefficients."""
    confidence.EDGE, confidence.HEIGHT = values["EDGE"], values["HEIGHT"]
    decoding.ANGLE_CALIBRATION, decoding.HEIGHT_CALIBRATION = (
        values.get("ANGLE_CALIBRATION", decoding.ANGLE_CALIBRATION),
        values.get("HEIGHT_CALIBRATION", decoding.HEIGHT_CALIBRATION),
    )
    return [
        replace(
            row,
            stated=confidence.share(row.evidence)
            if isinstance(row.evidence, Evidence)
            else decoding.expected_share(row.evidence),
        )
        for row in rows
    ]


def tables(title: str, rows: list[Row]) -> dict[str, Any]:
    """Figures of half B by method and number of points."""
    print(f"{title}\n{'':28}buildings  stated correct     gap     AUC  correlation")
    figures: dict[str, Any] = {}
    for method in (NETWORK, NETWORK_AND_FIT, FIT):
        for count in ("all together", *FEW):
            part = [
                row
                for row in rows
                if not row.is_half_a and row.method == method and count in ("all together", row.num_points)
            ]
            if part:
                scores = calibration(
                    np.array([row.stated for row in part]), np.array([row.share for row in part])
                )
                name = f"{method}, {'all points' if count is None else count}"
                numbers = (scores.stated, scores.observed, scores.gap, scores.auc, scores.correlation)
                print(
                    f"{name:28}{scores.count:9d}" + "".join(f"{value:8.3f}" for value in numbers), flush=True
                )
                rounded = (round(value, 4) if np.isfinite(value) else None for value in numbers)
                figures[f"{title}: {name}"] = [scores.count, *rounded]
    return figures


def real_clouds(data: Path, predictor: Any) -> dict[str, Any]:
    """Confidence of the houses in Delft: its rank correlation with the mean distance of the points to the mesh, and its
    values where the mesh is flagged as not representable."""
    config = Config().reconstruct
    every = real.read(data, "delft", Config())
    figures: dict[str, Any] = {}
    for name, network in ((FIT, None), (NETWORK_AND_FIT, predictor and predictor.with_num_views(1))):
        if name == NETWORK_AND_FIT and predictor is None:
            continue
        for roofs in ("parametric", "planes"):
            settings = config.model_copy(update={"roofs": roofs})
            for count in (None, 80, 20):
                buildings = every if count is None else [real.thinned(b, count) for b in every]
                starts = None if network is None else reconstruct_with_network(buildings, network, settings)
                rows = fitting.fit(buildings, settings, starts)
                pairs = [
                    (row.confidence, _distance_m(building, row))
                    for building, row in zip(every, rows, strict=True)
                    if row.has_mesh and row.confidence is not None
                ]
                stated, distance_m = np.array(pairs).T
                flagged = stated[distance_m > config.not_representable_m]
                title = f"Delft, {name}, {roofs}, {'all points' if count is None else count}"
                rank = float(stats.spearmanr(stated, distance_m).statistic)
                figures[title] = {
                    "mean": float(stated.mean()),
                    "rank correlation with distance": rank,
                    "not representable": len(flagged),
                    "their mean": float(flagged.mean()) if len(flagged) else None,
                    "their highest": float(flagged.max(initial=0.0)),
                    "mean of the others": float(stated[distance_m <= config.not_representable_m].mean()),
                }
                print(
                    f"{title}: "
                    + ", ".join(f"{key} {_short(value)}" for key, value in figures[title].items())
                )
    return figures


def _distance_m(building: Building, row: Reconstruction) -> float:
    """Mean distance to the mesh of all points on the roof, also of those that the fit did not get."""
    point_m = roof_points(building.polygon, building.point_m, building.classification)
    return float(distance_to_mesh(point_m, row.mesh.vertex_m, row.mesh.triangle).mean())


def _short(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("manifests", type=Path, nargs="*", help="manifests of crops with labels")
    parser.add_argument(
        "--model", type=Path, default=None, help="weights of a network, besides the fit alone"
    )
    parser.add_argument("--every", type=int, default=1, help="only every k-th building of each manifest")
    parser.add_argument("--fit", action="store_true", help="fit coefficients to half A")
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
            values = coefficients(rows)
            print(values)
            figures |= {
                "coefficients": values,
                **tables("with the coefficients of half A", restated(rows, values)),
            }
    if arguments.data is not None:
        figures |= real_clouds(arguments.data, predictor)
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
