"""Pictures for the report: training curves, distributions of errors, buildings over their points."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from io import BytesIO

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from p2wss.eval.cases import Case
from p2wss.inference import Reconstruction
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
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def curves(series: Mapping[str, tuple[Sequence[float], Sequence[float]]], x_label: str, title: str) -> Figure:
    """Lines of (x, y) by name, one panel, logarithmic where all values are positive and span a decade."""
    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    for name, (x, y) in series.items():
        axes.plot(x, y, label=name, linewidth=1.4)
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
            axes.step(
                ordered, np.arange(1, len(ordered) + 1) / len(ordered), label=name, color=COLORS.get(name)
            )
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
    """One panel per (title, reconstruction): the mesh and the building's points, seen from the south-west."""
    panels = max(len(reconstructions), 1)
    figure = plt.figure(figsize=(3.1 * panels, 3.0))
    for i, (title, reconstruction) in enumerate(reconstructions):
        axes = figure.add_axes((i / panels, 0.0, 1 / panels, 0.92), projection="3d", computed_zorder=False)
        _draw(axes, case, reconstruction)
        figure.text((i + 0.5) / panels, 0.95, title, ha="center", va="top", fontsize=8.5)
    return figure


def _draw(axes: object, case: Case, reconstruction: Reconstruction) -> None:
    shift = np.subtract(case.building.origin_xy_m, reconstruction.origin_xy_m)
    point_m = case.building.point_m + np.array([*shift, -reconstruction.ground_z_m])
    point_m = point_m[:: max(len(point_m) // _MAX_POINTS_SHOWN, 1)]
    everything = point_m
    if reconstruction.has_mesh:
        everything = np.concatenate([point_m, reconstruction.vertex_m])
        faces = reconstruction.vertex_m[reconstruction.triangle]
        mesh = Poly3DCollection(
            faces, facecolors=_shaded(faces, reconstruction.kind), edgecolors="none", alpha=0.85, zorder=1
        )
        axes.add_collection3d(mesh)  # type: ignore[attr-defined]
        for start, end in _creases(reconstruction):
            line = reconstruction.vertex_m[[start, end]].T
            axes.plot(*line, color="#222222", linewidth=0.8, zorder=2)  # type: ignore[attr-defined]
    axes.scatter(  # type: ignore[attr-defined]
        *point_m.T, s=1.2, c="#123f6b", alpha=0.55, linewidths=0, zorder=3, depthshade=False
    )
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle, half = (low + high) / 2, max((high - low).max() / 2, 1.0)
    axes.set(  # type: ignore[attr-defined]
        xlim=(middle[0] - half, middle[0] + half),
        ylim=(middle[1] - half, middle[1] + half),
        zlim=(middle[2] - half, middle[2] + half),
    )
    axes.set_box_aspect((1, 1, 1), zoom=1.55)  # type: ignore[attr-defined]
    axes.view_init(elev=28, azim=-125)  # type: ignore[attr-defined]
    axes.set_axis_off()  # type: ignore[attr-defined]


def _shaded(faces: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Colour of each triangle's kind under a light from the south-west."""
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = np.clip(normal @ (np.array([-0.4, -0.55, 0.73])), 0, 1)
    base = np.array([matplotlib.colors.to_rgb(FACE_COLORS[FaceKind(int(k))]) for k in kind])
    return base * (0.62 + 0.38 * light[:, None])


def _creases(reconstruction: Reconstruction) -> list[tuple[int, int]]:
    """Edges between triangles of different planes."""
    normals: dict[tuple[int, int], list[np.ndarray]] = {}
    for triangle in reconstruction.triangle:
        a, b, c = reconstruction.vertex_m[triangle]
        normal = np.cross(b - a, c - a)
        normal /= max(float(np.linalg.norm(normal)), 1e-12)
        for i in range(3):
            start, end = sorted((int(triangle[i]), int(triangle[(i + 1) % 3])))
            normals.setdefault((start, end), []).append(normal)
    return [edge for edge, sides in normals.items() if len(sides) != 2 or sides[0] @ sides[1] < 0.9999]
