"""What a run would understand of clouds, footprints and terrain, told before an hour of computing."""

import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely

from p2wss.config import Config
from p2wss.data.crs import ground_scales
from p2wss.data.las_classes import class_set
from p2wss.data.points import stride
from p2wss.footprints import overlaps, vector_files
from p2wss.reconstruction.area import Area, cleaned, read_features
from p2wss.reconstruction.inputs import Inputs
from p2wss.reconstruction.outputs import exports
from p2wss.reconstruction.points import plausibility, unclassified
from p2wss.reconstruction.points.cloud_index import CloudIndex
from p2wss.storage.features import Features
from p2wss.storage.las_crs import horizontal, vertical_part
from p2wss.storage.messages import InputError, log

# points of at most this many footprints are read; the checks of plausibility use the same footprints
NUM_SAMPLED = 200


def look(inputs: Inputs, config: Config) -> tuple[dict[str, Any], str]:
    """(facts by name, with rounded numbers and lengths in metres; why a run would be refused, or "").

    Only the points of up to :data:`NUM_SAMPLED` footprints, spread over the file, are used; of COPC files, no others
    are read.
    """
    settings = config.reconstruct
    features = cleaned(read_features(inputs, settings), config)
    facts = {
        "crs": _crs(inputs, settings.height_unit),
        "footprints": _footprints(inputs, features, settings.footprint_layer),
    }
    rows = np.flatnonzero(~shapely.is_empty(features.geometry))
    is_sampled = np.zeros(len(features), bool)
    is_sampled[rows[:: stride(len(rows), NUM_SAMPLED)] if len(rows) else rows] = True
    area, terrain = (
        Area(features, is_sampled, settings),
        None if inputs.terrain is None else inputs.terrain[0],
    )
    counts = np.zeros(256, np.int64)
    problem = ""
    with CloudIndex(area.boxes, Path(tempfile.gettempdir())) as points:
        if is_sampled.any():
            for chunk in inputs.chunks(points.bounds, class_set(**config.region.classes.model_dump())):
                points.append(chunk)
                counts += np.bincount(chunk.classification, minlength=256)
            points.drop_repeated()
        for warning in unclassified.warnings(*area.missing_classes(points)):
            log.warning("warning: %s", warning)
        sampled = features.take(is_sampled)
        sample = plausibility.sample_of(sampled, points, terrain, NUM_SAMPLED)
    facts["points"] = _points(inputs, sample, counts)
    facts["heights"] = _heights(sample)
    if inputs.terrain is not None:
        facts["terrain"] = _terrain(inputs, sample)
    try:
        if not is_sampled.any() or not (sample.num_points > 0).any():
            raise InputError(f"{inputs.footprints_name}: no point is on the footprints that were looked at")
        if inputs.terrain is not None:
            exports.check_coverage(*inputs.terrain, sampled)
        plausibility.check(sample, inputs, settings.height_unit, settings.terrain_unit)
    except InputError as error:
        problem = str(error)
    return facts, problem


def _crs(inputs: Inputs, height_unit: str) -> dict[str, Any]:
    metric, header = inputs.metric, inputs.headers[0]
    facts: dict[str, Any] = {
        "of clouds": f"{metric.source.name}, {'stated' if header.crs is not None else 'not stated by the file'}",
        "of the run and of outputs": metric.crs.name,
        "unit of x and y of clouds": horizontal(metric.source).axis_info[0].unit_name,
    }
    is_stated = bool(height_unit) or vertical_part(metric.source) is not None
    facts["unit of heights of clouds"] = f"{metric.vertical_m:.7g} m, {'stated' if is_stated else 'assumed'}"
    if header.bounds is not None and metric.source.is_projected:
        scales = ground_scales(metric.source, header.bounds)
        if scales is not None:
            lengths = " to ".join(sorted({f"{each:.5f}" for each in scales}))
            facts["length of a metre on the ground in that CRS"] = f"{lengths} m"
    return facts


def _footprints(inputs: Inputs, features: Features, layer: str) -> dict[str, Any]:
    facts: dict[str, Any] = {}
    if isinstance(inputs.footprints, Path):
        info = vector_files.layer_info(inputs.footprints, layer)
        facts |= {"layer": info["layer"], "other layers": info["other_layers"]}
        # some formats do not state the number of features
        facts |= {"features": info["features"]} if info["features"] >= 0 else {}
        facts["crs"] = (
            None if info["crs"] is None else horizontal(pyproj.CRS.from_user_input(info["crs"])).name
        )
    facts["buildings by status"] = dict(Counter(features["status"].tolist()).most_common())
    if overlaps.COLUMN in features.columns:
        facts["overlapping others"] = sum(each is not None for each in features[overlaps.COLUMN].tolist())
    area_m2 = shapely.area(features.geometry)
    if (area_m2 > 0).any():
        facts["median area, m2"] = round(float(np.median(area_m2[area_m2 > 0])), 1)
    facts["with a stated height"] = int(np.isfinite(features["stated_height_m"]).sum())
    return facts


def _points(inputs: Inputs, sample: plausibility.Sample, counts: np.ndarray) -> dict[str, Any]:
    has_points = sample.num_points > 0
    facts: dict[str, Any] = {
        "files": len(inputs.headers),
        "points": sum(each.num_points for each in inputs.headers),
        "read, by class": {int(number): int(counts[number]) for number in np.flatnonzero(counts)},
        "footprints looked at": len(has_points),
        "of these with points": int(has_points.sum()),
    }
    if has_points.any():
        per_m2 = sample.num_points[has_points] / sample.width_m[has_points] ** 2
        low, middle, high = np.quantile(per_m2, [0.05, 0.5, 0.95])
        facts["points per m2 on footprints, median"] = round(float(middle), 2)
        facts["points per m2 on footprints, 5 % to 95 %"] = f"{low:.2f} to {high:.2f}"
    return facts


def _heights(sample: plausibility.Sample) -> dict[str, Any]:
    ratio = sample.height_m / sample.stated_height_m
    values = {
        "ground, median, m": sample.ground_z_m,
        "roofs above the ground, median, m": sample.height_m,
        "roofs by stated heights, median ratio": ratio,
    }
    known = {name: value[np.isfinite(value)] for name, value in values.items()}
    return {name: round(float(np.median(value)), 2) for name, value in known.items() if len(value)}


def _terrain(inputs: Inputs, sample: plausibility.Sample) -> dict[str, Any]:
    assert inputs.terrain is not None
    terrain, gap_m = inputs.terrain[0], sample.gap_m
    facts: dict[str, Any] = {
        "cell, m": round(terrain.cell_m, 3),
        "cells with data": f"{np.isfinite(terrain.height_m).mean():.1%}",
    }
    facts["footprints looked at that have a height"] = int(np.isfinite(sample.terrain_z_m).sum())
    if len(gap_m):
        facts["above the ground of the points, median, m"] = round(float(np.median(gap_m)), 2)
        facts["largest difference, m"] = round(float(np.abs(gap_m).max()), 2)
    return facts
