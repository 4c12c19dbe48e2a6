"""The page of a run that maps how its footprints were moved (:mod:`p2wss.formats.shift_map`)."""

from __future__ import annotations

from collections.abc import Sequence

import pyproj
import shapely

from p2wss.data.crs import horizontal
from p2wss.formats import shift_map
from p2wss.formats.shift_map import Block, Footprint
from p2wss.reconstruct.registration import NOTHING, Registration
from p2wss.reconstruct.registration import summary as registration_summary
from p2wss.reconstruct.result import Result, summary


def shift_page(results: Sequence[Result], stem: str, crs: pyproj.CRS) -> str:
    """The HTML of the page. stem: of the names of the files of the run."""
    footprints, blocks = [], {}
    rows: list[Registration] = []
    for result in results:
        row, reconstruction = result.registration, result.reconstruction
        if row is None:
            continue
        rows.append(row)
        rings = [ring + reconstruction.origin_xy_m for ring in reconstruction.rings]
        if not row.block or not rings:
            continue
        used = shapely.Polygon(rings[0], rings[1:])
        evidence = (row.flags, row.ground_inside_m2, row.roof_outside_m2)
        footprints.append(
            Footprint(reconstruction.building_id, row.block, row.input_polygon, used, *evidence)
        )
        blocks[row.block] = Block(_action(row), *row.shift_m, row.shift_sd_m, row.overhang_m)
    text = (
        registration_summary(rows)
        if rows
        else "registration: off, or the cloud has no points of class building"
    )
    return shift_map.page(stem, horizontal(crs).name, [summary(results), text], footprints, blocks)


def _action(row: Registration) -> str:
    if row.source == NOTHING:
        return shift_map.UNKNOWN
    if row.shift_m == (0.0, 0.0):
        return shift_map.STAYED
    return shift_map.MOVED
