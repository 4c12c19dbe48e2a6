"""Pictures of a simulated scan: the same window by building and by strip."""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from p2wss.scans.returns import Points
from p2wss.scans.surface import CLUTTER_KIND, is_tree

_WINDOW_M = 70.0
_MAX_POINTS = 120_000
_ELEVATION = np.radians(40.0)  # of the viewpoint above the horizon, in the south
# the colours of matplotlib's tab20 without green, red and grey, which have a meaning here
_TAB20 = [0, 1, 2, 3, 8, 9, 10, 11, 12, 13, 16, 17, 18, 19]
GROUND_COLOR, TREE_COLOR, CLUTTER_COLOR = "#b9b4a8", "#6f9a4c", "#c23b22"


def scan_figure(points: Points, middle_m: np.ndarray) -> Figure:
    """Two panels of the points within 35 m of ``middle_m`` (2,), in the local frame, seen from the south.

    By building: each has a colour; the ground is grey, trees are green, other clutter is red. By strip: each has a
    colour.
    """
    near = np.abs(points.xyz_mm[:, :2] / 1000 - middle_m).max(axis=1) < _WINDOW_M / 2
    rows = np.flatnonzero(near)
    if len(rows) > _MAX_POINTS:
        rows = rows[:: len(rows) // _MAX_POINTS + 1]
    xyz = points.xyz_mm[rows] / 1000
    u, v = xyz[:, 0], xyz[:, 1] * np.sin(_ELEVATION) + xyz[:, 2] * np.cos(_ELEVATION)
    order = np.argsort(
        -xyz[:, 1] + 0.01 * xyz[:, 2], kind="stable"
    )  # what is near the viewpoint is drawn last
    rows, u, v = rows[order], u[order], v[order]

    figure = Figure(figsize=(10, 5.4), layout="constrained")
    strip = points.strip[rows]
    panels: tuple[tuple[str, np.ndarray, dict[str, Any]], ...] = (
        ("by building", _by_building(points, rows), {"clutter": CLUTTER_COLOR, "trees": TREE_COLOR}),
        ("by strip", _by_number(strip), {f"strip {n}": _by_number(n) for n in np.unique(strip)}),
    )
    for axes, (title, color, legend) in zip(figure.subplots(1, 2), panels, strict=True):
        axes.scatter(u, v, c=color, s=1.2, linewidths=0)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(title, fontsize=10)
        dots = [Line2D([], [], linestyle="", marker="o", markersize=4, color=c) for c in legend.values()]
        axes.legend(
            dots,
            list(legend),
            loc="upper center",
            bbox_to_anchor=(0.5, 0),
            ncols=4,
            fontsize=8,
            frameon=False,
        )
    return figure


def densest_place(points: Points, cell_m: float = 50.0) -> np.ndarray:
    """Middle of the cell with most buildings, float64 (2,) in the local frame; zero without a building."""
    on_building = points.building >= 0
    cell = np.floor(points.xyz_mm[on_building, :2] / (1000 * cell_m)).astype(np.int64)
    pairs = np.unique(np.column_stack([cell, points.building[on_building]]), axis=0)[:, :2]
    if not len(pairs):
        return np.zeros(2)
    cells, counts = np.unique(pairs, axis=0, return_counts=True)
    return np.asarray((cells[counts.argmax()] + 0.5) * cell_m)


def _by_building(points: Points, rows: np.ndarray) -> np.ndarray:
    palette = colormaps["tab20"](_TAB20)[:, :3]
    face, building = points.face[rows], points.building[rows]
    color = palette[(building * 5) % len(palette)]
    color[(face >= 0) & (face & 3 == CLUTTER_KIND)] = to_rgb(CLUTTER_COLOR)
    color[face < 0] = to_rgb(GROUND_COLOR)
    color[is_tree(face)] = to_rgb(TREE_COLOR)
    return color


def _by_number(number: np.ndarray | int) -> np.ndarray:
    palette = colormaps["Dark2"](np.arange(8))[:, :3]
    return np.asarray(palette[np.asarray(number).astype(int) % len(palette)])
