"""Buildings fitted to their points, from the network's reconstruction or from nothing (``p2wss.refine``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from p2wss.config import Reconstruct
from p2wss.inference import NO_POINT, Building, Reconstruction, build, ground_z_m, mesh_footprint
from p2wss.refine.one_height import MIN_NUM_POINTS, Effort, Fitter, Limits, OneHeight
from p2wss.refine.points import roof_points

METHOD = "fit"


@dataclass(frozen=True)
class _Found:
    rings: Sequence[np.ndarray]
    eave_height_m: float
    angle_deg: np.ndarray
    top_height_m: float
    refused: str


def fit(
    buildings: Sequence[Building],
    config: Reconstruct,
    known: Sequence[Reconstruction] | None = None,
    method: str = METHOD,
) -> list[Reconstruction]:
    """One reconstruction per building, in order: the parametric building nearest to the points on its roof.

    ``known``: the network's reconstructions of the same buildings; each is where a search begins, and it stays
    where the points are too few, nothing better is found or the kernel rejects what is found. Deterministic.
    """
    fitter = Fitter(Limits(max_roof_height_m=config.max_roof_height_m))
    starts = [None] * len(buildings) if known is None else list(known)
    found = [_fit(fitter, b, start, config) for b, start in zip(buildings, starts, strict=True)]
    confidence = [
        np.nan if start is None or start.confidence is None else start.confidence for start in starts
    ]
    made = build(
        buildings,
        [one.rings for one in found],
        [ground_z_m(building) for building in buildings],
        np.array([one.eave_height_m for one in found]),
        [one.angle_deg for one in found],
        np.array(confidence, float),
        method,
        config,
        [one.refused for one in found],
        np.array([one.top_height_m for one in found]),
    )
    for i, start in enumerate(starts):
        if not made[i].has_mesh and start is not None and start.has_mesh:
            made[i] = replace(start, method=method)
    return made


def _fit(fitter: Fitter, building: Building, start: Reconstruction | None, config: Reconstruct) -> _Found:
    rings = mesh_footprint(building, config)
    none = np.zeros(sum(map(len, rings)))
    if not len(building.point_m):
        return _Found(rings, np.nan, none, np.inf, NO_POINT)
    if len(building.point_m) < config.min_num_points:
        return _Found(rings, np.nan, none, np.inf, f"fewer than {config.min_num_points} points")
    ground = ground_z_m(building)
    polygon = shapely.Polygon(rings[0], rings[1:])
    point_m = roof_points(polygon, building.point_m, building.classification, ground)
    if len(point_m) < MIN_NUM_POINTS:
        return _Found(rings, np.nan, none, np.inf, f"fewer than {MIN_NUM_POINTS} points on the roof")
    guess = start.angle_deg if start is not None and start.has_mesh else None
    one = fitter.fit_whole(rings, point_m, Effort(), [] if guess is None else [guess])
    if one is None:
        return _Found(rings, np.nan, none, np.inf, "no roof found")
    if start is not None and guess is not None and start.eave_height_m is not None:
        before = OneHeight(rings, guess, start.eave_height_m + ground, np.inf, np.inf, len(point_m))
        if fitter.loss(before, point_m) < fitter.loss(one, point_m):
            one = before
    height = max(one.eave_z_m - ground, config.min_eave_height_m)
    return _Found(rings, height, one.angle_deg, one.top_m, "")
