"""A map of how footprints were moved to where a cloud shows the buildings: a part of a page, without scripts.

All text from the data is escaped by the template engine (``templates/shift_map.html.j2``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

# what was done with a block: the words in the table, the colour on the map, the line in the legend
MOVED, STAYED, UNKNOWN = "moved", "not moved", "no evidence"
LEGEND = {
    MOVED: ("#c0392b", "moved: the points show where the edges are, here or at all blocks around"),
    STAYED: ("#2e7d32", "not moved: the points confirm the position, or do not clearly show another"),
    UNKNOWN: ("#8a949b", "not moved: the points show no edges, here or around"),
}
# factors by which arrows are drawn longer: the largest with which the longest arrow has at most this share of the map
_FACTORS, _LONGEST_SHARE = (1, 2, 5, 10, 20, 50, 100), 0.08
# a scale bar has at most this share of the map; blocks in the table, those with the longest shifts first
_SCALE_SHARE, _MAX_ROWS = 0.25, 2000


@dataclass(frozen=True)
class Footprint:
    """A footprint on the map. block: name of its block. before, after: polygons in metres, as in the input and as used.
    flags: how the cloud contradicts it (:data:`p2wss.data.reasons.FLAGS`), with the areas that they are based on."""

    building_id: str
    block: str
    before: shapely.Polygon
    after: shapely.Polygon
    flags: tuple[str, ...] = ()
    ground_inside_m2: float = 0.0
    roof_outside_m2: float = 0.0


@dataclass(frozen=True)
class Block:
    """What was done with a block.

    action: a key of :data:`LEGEND`. shift_sd_m, overhang_m: None without evidence.
    """

    action: str
    shift_x_m: float
    shift_y_m: float
    shift_sd_m: float | None
    overhang_m: float | None


def content(crs: str, footprints: Sequence[Footprint], blocks: dict[str, Block]) -> dict[str, Any]:
    """What the template shows. crs: its name, for the caption. blocks: by their names."""
    shapes = [shape for footprint in footprints for shape in (footprint.before, footprint.after)]
    shapes = [shape for shape in shapes if not shape.is_empty]
    x_min, y_min, x_max, y_max = shapely.total_bounds(shapes) if shapes else (0.0, 0.0, 1.0, 1.0)
    margin_m = 0.03 * max(x_max - x_min, y_max - y_min) + 3
    frame = _Frame(x_min - margin_m, y_max + margin_m)
    width_m, height_m = x_max - x_min + 2 * margin_m, y_max - y_min + 2 * margin_m
    longest_m = max((np.hypot(block.shift_x_m, block.shift_y_m) for block in blocks.values()), default=0.0)
    factor = max(
        (each for each in _FACTORS if each * longest_m <= _LONGEST_SHARE * max(width_m, height_m)), default=1
    )
    members: dict[str, list[Footprint]] = {}
    for footprint in footprints:
        members.setdefault(footprint.block, []).append(footprint)
    rows = [
        _row(name, blocks[name], members[name], frame, factor) for name in sorted(members) if name in blocks
    ]
    rows.sort(key=lambda row: -row["length_m"])
    counts = {action: sum(row["action"] == action for row in rows) for action in LEGEND}
    return {
        "crs": crs,
        "width": f"{width_m:.2f}",
        "height": f"{height_m:.2f}",
        "footprints": [
            {
                "id": footprint.building_id,
                "before": frame.path(footprint.before) if blocks[footprint.block].action == MOVED else "",
                "after": frame.path(footprint.after),
                "color": LEGEND[blocks[footprint.block].action][0],
                "is_flagged": bool(footprint.flags),
            }
            for footprint in footprints
            if footprint.block in blocks
        ],
        "rows": rows[:_MAX_ROWS],
        "num_more": max(len(rows) - _MAX_ROWS, 0),
        "arrows": [row for row in rows if row["arrow"]],
        "flagged": [footprint for footprint in footprints if footprint.flags],
        "legend": [(color, text, counts[action]) for action, (color, text) in LEGEND.items()],
        "colors": {color: number for number, (color, _) in enumerate(LEGEND.values())},
        "factor": factor,
        "scale_m": _scale_m(width_m),
        "bar": (f"{margin_m:.2f}", f"{margin_m + _scale_m(width_m):.2f}", f"{height_m - margin_m / 2:.2f}"),
    }


@dataclass(frozen=True)
class _Frame:
    """Metres to the right of x_min and below y_max, as SVG has them."""

    x_min: float
    y_max: float

    def point(self, xy_m: np.ndarray) -> tuple[str, str]:
        """x and y on the page of a point (2,), as text."""
        return f"{xy_m[0] - self.x_min:.2f}", f"{self.y_max - xy_m[1]:.2f}"

    def path(self, shape: shapely.Polygon) -> str:
        """The path of a polygon with its courtyards, as SVG has it."""
        rings = [np.asarray(ring.coords)[:-1] for ring in shapely.get_rings(shape)]
        return "".join(
            "M" + "L".join(f"{x},{y}" for x, y in map(self.point, ring)) + "Z" for ring in rings if len(ring)
        )


def _row(name: str, block: Block, members: Sequence[Footprint], frame: _Frame, factor: int) -> dict[str, Any]:
    """The row of a block in the table, with the ends of its arrow: from where it was, ``factor`` times as long."""
    shift_m = np.array([block.shift_x_m, block.shift_y_m])
    length_m = float(np.hypot(*shift_m))
    bounds = shapely.total_bounds([footprint.before for footprint in members])
    arrow = None
    if length_m > 0 and np.isfinite(bounds).all():
        centre_m = (bounds[:2] + bounds[2:]) / 2
        arrow = (*frame.point(centre_m), *frame.point(centre_m + factor * shift_m))
    return vars(block) | {
        "name": name,
        "num_others": len(members) - 1,
        "length_m": length_m,
        "arrow": arrow,
        "color": LEGEND[block.action][0],
    }


def _scale_m(width_m: float) -> float:
    """The length of the scale bar: the longest of 1, 2, 5, 10, .. metres that fits on a map of this width."""
    most = _SCALE_SHARE * width_m
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(each * power for each in (1, 2, 5) if each * power <= most))
