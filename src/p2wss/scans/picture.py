"""Pictures of a simulated scan: the same window by building, by strip and by return."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from p2wss.scans.returns import Points
from p2wss.scans.surface import THING_KIND, is_tree

_WINDOW_M = 70.0
_MAX_POINTS = 120_000
_RAISE = np.radians(40.0)  # of the eye above the horizon, in the south
# of matplotlib's tab20 what is not green, red or grey, which mean something here
_TAB20 = [0, 1, 2, 3, 8, 9, 10, 11, 12, 13, 16, 17, 18, 19]
GROUND_COLOR, TREE_COLOR, THING_COLOR = "#b9b4a8", "#6f9a4c", "#c23b22"


def scan_figure(points: Points, middle_m: np.ndarray) -> Figure:
    """Three panels of the points within 35 m of ``middle_m`` (2,), in the local frame, seen from the south.

    By building: each has a colour, ground is grey, trees are green, what is no part of a label is red.
    """
    near = np.abs(points.xyz_mm[:, :2] / 1000 - middle_m).max(axis=1) < _WINDOW_M / 2
    own = np.flatnonzero(near)
    if len(own) > _MAX_POINTS:
        own = own[:: len(own) // _MAX_POINTS + 1]
    xyz = points.xyz_mm[own] / 1000
    u, v = xyz[:, 0], xyz[:, 1] * np.sin(_RAISE) + xyz[:, 2] * np.cos(_RAISE)
    order = np.argsort(-xyz[:, 1] + 0.01 * xyz[:, 2], kind="stable")  # what is near the eye is drawn last
    own, u, v = own[order], u[order], v[order]

    figure = Figure(figsize=(15, 5.4), layout="constrained")
    strip, number = points.strip[own], points.return_number[own]
    panels: tuple[tuple[str, np.ndarray, dict[str, Any]], ...] = (
        ("by building", _by_building(points, own), {"in no label": THING_COLOR, "trees": TREE_COLOR}),
        ("by strip", _by_number(strip), {f"strip {n}": _by_number(n) for n in np.unique(strip)}),
        ("by return", _by_number(number - 1), {f"return {n}": _by_number(n - 1) for n in np.unique(number)}),
    )
    for axes, (title, color, legend) in zip(figure.subplots(1, 3), panels, strict=True):
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


def _by_building(points: Points, own: np.ndarray) -> np.ndarray:
    palette = colormaps["tab20"](_TAB20)[:, :3]
    face, building = points.face[own], points.building[own]
    color = palette[(building * 5) % len(palette)]
    color[(face >= 0) & (face & 3 == THING_KIND)] = _rgb(THING_COLOR)
    color[face < 0] = _rgb(GROUND_COLOR)
    color[is_tree(face)] = _rgb(TREE_COLOR)
    return color


def _by_number(number: np.ndarray | int) -> np.ndarray:
    palette = colormaps["Dark2"](np.arange(8))[:, :3]
    color: np.ndarray = palette[np.asarray(number).astype(int) % len(palette)]
    return color


def _rgb(color: str) -> tuple[float, ...]:
    return tuple(int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
