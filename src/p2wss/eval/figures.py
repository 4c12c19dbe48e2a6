"""Figures of the report: training curves, distributions of errors, buildings with their points."""

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
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from p2wss.data.building import Reconstruction
from p2wss.eval.cases import Case
from p2wss.eval.metrics.calibration import Bin
from p2wss.mesh.surface import distance_to_mesh
from p2wss.skeleton.types import FaceKind

# a $ in a name from the data is no formula
matplotlib.rcParams["text.parse_math"] = False

COLORS = {
    "point2wss": "#e0996f",
    "point2wss+fit": "#b4451f",
    "fit": "#7b5ea7",
    "roofer": "#2a6f97",
    "lod1": "#6c757d",
    "constant": "#b8a13c",
}
FACE_COLORS = {
    FaceKind.GROUND: "#9a9a9a",
    FaceKind.WALL: "#e8dfd0",
    FaceKind.ROOF: "#c8603a",
    FaceKind.FLAT: "#d9a06b",
    FaceKind.FLOOR: "#b5bd9c",
}
_MAX_DRAWN_POINTS = 1200
# of a curve of a distribution: a data set of many buildings has one point per value otherwise
_MAX_STEPS = 2000


def data_uri(figure: Figure, dots_per_inch: int = 110) -> str:
    """The figure as a ``data:`` URI of a PNG of 128 colours; closes the figure."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dots_per_inch)
    plt.close(figure)
    buffer.seek(0)
    small = BytesIO()
    # a third of the size, and no date or version in the metadata: equal figures have equal bytes
    Image.open(buffer).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(
        small, "png", optimize=True
    )
    return png_uri(small.getvalue())


def png_uri(content: bytes) -> str:
    """A PNG as a ``data:`` URI."""
    return "data:image/png;base64," + base64.b64encode(content).decode()


def curves(series: Mapping[str, tuple[Sequence[float], Sequence[float]]], x_label: str, title: str) -> Figure:
    """Lines of (x, y) by name in one panel; the y axis is logarithmic if all values are positive and span a decade."""
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


def cumulative(values: dict[str, np.ndarray], names: Mapping[str, str], x_label: str, title: str) -> Figure:
    """Share of buildings with at most x, one line per method. names: of the methods, for the legend."""
    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    for name, sample in values.items():
        ordered = np.sort(sample[np.isfinite(sample)])
        if len(ordered):
            share = np.arange(1, len(ordered) + 1) / len(ordered)
            if len(ordered) > _MAX_STEPS:
                chosen = np.linspace(0, len(ordered) - 1, _MAX_STEPS).astype(int)
                ordered, share = ordered[chosen], share[chosen]
            label = names.get(name, name)
            axes.step(ordered, share, where="post", label=label, color=COLORS.get(name))
    top = [np.nanquantile(sample, 0.98) for sample in values.values() if np.isfinite(sample).any()]
    axes.set_xlim(0, max(top, default=1.0) or 1.0)
    axes.set_ylim(0, 1)
    axes.set_xlabel(x_label)
    axes.set_ylabel("share of buildings")
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def reliability_diagram(bins: Mapping[str, Sequence[Bin]], names: Mapping[str, str], title: str) -> Figure:
    """Observed share of correct values over the stated confidence, one line per method.

    The area of a dot grows with the number of buildings in the bin. On the diagonal the confidence is calibrated.
    """
    figure, axes = plt.subplots(figsize=(5.2, 4.2), layout="constrained")
    axes.plot([0, 1], [0, 1], color="#999999", linewidth=1, linestyle="--")
    for method, of_method in bins.items():
        if of_method:
            stated, observed = [b.stated for b in of_method], [b.observed for b in of_method]
            color = COLORS.get(method)
            axes.plot(stated, observed, color=color, linewidth=1.2, label=names.get(method, method))
            most = max(b.count for b in of_method)
            axes.scatter(stated, observed, s=[8 + 60 * b.count / most for b in of_method], color=color)
    axes.set(xlim=(0, 1), ylim=(0, 1.02), aspect="equal")
    axes.set_xlabel("stated confidence")
    axes.set_ylabel("share within 0.5 m and 5°")
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")
    return figure


def building(case: Case, reconstructions: Sequence[tuple[str, Reconstruction]]) -> Figure:
    """The building's points alone, then one panel per (title, reconstruction) with the mesh and the points.

    Parallel projection from the south-west, two panels in a row, all at the same scale. In the first panel the
    colour of a point is its height, in the others its distance to the mesh, from blue (0) to red (1 m and more);
    points behind a face are pale.
    """
    num_panels = 1 + len(reconstructions)
    rows = -(-num_panels // 2)
    figure, grid = plt.subplots(rows, 2, figsize=(6.0, 2.75 * rows), squeeze=False, layout="constrained")
    panels = grid.ravel()
    extents = [_draw_points(panels[0], case)]
    extents += [
        _draw(axes, case, reconstruction)
        for axes, (_, reconstruction) in zip(panels[1:], reconstructions, strict=False)
    ]
    low, high = np.min([e[0] for e in extents], axis=0), np.max([e[1] for e in extents], axis=0)
    titles = [f"Points\n{len(case.building.point_m)}", *(title for title, _ in reconstructions)]
    for axes, title in zip(panels, titles, strict=False):
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_title(title, fontsize=9)
    for axes in panels:
        axes.set_axis_off()
    return figure


# rows: axes to the right, upwards and towards the viewer, who is south-west of it, 32 degrees above the horizon
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


def _drawn_points(case: Case, origin_xy_m: Sequence[float], ground_z_m: float) -> np.ndarray:
    """The points of the building to draw, every k-th, with x and y relative to an origin and z above a ground."""
    shift = np.subtract(case.building.origin_xy_m, origin_xy_m)
    point_m = case.building.point_m[:: -(-len(case.building.point_m) // _MAX_DRAWN_POINTS) or 1]
    return point_m + np.array([*shift, -ground_z_m])


def _draw_points(axes: Any, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Draw the points alone, coloured by height; returns the lower and upper corner of their extent."""
    point_m = _drawn_points(case, case.building.origin_xy_m, case.building.ground_z_m)
    if not len(point_m):
        return np.zeros(2), np.ones(2)
    dots = point_m @ _VIEW.T
    order = np.argsort(dots[:, 2])  # the nearest points are drawn last
    low, high = np.quantile(point_m[:, 2], [0.02, 0.98])
    color = colormaps["viridis"](np.clip((point_m[order, 2] - low) / max(high - low, 0.1), 0, 1))
    axes.scatter(*dots[order, :2].T, s=2.2, color=color, linewidths=0)
    return dots[:, :2].min(axis=0), dots[:, :2].max(axis=0)


def _draw(axes: Any, case: Case, reconstruction: Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    """Draw mesh and points; returns the lower and upper corner of their extent."""
    point_m = _drawn_points(case, reconstruction.origin_xy_m, reconstruction.ground_z_m)
    dots = point_m @ _VIEW.T
    mesh = reconstruction.mesh
    assert mesh is not None
    corner_m = mesh.vertex_m @ _VIEW.T
    distance = np.clip(distance_to_mesh(point_m, mesh.vertex_m, mesh.triangle), 0, 1)
    normal = mesh.doubled_m2 / np.maximum(np.linalg.norm(mesh.doubled_m2, axis=1, keepdims=True), 1e-12)
    front = np.flatnonzero(normal @ _VIEW[2] > 1e-6)
    order = front[np.argsort(corner_m[mesh.triangle[front], 2].mean(axis=1))]
    creases = _creases(mesh.triangle, normal)
    # painter's algorithm: each triangle is followed by its creases
    shapes, fills, lines, widths = [], [], [], []
    for t in order:
        light = 0.65 + 0.35 * max(float(normal[t] @ _LIGHT), 0.0)
        red, green, blue = (light * part for part in to_rgb(FACE_COLORS[FaceKind(int(mesh.kind[t]))]))
        outline = corner_m[mesh.triangle[t], :2]
        shapes.append(outline)
        fills.append((red, green, blue, 1.0))
        lines.append((red, green, blue, 1.0))
        widths.append(0.4)
        for i in range(3):
            if tuple(sorted((int(mesh.triangle[t, i]), int(mesh.triangle[t, (i + 1) % 3])))) in creases:
                shapes.append(outline[[i, (i + 1) % 3]])
                fills.append((0.0, 0.0, 0.0, 0.0))
                lines.append((0.13, 0.13, 0.13, 1.0))
                widths.append(0.8)
    axes.add_collection(
        PolyCollection(shapes, facecolors=fills, edgecolors=lines, linewidths=widths, zorder=2)
    )
    hidden = _hidden(dots, corner_m[mesh.triangle[front]])
    for chosen, alpha in ((hidden, 0.3), (~hidden, 1.0)):
        x, y = dots[chosen, :2].T
        color = colormaps["turbo"](distance[chosen])
        axes.scatter(x, y, s=2.2, color=color, alpha=alpha, linewidths=0, zorder=3)
    everything = np.concatenate([dots, corner_m])[:, :2]
    return everything.min(axis=0), everything.max(axis=0)


def _hidden(dots: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Mask of the points (n, 3) behind any of the triangles (t, 3, 3), all in the frame of the view."""
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
