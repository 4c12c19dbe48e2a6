"""A page that maps how footprints were moved to where a cloud shows the buildings: HTML without scripts, one file.

All text from the data is escaped by the template engine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jinja2
import numpy as np
import shapely

# what was done with a block: the word in the table, the colour on the map, the line in the legend
MOVED, MOVED_AS_NEIGHBOURS, STAYED, UNKNOWN = "moved", "moved as neighbours", "stayed", "no evidence"
LEGEND = {
    MOVED: ("#c0392b", "moved to where their own edges show them"),
    MOVED_AS_NEIGHBOURS: ("#8e44ad", "moved with those around, as their own evidence is weak"),
    STAYED: ("#2e7d32", "stayed: the points show them there, or not clearly elsewhere"),
    UNKNOWN: ("#8a949b", "stayed without evidence"),
}
# factors by which arrows are drawn longer: the largest with which the longest arrow has at most this share of the map
_FACTORS, _LONGEST_SHARE = (1, 2, 5, 10, 20, 50, 100), 0.08
# a scale bar has at most this share of the map; blocks in the table, those with the longest shifts first
_SCALE_SHARE, _MAX_ROWS = 0.25, 2000


@dataclass(frozen=True)
class Footprint:
    """A footprint on the map. block: name of its block. before, after: polygons in metres; ``after`` is used. flags:
    by which the cloud contradicts it, with the areas ground_inside_m2 and roof_outside_m2."""

    building_id: str
    block: str
    before: shapely.Polygon
    after: shapely.Polygon
    flags: tuple[str, ...] = ()
    ground_inside_m2: float = 0.0
    roof_outside_m2: float = 0.0


@dataclass(frozen=True)
class Block:
    """What was done with a block. action: a key of :data:`LEGEND`. shift_sd_m, overhang_m: None without evidence."""

    action: str
    shift_x_m: float
    shift_y_m: float
    shift_sd_m: float | None
    rotation_deg: float
    overhang_m: float | None


def page(
    title: str, crs: str, summary: Sequence[str], footprints: Sequence[Footprint], blocks: dict[str, Block]
) -> str:
    """The page. crs: its name, for the caption. summary: sentences above the map. blocks: by their names."""
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
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    return environment.from_string(_TEMPLATE).render(
        title=title,
        crs=crs,
        summary=summary,
        width=f"{width_m:.2f}",
        height=f"{height_m:.2f}",
        footprints=[
            {
                "id": footprint.building_id,
                "before": frame.path(footprint.before) if blocks[footprint.block].action in _MOVES else "",
                "after": frame.path(footprint.after),
                "color": LEGEND[blocks[footprint.block].action][0],
                "is_flagged": bool(footprint.flags),
            }
            for footprint in footprints
            if footprint.block in blocks
        ],
        rows=rows[:_MAX_ROWS],
        num_more=max(len(rows) - _MAX_ROWS, 0),
        arrows=[row for row in rows if row["arrow"]],
        flagged=[footprint for footprint in footprints if footprint.flags],
        legend=[(color, text, counts[action]) for action, (color, text) in LEGEND.items()],
        colors={color: number for number, (color, _) in enumerate(LEGEND.values())},
        factor=factor,
        scale_m=_scale_m(width_m),
        bar=(f"{margin_m:.2f}", f"{margin_m + _scale_m(width_m):.2f}", f"{height_m - margin_m / 2:.2f}"),
    )


_MOVES = (MOVED, MOVED_AS_NEIGHBOURS)


@dataclass(frozen=True)
class _Frame:
    """Metres to the right of x_min and below y_max, as SVG has them."""

    x_min: float
    y_max: float

    def point(self, xy_m: np.ndarray) -> tuple[str, str]:
        return f"{xy_m[0] - self.x_min:.2f}", f"{self.y_max - xy_m[1]:.2f}"

    def path(self, shape: shapely.Polygon) -> str:
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
    """The longest of 1, 2, 5, 10, .. metres that fits."""
    most = _SCALE_SHARE * width_m
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(each * power for each in (1, 2, 5) if each * power <= most))


_TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Footprints of {{ title }}</title>
<style>
body { margin: 0 auto; max-width: 68rem; padding: 1rem; color: #1d2429; background: #fff;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.5rem; line-height: 1.2; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
p { max-width: 46rem; margin: .4rem 0; } .note { color: #5b6770; font-size: .88rem; }
svg.map { display: block; width: 100%; max-height: 85vh; border: 1px solid #d8dde1; border-radius: .4rem; background: #fafbfb; }
ul.legend { list-style: none; padding: 0; margin: .6rem 0; font-size: .9rem; }
ul.legend svg { width: 1.3rem; height: .9rem; margin-right: .5rem; vertical-align: -.1rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #d8dde1; text-align: right; white-space: nowrap; }
th.text, td.text { text-align: left; } td.name { white-space: normal; overflow-wrap: anywhere; min-width: 8rem; }
thead th { border-bottom: 2px solid #5b6770; vertical-align: bottom; }
.dot { display: inline-block; width: .7rem; height: .7rem; border-radius: 50%; margin-right: .4rem; }
path, line { vector-effect: non-scaling-stroke; }
@media print { body { max-width: none; padding: 0; font-size: 10pt; } tr, svg { break-inside: avoid; } }
</style>
</head>
<body>
<h1>Footprints of {{ title }}: where they were moved</h1>
{% for sentence in summary %}
<p>{{ sentence }}</p>
{% endfor %}
<svg class="map" viewBox="0 0 {{ width }} {{ height }}" role="img" aria-label="Map of the footprints and their shifts">
<defs>
{% for color, number in colors.items() %}
<marker id="tip{{ number }}" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto" markerUnits="strokeWidth">
<path d="M0,0L10,5L0,10Z" fill="{{ color }}"/></marker>
{% endfor %}
</defs>
{% for footprint in footprints %}
{% if footprint.before %}<path d="{{ footprint.before }}" fill="none" stroke="#5b6770" stroke-width="1" stroke-dasharray="3 2"/>
{% endif %}
<path d="{{ footprint.after }}" fill="{{ footprint.color }}" fill-opacity="{{ ".45" if footprint.is_flagged else ".18" }}" fill-rule="evenodd" stroke="{{ footprint.color }}" stroke-width="1.2"><title>{{ footprint.id }}</title></path>
{% endfor %}
{% for row in arrows %}
<line x1="{{ row.arrow[0] }}" y1="{{ row.arrow[1] }}" x2="{{ row.arrow[2] }}" y2="{{ row.arrow[3] }}" stroke="{{ row.color }}" stroke-width="2.2" marker-end="url(#tip{{ colors[row.color] }})"><title>{{ row.name }}: {{ "%.2f" | format(row.length_m) }} m</title></line>
{% endfor %}
<line x1="{{ bar[0] }}" y1="{{ bar[2] }}" x2="{{ bar[1] }}" y2="{{ bar[2] }}" stroke="#1d2429" stroke-width="3"/>
</svg>
<p class="note">North is up; x and y in metres, {{ crs }}. The map is {{ "%.0f" | format(width | float) }} m wide and {{ "%.0f" | format(height | float) }} m high. Filled: footprints as they
are used, darker where the cloud contradicts them (below). Dashed: where the input had those that were moved. Arrows: the shift of a
block{% if factor > 1 %}, drawn {{ factor }} times as long{% endif %}. Bar: {{ "%g" | format(scale_m) }} m.</p>
<ul class="legend">
{% for color, text, count in legend %}
<li><svg viewBox="0 0 13 9" aria-hidden="true"><rect width="13" height="9" fill="{{ color }}"/></svg>{{ count }} {{ "block" if count == 1 else "blocks" }} {{ text }}</li>
{% endfor %}
</ul>

<h2>Blocks</h2>
<p class="note">A block is the footprints that share walls, named after the least of their ids. Shifts are those that were applied; the standard
deviation is that of the worse direction; the overhang is how far roofs reach beyond the footprint's edges.</p>
<div class="scroll"><table>
<thead><tr><th class="text">block</th><th>shift_x_m</th><th>shift_y_m</th><th>shift_sd_m</th><th>rotation_deg</th><th>overhang_m</th><th class="text">what</th></tr></thead>
<tbody>
{% for row in rows %}
<tr><td class="text name">{{ row.name }}{% if row.num_others %} and {{ row.num_others }} more{% endif %}</td><td>{{ "%.2f" | format(row.shift_x_m) }}</td><td>{{ "%.2f" | format(row.shift_y_m) }}</td><td>{% if row.shift_sd_m is none %}–{% else %}{{ "%.2f" | format(row.shift_sd_m) }}{% endif %}</td><td>{{ "%.2f" | format(row.rotation_deg) }}</td><td>{% if row.overhang_m is none %}–{% else %}{{ "%.2f" | format(row.overhang_m) }}{% endif %}</td><td class="text"><span class="dot" style="background:{{ row.color }}"></span>{{ row.action }}</td></tr>
{% endfor %}
</tbody>
</table></div>
{% if num_more %}<p class="note">{{ num_more }} more blocks with smaller shifts: see the table of buildings.</p>
{% endif %}
{% if flagged %}
<h2>Footprints that the cloud contradicts</h2>
<div class="scroll"><table>
<thead><tr><th class="text">building_id</th><th class="text">footprint_flags</th><th>ground_inside_m2</th><th>roof_outside_m2</th></tr></thead>
<tbody>
{% for footprint in flagged %}
<tr><td class="text name">{{ footprint.building_id }}</td><td class="text">{{ footprint.flags | join(" ") }}</td><td>{{ "%.0f" | format(footprint.ground_inside_m2) }}</td><td>{{ "%.0f" | format(footprint.roof_outside_m2) }}</td></tr>
{% endfor %}
</tbody>
</table></div>
{% endif %}
</body>
</html>
"""  # noqa: E501
