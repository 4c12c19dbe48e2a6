"""Errors of heights, angles and footprints against the labels of the simulated test split (Table 1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from p2wss.data.building import Reconstruction
from p2wss.eval.cases import Case
from p2wss.eval.methods import MASKED
from p2wss.skeleton.queries import roof_points
from p2wss.skeleton.types import Polygons

# a roof counts as seen with this many points on it, an edge with this many over its sloped face
MIN_SEEN_POINTS = 10


def parameter_errors(pairs: Sequence[tuple[Case, Reconstruction]]) -> Iterator[dict[str, Any]]:
    """The columns of errors of the schema ``MEASURES`` for each case and its reconstruction.

    They are absent without labels, or where the reconstruction has no parameters; those of angles also where it has
    other edges than the label.
    """
    comparable = [
        (case, row.angle_deg, case.angle_deg)
        for case, row in pairs
        if case.angle_deg is not None
        and row.angle_deg is not None
        and len(row.angle_deg) == len(case.angle_deg)
    ]
    seen = seen_edges([case for case, _, _ in comparable], [angle_deg for _, angle_deg, _ in comparable])
    of_edges = {
        case.key: {"angle_error_deg": np.abs(angle_deg - truth_deg), "is_angle_seen": is_seen}
        for (case, angle_deg, truth_deg), is_seen in zip(comparable, seen, strict=True)
    }
    for case, row in pairs:
        is_height_seen = bool(case.building.is_on_building.sum() >= MIN_SEEN_POINTS)
        errors: dict[str, Any] = {"is_height_seen": is_height_seen, **of_edges.get(case.key, {})}
        if case.is_labelled and row.eave_height_m is not None:
            errors["height_error_m"] = abs(row.eave_height_m - target_height_m(case))
        if case.key in of_edges and row.method in MASKED:
            errors["coordinate_error_m"] = np.abs(row.rings[0] - case.building.rings[0]).ravel()
        yield errors


def seen_edges(cases: Sequence[Case], angle_deg: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Mask of the edges that the points determine, per labelled case: bool, one value per edge over all rings.

    angle_deg: the angles by a method. An edge is seen if ten points on the building lie over its sloped face, in the
    roof of the label or of the method. A gable that the method predicts as such has no face, and a wall under a flat
    roof is the same with 0 and with 90 degrees: neither counts as seen.
    """
    if not cases:
        return []
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
