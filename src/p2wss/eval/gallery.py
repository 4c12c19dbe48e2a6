"""The buildings that the report shows in pictures: the worst, and counterparts of the paper's Figures 7 to 14."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from p2wss.data.building import Reconstruction
from p2wss.data.schemas.crops import REAL, SIMULATED
from p2wss.eval.cases import Case
from p2wss.eval.causes import Cause, cause_of_error
from p2wss.eval.tables import main_method
from p2wss.reconstruct.product import FIT, NETWORK, NETWORK_AND_FIT

Key = tuple[str, str, str]
Row = Mapping[str, Any]
ROOFER = "roofer"


@dataclass(frozen=True)
class Exhibit:
    """A building to show: its key, the method whose mesh it is about, and the sentence below its picture."""

    key: Key
    method: str
    sentence: str


@dataclass(frozen=True)
class Counterpart:
    """A figure of the paper: what it shows, the criterion by which buildings like it were chosen, and these."""

    figure: str
    title: str
    criterion: str
    exhibits: Sequence[Exhibit]


class Gallery:
    """The measured buildings by data set, method and key, from which exhibits are chosen."""

    def __init__(
        self,
        cases: Mapping[Key, Case],
        reconstructions: Mapping[str, Mapping[Key, Reconstruction]],
        measures: Sequence[Row],
    ) -> None:
        self.cases = cases
        self.reconstructions = reconstructions
        self.rows: dict[tuple[str, str], dict[Key, Row]] = {}
        for row in measures:
            key = (row["dataset"], row["tile"], row["building_id"])
            if key in cases and key in reconstructions.get(row["method"], {}):
                self.rows.setdefault((row["dataset"], row["method"]), {})[key] = row
        self.main = main_method(list(reconstructions))
        self._causes: dict[tuple[Key, str], Cause] = {}

    def cause(self, key: Key, method: str) -> Cause:
        """Why the mesh of a method is far from its points."""
        if (key, method) not in self._causes:
            self._causes[key, method] = cause_of_error(
                self.cases[key], self.reconstructions[method][key], self.num_parts(key)
            )
        return self._causes[key, method]

    def num_parts(self, key: Key) -> int:
        """Number of parts of the building by the fit, 1 where it was not run."""
        for method in (NETWORK_AND_FIT, FIT):
            reconstruction = self.reconstructions.get(method, {}).get(key)
            if reconstruction is not None and reconstruction.has_mesh:
                return reconstruction.num_parts
        return 1

    def worst(self, dataset: str, count: int) -> list[Exhibit]:
        """The buildings with the largest distance from points to the mesh of our best variant.

        Buildings without a mesh, or with too few points to measure it, come first.
        """
        rows = self.rows.get((dataset, self.main), {})
        ranked = sorted(rows, key=lambda key: (-_or_infinite(rows[key]["points_to_mesh_m"]), key))
        return [Exhibit(key, self.main, self.cause(key, self.main).sentence) for key in ranked[:count]]

    def counterparts(self, count: int) -> list[Counterpart]:
        """Counterparts of Figures 7 to 14, up to ``count`` buildings each."""
        return [
            Counterpart(
                "7 (1)",
                "Height error, simulated LiDAR",
                "network alone: the largest error of the eave height where the angles are right within 5°",
                self._top(SIMULATED, NETWORK, self._height_error, count),
            ),
            Counterpart(
                "7 (2)",
                "Height error, real LiDAR",
                "network alone: the whole roof too high or too low by the most",
                self._top(REAL, NETWORK, self._shift, count),
            ),
            Counterpart(
                "8",
                "Discontinuous heights",
                "network alone, of buildings that the fit divides into parts: the most points far from the mesh",
                self._top(REAL, NETWORK, self._heights, count),
            ),
            Counterpart(
                "9",
                "Garage or annex",
                "network alone: the most points in one cluster at the edge, more than 0.5 m below the roof",
                self._top(REAL, NETWORK, self._because("garage or annex"), count),
            ),
            Counterpart(
                "10",
                "Dormer",
                "our best variant: the most points in one cluster more than 0.5 m above the roof",
                self._top(REAL, self.main, self._because("dormer"), count),
            ),
            Counterpart(
                "11",
                "Shed, hip or gable roof",
                "our best variant: the smallest distance from points to mesh, for each kind of roof",
                self._good(REAL, count),
            ),
            Counterpart(
                "12",
                "Missing planes of Roofer",
                "Roofer: the largest share of points more than 0.5 m from its mesh",
                [
                    *self._top(REAL, ROOFER, _missing, count),
                    *self._top(SIMULATED, ROOFER, _missing, count),
                ],
            ),
            Counterpart(
                "13",
                "Unrealistic structures of Roofer",
                "Roofer: the mesh that rises furthest above the highest point on the building",
                self._top(REAL, ROOFER, _overshoot, count),
            ),
            Counterpart(
                "14",
                "Artefacts of Roofer",
                "Roofer: the most faces smaller than 0.25 m²",
                self._top(REAL, ROOFER, _small_faces, count),
            ),
        ]

    def _top(
        self,
        dataset: str,
        method: str,
        score: Callable[[Key, Row], tuple[float, str] | None],
        count: int,
    ) -> list[Exhibit]:
        """The buildings with the highest scores; ``score`` returns score and sentence, or None to skip the building."""
        ranking = []
        for key, row in self.rows.get((dataset, method), {}).items():
            result = score(key, row) if row["num_triangles"] is not None else None
            if result is not None:
                ranking.append((-result[0], key, result[1]))
        return [Exhibit(key, method, sentence) for _, key, sentence in sorted(ranking)[:count]]

    def _height_error(self, key: Key, row: Row) -> tuple[float, str] | None:
        height, angle = row["height_error_m"], row["angle_error_deg"]
        if height is None or angle is None or angle > 5 or height <= 0:
            return None
        return height, f"Eave height wrong by {height:.2f} m, angles by {angle:.1f}°."

    def _shift(self, key: Key, row: Row) -> tuple[float, str] | None:
        shift = row["height_bias_m"]
        if (
            shift is None
            or row["points_to_mesh_m"] is None
            or self.cause(key, NETWORK).kind != "height error"
        ):
            return None
        return abs(shift), self.cause(key, NETWORK).sentence

    def _heights(self, key: Key, row: Row) -> tuple[float, str] | None:
        parts, far = self.num_parts(key), row["far_share"]
        if parts < 2 or far is None:
            return None
        best = self.rows.get((REAL, self.main), {}).get(key)
        after = "" if best is None or best["far_share"] is None else f", with parts {best['far_share']:.0%}"
        return (
            far,
            f"{parts} parts: with a single height {far:.0%} of the points are more than 0.5 m from the mesh{after}.",
        )

    def _because(self, kind: str) -> Callable[[Key, Row], tuple[float, str] | None]:
        def score(key: Key, row: Row) -> tuple[float, str] | None:
            far = row["far_share"]
            method = row["method"]
            if far is None or self.cause(key, method).kind != kind:
                return None
            return far, self.cause(key, method).sentence

        return score

    def _good(self, dataset: str, count: int) -> list[Exhibit]:
        rows = self.rows.get((dataset, self.main), {})
        exhibits = []
        for kind in ("shed", "hip", "gable"):
            keys = [
                key
                for key, row in rows.items()
                if row["roof_kind"] == kind and row["points_to_mesh_m"] is not None
            ]
            keys.sort(key=lambda key: (rows[key]["points_to_mesh_m"], key))
            for key in keys[: max(count // 2, 1)]:
                distance_m = rows[key]["points_to_mesh_m"]
                exhibits.append(
                    Exhibit(key, self.main, f"{kind.capitalize()}: points {distance_m:.2f} m from the mesh.")
                )
        return exhibits


def _missing(key: Key, row: Row) -> tuple[float, str] | None:
    far = row["far_share"]
    if not far:
        return None
    return far, f"{far:.0%} of the points are more than 0.5 m from Roofer's mesh."


def _overshoot(key: Key, row: Row) -> tuple[float, str] | None:
    over = row["overshoot_m"]
    if over is None or over <= 0.3:
        return None
    return over, f"Roofer's mesh rises {over:.1f} m above the highest point on the building."


def _small_faces(key: Key, row: Row) -> tuple[float, str] | None:
    small = row["num_small_faces"]
    if not small:
        return None
    return float(
        small
    ), f"{small} of Roofer's faces are smaller than 0.25 m² ({row['num_triangles']} triangles)."


def cause_counts(gallery: Gallery, dataset: str) -> list[tuple[str, int]]:
    """How often each kind of cause occurs, the most frequent first.

    Counted over the buildings whose points are more than 0.25 m from the mesh of our best variant on average, or that
    have no mesh.
    """
    rows = gallery.rows.get((dataset, gallery.main), {})
    far = [key for key, row in rows.items() if _or_infinite(row["points_to_mesh_m"]) > 0.25]
    kinds = [gallery.cause(key, gallery.main).kind for key in far]
    return sorted(((kind, kinds.count(kind)) for kind in set(kinds)), key=lambda pair: (-pair[1], pair[0]))


def _or_infinite(value: float | None) -> float:
    return float("inf") if value is None or not np.isfinite(value) else float(value)
