"""The buildings that the report shows in pictures: the worst, and counterparts of the paper's Figures 7 to 14."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from p2wss.eval.cases import Key
from p2wss.eval.causes import UNEXPLAINED_M
from p2wss.eval.methods import main_method
from p2wss.eval.tables import numbers, rows_of
from p2wss.reconstruct.product import FIT, NETWORK, NETWORK_AND_FIT
from p2wss.storage.schemas.crops import REAL, SIMULATED

Row = Any
ROOFER = "roofer"
_NUMBERS = (
    "num_triangles",
    "num_parts",
    "num_small_faces",
    "points_to_mesh_m",
    "far_share",
    "height_bias_m",
    "overshoot_m",
    "height_error_m",
    "angle_error_deg",
)
_TEXTS = ("tile", "building_id", "roof_kind", "cause")
# the largest error of the angles of a building that is an example of a wrong height alone, and the least overshoot of
# one that is an example of that
_RIGHT_ANGLES_DEG, _MIN_OVERSHOOT_M = 5, 0.3


@dataclass(frozen=True)
class Exhibit:
    """A building to show: its key, the method whose mesh it is about, and the sentence below its picture.

    Where the sentence is None, it is that of the cause (:func:`p2wss.eval.causes.cause_of_error`).
    """

    key: Key
    method: str
    sentence: str | None = None


@dataclass(frozen=True)
class Counterpart:
    """A figure of the paper: what it shows, the criterion by which buildings like it were chosen, and these."""

    figure: str
    title: str
    criterion: str
    exhibits: Sequence[Exhibit]


class Gallery:
    """Chooses exhibits from the measures alone; points and meshes are read afterwards, of the exhibits only.

    methods: those of the evaluation, also if they have no row.
    """

    def __init__(self, measures: pa.Table, methods: Sequence[str]) -> None:
        self.main = main_method(methods)
        self._measures = measures.select(["dataset", "method", *_NUMBERS, *_TEXTS])
        self._frames: dict[tuple[str, str], pd.DataFrame] = {}

    def _rows(self, dataset: str, method: str) -> pd.DataFrame:
        """The measures of a method, by tile and building; numbers as float64."""
        if (dataset, method) not in self._frames:
            rows = rows_of(self._measures, dataset, method)
            frame = rows.select(list(_TEXTS)).to_pandas()
            frame = frame.assign(**{name: numbers(rows, name) for name in _NUMBERS})
            self._frames[dataset, method] = frame.sort_values(["tile", "building_id"], ignore_index=True)
        return self._frames[dataset, method]

    def worst(self, dataset: str, count: int) -> list[Exhibit]:
        """The buildings with the largest distance from points to the mesh of our best variant.

        Buildings without a mesh, or with too few points to measure it, come first.
        """
        rows = self._rows(dataset, self.main)
        ranked = rows.assign(score=rows["points_to_mesh_m"].fillna(np.inf))
        return [Exhibit(_key(dataset, row), self.main) for row in _highest(ranked, count)]

    def cause_counts(self, dataset: str) -> list[tuple[str, int]]:
        """How often each kind of cause occurs, the most frequent first.

        Counted over the buildings whose points are more than 0.25 m from the mesh of our best variant on average, or
        that have no mesh.
        """
        rows = self._rows(dataset, self.main)
        kinds = rows["cause"][rows["points_to_mesh_m"].fillna(np.inf) > UNEXPLAINED_M].value_counts()
        return sorted(
            ((str(kind), int(count)) for kind, count in kinds.items()), key=lambda pair: (-pair[1], pair[0])
        )

    def counterparts(self, count: int) -> list[Counterpart]:
        """Counterparts of Figures 7 to 14, up to ``count`` buildings each."""
        return [
            Counterpart(
                "7 (1)",
                "Height error, simulated LiDAR",
                "network alone: the largest error of the eave height where the angles are correct within 5°",
                self._top(SIMULATED, NETWORK, _height_errors, count, _height_sentence),
            ),
            Counterpart(
                "7 (2)",
                "Height error, real LiDAR",
                "network alone: the largest vertical offset of the whole roof",
                self._top(REAL, NETWORK, _shifts, count),
            ),
            Counterpart(
                "8",
                "Discontinuous heights",
                "network alone, buildings with several parts in the fit: the largest share of points far from the mesh",
                self._several_heights(count),
            ),
            Counterpart(
                "9",
                "Garage or annex",
                "network alone: the most points in one cluster at the edge, more than 0.5 m below the roof",
                self._top(REAL, NETWORK, _because("garage or annex"), count),
            ),
            Counterpart(
                "10",
                "Dormer",
                "our best variant: the most points in one cluster more than 0.5 m above the roof",
                self._top(REAL, self.main, _because("dormer"), count),
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
                    *self._top(REAL, ROOFER, _missing, count, _missing_sentence),
                    *self._top(SIMULATED, ROOFER, _missing, count, _missing_sentence),
                ],
            ),
            Counterpart(
                "13",
                "Unrealistic structures of Roofer",
                "Roofer: the mesh that rises furthest above the highest point on the building",
                self._top(REAL, ROOFER, _overshoots, count, _overshoot_sentence),
            ),
            Counterpart(
                "14",
                "Artefacts of Roofer",
                "Roofer: the most faces smaller than 0.25 m²",
                self._top(REAL, ROOFER, _small_faces, count, _small_faces_sentence),
            ),
        ]

    def _top(
        self,
        dataset: str,
        method: str,
        score: Callable[[pd.DataFrame], pd.Series],
        count: int,
        sentence: Callable[[Row], str | None] | None = None,
    ) -> list[Exhibit]:
        """The buildings with the highest scores; those whose score is NaN, or without a mesh, are skipped."""
        rows = self._rows(dataset, method)
        ranked = rows.assign(score=score(rows).where(rows["num_triangles"].notna()))
        return [
            Exhibit(_key(dataset, row), method, None if sentence is None else sentence(row))
            for row in _highest(ranked, count)
        ]

    def _several_heights(self, count: int) -> list[Exhibit]:
        """Buildings with several parts by the fit, of which the network made a mesh with a single height."""
        names = ["tile", "building_id"]
        rows, best = self._rows(REAL, NETWORK), self._rows(REAL, self.main)
        parts = [
            self._rows(REAL, method).set_index(names)["num_parts"].dropna()
            for method in (NETWORK_AND_FIT, FIT)
        ]
        index = pd.MultiIndex.from_frame(rows[names])
        num_parts = parts[0].reindex(index).combine_first(parts[1].reindex(index)).reindex(index).to_numpy()
        after = best.set_index(names)["far_share"].reindex(index).to_numpy()
        is_chosen = rows["num_triangles"].notna() & (num_parts >= 2)
        ranked = rows.assign(parts=num_parts, after=after, score=rows["far_share"].where(is_chosen))
        exhibits = []
        for row in _highest(ranked, count):
            after_text = "" if np.isnan(row.after) else f", with parts {row.after:.0%}"
            sentence = (
                f"{int(row.parts)} parts: with a single height {row.far_share:.0%} of the points are more than 0.5 m "
                f"from the mesh{after_text}."
            )
            exhibits.append(Exhibit(_key(REAL, row), NETWORK, sentence))
        return exhibits

    def _good(self, dataset: str, count: int) -> list[Exhibit]:
        rows = self._rows(dataset, self.main)
        exhibits = []
        for kind in ("shed", "hip", "gable"):
            ranked = rows.assign(score=-rows["points_to_mesh_m"].where(rows["roof_kind"] == kind))
            for row in _highest(ranked, max(count // 2, 1)):
                sentence = f"{kind.capitalize()}: points {row.points_to_mesh_m:.2f} m from the mesh."
                exhibits.append(Exhibit(_key(dataset, row), self.main, sentence))
        return exhibits


def _highest(rows: pd.DataFrame, count: int) -> list[Row]:
    """The rows with the highest ``score``; of equal ones, the first. NaN is skipped."""
    ranked = rows[rows["score"].notna()].sort_values("score", ascending=False, kind="stable")
    return list(ranked[:count].itertuples())


def _key(dataset: str, row: Row) -> Key:
    return dataset, row.tile, row.building_id


def _height_errors(rows: pd.DataFrame) -> pd.Series:
    return rows["height_error_m"].where(
        (rows["angle_error_deg"] <= _RIGHT_ANGLES_DEG) & (rows["height_error_m"] > 0)
    )


def _shifts(rows: pd.DataFrame) -> pd.Series:
    is_shifted = (rows["cause"] == "height error") & rows["points_to_mesh_m"].notna()
    return rows["height_bias_m"].abs().where(is_shifted)


def _because(kind: str) -> Callable[[pd.DataFrame], pd.Series]:
    return lambda rows: rows["far_share"].where(rows["cause"] == kind)


def _missing(rows: pd.DataFrame) -> pd.Series:
    return rows["far_share"].where(rows["far_share"] > 0)


def _overshoots(rows: pd.DataFrame) -> pd.Series:
    return rows["overshoot_m"].where(rows["overshoot_m"] > _MIN_OVERSHOOT_M)


def _small_faces(rows: pd.DataFrame) -> pd.Series:
    return rows["num_small_faces"].where(rows["num_small_faces"] > 0)


def _height_sentence(row: Row) -> str:
    return f"Eave height off by {row.height_error_m:.2f} m, angles by {row.angle_error_deg:.1f}°."


def _missing_sentence(row: Row) -> str:
    return f"{row.far_share:.0%} of the points are more than 0.5 m from Roofer's mesh."


def _overshoot_sentence(row: Row) -> str:
    return f"Roofer's mesh rises {row.overshoot_m:.1f} m above the highest point on the building."


def _small_faces_sentence(row: Row) -> str:
    num_faces, num_triangles = int(row.num_small_faces), int(row.num_triangles)
    return f"{num_faces} of Roofer's faces are smaller than 0.25 m² ({num_triangles} triangles)."
