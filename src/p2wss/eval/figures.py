"""Pictures for the report: training curves, distributions of errors, buildings over their points."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from p2wss.eval.cases import Case
from p2wss.inference import Reconstruction
from p2wss.metrics.surface import distance_to_mesh
from p2wss.skeleton.types import FaceKind

COLORS = {"point2wss": "#b4451f", "roofer": "#2a6f97", "lod1": "#6c757d", "constant": "#b8a13c"}
FACE_COLORS = {
    FaceKind.GROUND: "#9a9a9a",
    FaceKind.WALL: "#e8dfd0",
    FaceKind.ROOF: "#c8603a",
    FaceKind.FLAT: "#d9a06b",
}
_MAX_POINTS_SHOWN = 1200


def data_uri(figure: Figure, dots_per_inch: int = 110) -> str:
    """The figure as a ``data:`` address of a PNG; closes it."""
    buffer = BytesIO()
    # no date and no version among the metadata: the same figure has the same bytes
    figure.savefig(buffer, format="png", dpi=dots_per_inch, metadata={"Software": None})
    plt.close(figure)
    return png_uri(buffer.getvalue())


def png_uri(content: bytes) -> str:
    """A PNG as a ``data:`` address."""
    return "data:image/png;base64," + base64.b64encode(content).decode()


def curves(series: Mapping[str, tuple[Sequence[float], Sequence[float]]], x_label: str, title: str) -> Figure:
    """Lines of (x, y) by name, one panel, logarithmic where all values are positive and span a decade."""
    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    for name, (x, y) in series.items():
        axes.plot(x, y, label=name, linewidth=1.4, marker="o" if len(x) < 30 else "", markersize=3)
    values = np.concatenate([np.asarray(y, float) for _, y in series.values()] or [np.ones(1)])
    values = values[np.isfinite(values)]
    if len(values) and values.min() > 0 and values.max() / values.min() > 10:
        axes.set_yscale("log")
    axes.set_xlabel(x_label)
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def cumulative(values: dict[str, np.ndarray], x_label: str, title: str) -> Figure:
    """Share of buildings with at most x, one line per method."""
    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    for name, sample in values.items():
        ordered = np.sort(sample[np.isfinite(sample)])
        if len(ordered):
            share = np.arange(1, len(ordered) + 1) / len(ordered)
            axes.step(ordered, share, where="post", label=name, color=COLORS.get(name))
    top = [np.nanquantile(sample, 0.98) for sample in values.values() if np.isfinite(sample).any()]
    axes.set_xlim(0, max(top, default=1.0) or 1.0)
    axes.set_ylim(0, 1)
    axes.set_xlabel(x_label)
    axes.set_ylabel("share of buildings")
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def building(case: Case, reconstructions: Sequence[tuple[str, Reconstruction]]) -> Figure:
    """One panel per (title, reconstruction): the mesh and the building's points from the south-west.

    Parallel projection. A point's colour is its distance to the mesh, from blue to red at 1 m and more;
    points behind a face are pale. All panels have the same scale.
    """
    panels = max(len(reconstructions), 1)
    figure, row = plt.subplots(1, panels, figsize=(3.2 * panels, 3.0), squeeze=False, layout="constrained")
    reach = [_draw(axes, case, made) for axes, (_, made) in zip(row[0], reconstructions, strict=False)]
    low, high = np.min([r[0] for r in reach], axis=0), np.max([r[1] for r in reach], axis=0)
    for axes, (title, _) in zip(row[0], reconstructions, strict=False):
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_title(title, fontsize=8.5)
        axes.set_axis_off()
    return figure


# rows: to the right, upwards, towards the eye, for an eye in the south-west, 32 degrees above the horizon
_TURN, _TILT = np.deg2rad(-35.0), np.deg2rad(32.0)
_VIEW = np.array(
    [
        [np.cos(_TURN), np.sin(_TURN), 0],
        [-np.sin(_TURN) * np.sin(_TILT), np.cos(_TURN) * np.sin(_TILT), np.cos(_TILT)],
        [np.sin(_TURN) * np.cos(_TILT), -np.cos(_TURN) * np.cos(_TILT), np.sin(_TILT)],
    ]
)
_LIGHT = np.array([-0.35, -0.6, 0.72])
_BEHIND_M = 0.3


def _draw(axes: Any, case: Case, made: Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    """Draw one panel; returns its least and greatest corner."""
    shift = np.subtract(case.building.origin_xy_m, made.origin_xy_m)
    point_m = case.building.point_m + np.array([*shift, -made.ground_z_m])
    point_m = point_m[:: max(len(point_m) // _MAX_POINTS_SHOWN, 1)]
    dots = point_m @ _VIEW.T
    corner_m = made.vertex_m @ _VIEW.T
    distance = np.clip(distance_to_mesh(point_m, made.vertex_m, made.triangle), 0, 1)
    faces = made.vertex_m[made.triangle]
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    front = np.flatnonzero(normal @ _VIEW[2] > 1e-6)
    order = front[np.argsort(corner_m[made.triangle[front], 2].mean(axis=1))]
    creases = _creases(made.triangle, normal)
    for rank, t in enumerate(order):
        color = np.array(to_rgb(FACE_COLORS[FaceKind(int(made.kind[t]))]))
        color = color * (0.65 + 0.35 * max(float(normal[t] @ _LIGHT), 0.0))
        seen = corner_m[made.triangle[t], :2]
        axes.fill(*seen.T, facecolor=color, edgecolor=color, linewidth=0.4, zorder=2 + rank)
        for i in range(3):
            if tuple(sorted((int(made.triangle[t, i]), int(made.triangle[t, (i + 1) % 3])))) in creases:
                ends = seen[[i, (i + 1) % 3]].T
                axes.plot(*ends, color="#222222", linewidth=0.8, zorder=2 + rank, solid_capstyle="round")
    hidden = _hidden(dots, corner_m[made.triangle[front]])
    for chosen, alpha in ((hidden, 0.3), (~hidden, 1.0)):
        x, y = dots[chosen, :2].T
        color = colormaps["turbo"](distance[chosen])
        axes.scatter(x, y, s=2.2, color=color, alpha=alpha, linewidths=0, zorder=3 + len(order))
    everything = np.concatenate([dots, corner_m])[:, :2]
    return everything.min(axis=0), everything.max(axis=0)


def _hidden(dots: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Which points (n, 3) lie behind one of the triangles (t, 3, 3), all in the frame of the view."""
    hidden = np.zeros(len(dots), bool)
    for a, b, c in triangles:
        u, v, w = b[:2] - a[:2], c[:2] - a[:2], dots[:, :2] - a[:2]
        area = u[0] * v[1] - u[1] * v[0]
        if abs(area) > 1e-9:
            s = (w[:, 0] * v[1] - w[:, 1] * v[0]) / area
            t = (u[0] * w[:, 1] - u[1] * w[:, 0]) / area
            depth = a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2])
            hidden |= (s >= 0) & (t >= 0) & (s + t <= 1) & (dots[:, 2] < depth - _BEHIND_M)
    return hidden


def _creases(triangle: np.ndarray, normal: np.ndarray) -> set[tuple[int, ...]]:
    """Edges between triangles of different planes, as sorted pairs of vertices."""
    sides: dict[tuple[int, ...], list[int]] = {}
    for t, corners in enumerate(triangle.tolist()):
        for i in range(3):
            sides.setdefault(tuple(sorted((corners[i], corners[(i + 1) % 3]))), []).append(t)
    return {
        edge for edge, pair in sides.items() if len(pair) != 2 or normal[pair[0]] @ normal[pair[1]] < 0.9999
    }
