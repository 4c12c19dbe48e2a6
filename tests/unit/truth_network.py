"""A stand-in for the network that returns the true values of the buildings of the evaluation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss.eval import cases
from p2wss.nets.prediction import Prediction


class TruthNetwork:
    """Looks up the case with the same points; ``wrong_m`` and ``wrong_deg`` are added to its values. With ``slope_deg``
    every edge has that angle."""

    max_num_vertices, on_building = 8, False

    def __init__(
        self,
        true_cases: Sequence[cases.Case],
        wrong_m: float = 0.0,
        wrong_deg: float = 0.0,
        slope_deg: float | None = None,
    ) -> None:
        self.true_cases = true_cases
        self.wrong_m, self.wrong_deg, self.slope_deg = wrong_m, wrong_deg, slope_deg

    def _case(self, points: np.ndarray) -> cases.Case:
        def same(case: cases.Case) -> bool:
            building = case.building
            return len(points) == len(building.point_m) and np.allclose(points, building.point_m)

        return next(case for case in self.true_cases if same(case))

    def predict(self, points_m: Sequence[np.ndarray], rings: Sequence[Sequence[np.ndarray]]) -> Prediction:
        same_cases = [self._case(points) for points in points_m]
        height = np.array([case.eave_height_m or 5.0 for case in same_cases]) + self.wrong_m
        angle = [
            np.full(sum(map(len, r)), 30.0) if c.angle_deg is None else c.angle_deg + self.wrong_deg
            for c, r in zip(same_cases, rings, strict=True)
        ]
        if self.slope_deg is not None:
            angle = [np.full(len(angle_deg), self.slope_deg) for angle_deg in angle]
        return Prediction(height, angle)

    def reconstruct_all_masked(
        self, points_m: Sequence[np.ndarray], footprints_m: Sequence[np.ndarray], signs_visible: bool = True
    ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        values = self.predict(points_m, [[ring] for ring in footprints_m])
        offset_m = 0.3 if signs_visible else 0.6
        return (
            values.eave_height_m,
            [ring + np.array([offset_m, 0.0]) for ring in footprints_m],
            list(values.angle_deg),
        )
