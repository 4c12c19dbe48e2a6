"""Which buildings the report shows: the worst, and counterparts of the paper's Figures 7 to 14."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from p2wss.data.building import Reconstruction
from p2wss.data.schemas.crops import REAL, SIMULATED
from p2wss.eval.cases import Case
from p2wss.eval.reasons import Reason, reason
from p2wss.eval.tables import main_method
from p2wss.reconstruct.product import FIT, NETWORK, NETWORK_AND_FIT

Key = tuple[str, str, str]
Row = Mapping[str, Any]
ROOFER = "roofer"


@dataclass(frozen=True)
class Shown:
    """A building to show: its key, whose mesh it is about, and the sentence below its picture."""

    key: Key
    method: str
    sentence: str


@dataclass(frozen=True)
class Counterpart:
    """What a figure of the paper shows, by which measure it was looked for here, and what was found."""

    figure: str
    title: str
    criterion: str
    shown: Sequence[Shown]


class Gallery:
    """The measured buildings, by data set, method and key, with the reasons found so far."""

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
        self._reasons: dict[tuple[Key, str], Reason] = {}

    def reason(self, key: Key, method: str) -> Reason:
        """Why the mesh of a method is off."""
        if (key, method) not in self._reasons:
            made = self.reconstructions[method][key]
            self._reasons[key, method] = reason(self.cases[key], made, self.num_parts(key))
        return self._reasons[key, method]

    def num_parts(self, key: Key) -> int:
        """Heights that the fit has, 1 where it was not run."""
        for method in (NETWORK_AND_FIT, FIT):
            made = self.reconstructions.get(method, {}).get(key)
            if made is not None and made.has_mesh:
                return made.num_parts
        return 1

    def worst(self, dataset: str, count: int) -> list[Shown]:
        """Those of our best variant with the largest distance from points to mesh, buildings without a mesh
        or without enough points first."""
        rows = self.rows.get((dataset, self.main), {})
        ranked = sorted(rows, key=lambda key: (-_or_infinite(rows[key]["points_to_mesh_m"]), key))
        return [Shown(key, self.main, self.reason(key, self.main).sentence) for key in ranked[:count]]

    def counterparts(self, count: int) -> list[Counterpart]:
        """Those of Figures 7 to 14, up to ``count`` buildings each."""
        return [
            Counterpart(
                "7 (1)",
                "Height error, simulated",
                "network only: the largest error of the eave's height where the angles are right within 5°",
                self._top(SIMULATED, NETWORK, self._height_error, count),
            ),
            Counterpart(
                "7 (2)",
                "Height error, LiDAR",
                "network only: the whole roof too high or too low, by the most",
                self._top(REAL, NETWORK, self._shift, count),
            ),
            Counterpart(
                "8",
                "Discontinuous heights",
                "buildings that the fit cut into parts: the network's one height is furthest off",
                self._top(REAL, NETWORK, self._heights, count),
            ),
            Counterpart(
                "9",
                "Garage or annex",
                "network only: the most points in one place at the edge, more than 0.5 m below the roof",
                self._top(REAL, NETWORK, self._because("garage or annex"), count),
            ),
            Counterpart(
                "10",
                "Dormer",
                "our best variant: points in one place more than 0.5 m above the roof",
                self._top(REAL, self.main, self._because("dormer"), count),
            ),
            Counterpart(
                "11",
                "Shed, hip or gable roof",
                "our best variant: the least distance from points to mesh of each kind of roof",
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
                "Roofer: the mesh rises furthest above the highest point on the building",
                self._top(REAL, ROOFER, _overshoot, count),
            ),
            Counterpart(
                "14",
                "Artefacts of Roofer",
                "Roofer: the most faces below 0.25 m²",
                self._top(REAL, ROOFER, _small_faces, count),
            ),
        ]

    def _top(
        self,
        dataset: str,
        method: str,
        score: Callable[[Key, Row], tuple[float, str] | None],
        count: int,
    ) -> list[Shown]:
        """The buildings with the highest scores; ``score`` gives it with a sentence, or None to leave out."""
        found = []
        for key, row in self.rows.get((dataset, method), {}).items():
            scored = score(key, row) if row["num_triangles"] is not None else None
            if scored is not None:
                found.append((-scored[0], key, scored[1]))
        return [Shown(key, method, sentence) for _, key, sentence in sorted(found)[:count]]

    def _height_error(self, key: Key, row: Row) -> tuple[float, str] | None:
        height, angle = row["height_error_m"], row["angle_error_deg"]
        if height is None or angle is None or angle > 5 or height <= 0:
            return None
        return height, f"Eave {height:.2f} m off, angles {angle:.1f}°."

    def _shift(self, key: Key, row: Row) -> tuple[float, str] | None:
        shift = row["height_bias_m"]
        if (
            shift is None
            or row["points_to_mesh_m"] is None
            or self.reason(key, NETWORK).kind != "height error"
        ):
            return None
        return abs(shift), self.reason(key, NETWORK).sentence

    def _heights(self, key: Key, row: Row) -> tuple[float, str] | None:
        parts, far = self.num_parts(key), row["far_share"]
        if parts < 2 or far is None:
            return None
        best = self.rows.get((REAL, self.main), {}).get(key)
        after = "" if best is None or best["far_share"] is None else f", with parts {best['far_share']:.0%}"
        return far, f"{parts} parts; with one height {far:.0%} of the points are more than 0.5 m off{after}."

    def _because(self, kind: str) -> Callable[[Key, Row], tuple[float, str] | None]:
        def score(key: Key, row: Row) -> tuple[float, str] | None:
            far = row["far_share"]
            method = row["method"]
            if far is None or self.reason(key, method).kind != kind:
                return None
            return far, self.reason(key, method).sentence

        return score

    def _good(self, dataset: str, count: int) -> list[Shown]:
        rows = self.rows.get((dataset, self.main), {})
        found = []
        for kind in ("shed", "hip", "gable"):
            own = [
                key
                for key, row in rows.items()
                if row["roof_kind"] == kind and row["points_to_mesh_m"] is not None
            ]
            own.sort(key=lambda key: (rows[key]["points_to_mesh_m"], key))
            for key in own[: max(count // 2, 1)]:
                off = rows[key]["points_to_mesh_m"]
                found.append(Shown(key, self.main, f"{kind.capitalize()}: points {off:.2f} m from the mesh."))
        return found


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
    return float(small), f"{small} of Roofer's faces are below 0.25 m² ({row['num_triangles']} triangles)."


def counts_of_reasons(gallery: Gallery, dataset: str) -> list[tuple[str, int]]:
    """How often each kind of reason is found among all buildings of our best variant that are more than
    0.25 m off on average, or have no mesh."""
    rows = gallery.rows.get((dataset, gallery.main), {})
    off = [key for key, row in rows.items() if _or_infinite(row["points_to_mesh_m"]) > 0.25]
    kinds = [gallery.reason(key, gallery.main).kind for key in off]
    return sorted(((kind, kinds.count(kind)) for kind in set(kinds)), key=lambda pair: (-pair[1], pair[0]))


def _or_infinite(value: float | None) -> float:
    return float("inf") if value is None or not np.isfinite(value) else float(value)
