"""Draws the pictures of docs/methods/skeleton.md: ``python docs/img/skeleton.py``."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from p2wss.mesh import Mesh
from p2wss.skeleton import FaceKind, Polygons, build

RECTANGLE = np.array([[0, 0], [10, 0], [10, 6], [0, 6]], float)
L_SHAPE = np.array([[0, 0], [10, 0], [10, 4], [4, 4], [4, 10], [0, 10]], float)
STEP = np.array([[0, 0], [10, 0], [10, 7], [5, 7], [5, 6], [0, 6]], float)
SQUARE = np.array([[0, 0], [10, 0], [10, 10], [0, 10]], float)
COURTYARD = np.array([[3, 3], [3, 7], [7, 7], [7, 3]], float)
COLOUR = {
    FaceKind.WALL: "#e8dfc8",
    FaceKind.ROOF: "#c8553d",
    FaceKind.FLAT: "#8a9ba8",
}

# picture: panels of (title, rings, angle per edge, maximum roof height)
PICTURES = {
    "speed": [
        ("30° all round: speed cot 30° = 1.7", [RECTANGLE], [30] * 4, np.inf),
        ("60° on the long sides: speed 0.6", [RECTANGLE], [60, 30, 60, 30], np.inf),
    ],
    "gable": [
        ("two ends 90°: a gable roof", [RECTANGLE], [40, 90, 40, 90], np.inf),
        ("one end 90°", [RECTANGLE], [40, 90, 40, 40], np.inf),
        ("three edges 90°: a shed", [RECTANGLE], [25, 90, 90, 90], np.inf),
    ],
    "flat": [
        ("one long edge 0°: all flat", [L_SHAPE], [0, 40, 40, 40, 40, 40], np.inf),
        ("an inner edge 0°: one wing", [L_SHAPE], [40, 40, 0, 40, 40, 40], np.inf),
    ],
    "cap": [
        ("45° in the wing only: the rest is capped", [L_SHAPE], [90, 90, 45, 90, 90, 90], np.inf),
        ("90° everywhere: flat at the eave", [L_SHAPE], [90] * 6, np.inf),
    ],
    "max_height": [
        ("45°, no maximum", [RECTANGLE], [45] * 4, np.inf),
        ("max_roof_height_m=1.5", [RECTANGLE], [45] * 4, 1.5),
    ],
    "parallel": [
        ("30° catches up with 45°, goes on alone", [STEP], [40, 90, 30, 90, 45, 90], np.inf),
        ("45° and 30° never meet", [STEP], [40, 90, 45, 90, 30, 90], np.inf),
    ],
    "reflex": [
        ("90° beside the inner corner", [L_SHAPE], [40, 90, 90, 40, 90, 40], np.inf),
        ("40° there", [L_SHAPE], [40, 90, 40, 40, 90, 40], np.inf),
    ],
    "courtyard": [
        ("40° all round", [SQUARE, COURTYARD], [40] * 8, np.inf),
        ("courtyard 90°: the roof falls outwards", [SQUARE, COURTYARD], [40] * 4 + [90] * 4, np.inf),
    ],
}
_ELEVATION_DEG = 42
# pictures drawn from behind, where the edges that matter are
FROM_BEHIND = {"cap", "parallel", "reflex"}


def draw(
    axes, rings: list[np.ndarray], angle_deg: list[float], max_roof_height_m: float, azimuth: float
) -> None:
    """Draw one solid from above, with the angle beside every edge that faces the viewer."""
    vertex, *labelled_triangles = build(
        Polygons.from_rings([rings]),
        np.array(angle_deg, float),
        np.array([2.5]),
        max_roof_height_m=max_roof_height_m,
    ).mesh(0)
    elevation, turn = np.radians([_ELEVATION_DEG, azimuth])
    towards = np.array(
        [np.cos(elevation) * np.cos(turn), np.cos(elevation) * np.sin(turn), np.sin(elevation)]
    )
    light = np.array([-0.5, -0.7, 1.1]) / np.linalg.norm([-0.5, -0.7, 1.1])
    for face in Mesh(vertex, *labelled_triangles).surfaces:
        outer = vertex[face.rings[0]]
        normal = np.cross(outer, np.roll(outer, -1, 0)).sum(0)
        if normal @ towards <= 0:
            continue
        shade = 0.62 + 0.38 * max(0.0, float(normal @ light / np.linalg.norm(normal)))
        colour = np.array(matplotlib.colors.to_rgb(COLOUR[face.kind])) * shade
        for piece in triangles(outer, [vertex[ring] for ring in face.rings[1:]]):
            axes.add_collection3d(Poly3DCollection([piece], facecolor=colour, edgecolor=colour, lw=0.2))
        lines = [np.vstack([vertex[ring], vertex[ring[:1]]]) for ring in face.rings]
        axes.add_collection3d(Line3DCollection(lines, colors="#303030", lw=0.7))
    for ring, angles in zip(rings, np.split(np.array(angle_deg), [len(rings[0])]), strict=False):
        along = np.roll(ring, -1, 0) - ring
        outwards = np.stack([along[:, 1], -along[:, 0]], 1) / np.hypot(*along.T)[:, None]
        is_visible = outwards @ towards[:2] > 0
        for (x, y), angle in zip(
            (ring + along / 2 + 0.9 * outwards)[is_visible], angles[is_visible], strict=True
        ):
            axes.text(x, y, 0 if ring is rings[0] else 2.5, f"{angle:g}°", fontsize=6, ha="center")
    low, high = rings[0].min(0), rings[0].max(0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(0, vertex[:, 2].max()))
    axes.set_box_aspect([*(high - low), vertex[:, 2].max()], zoom=0.92)
    axes.view_init(elev=_ELEVATION_DEG, azim=azimuth)
    axes.set_axis_off()


def triangles(outer: np.ndarray, holes: list[np.ndarray]) -> list[np.ndarray]:
    """A plane face, cut into triangles if it has holes, which matplotlib cannot draw."""
    if not holes:
        return [outer]
    import mapbox_earcut

    points = np.concatenate([outer, *holes])
    ends = np.cumsum([len(outer), *map(len, holes)]).astype(np.uint32)
    index = mapbox_earcut.triangulate_float64(np.ascontiguousarray(points[:, :2]), ends)
    return list(points[index.reshape(-1, 3)])


def main() -> None:
    """Write one SVG per rule into the folder of this file."""
    plt.rcParams.update({"svg.hashsalt": "p2wss", "svg.fonttype": "none", "font.family": "sans-serif"})
    for name, panels in PICTURES.items():
        figure = plt.figure(figsize=(2.9 * len(panels), 2.4))
        for column, (title, *solid) in enumerate(panels):
            axes = figure.add_subplot(1, len(panels), column + 1, projection="3d", computed_zorder=True)
            draw(axes, *solid, azimuth=40 if name in FROM_BEHIND else -63)
            axes.set_title(title, fontsize=8, y=0.98)
        figure.subplots_adjust(0, 0, 1, 0.95, 0)
        figure.savefig(Path(__file__).with_name(f"skeleton_{name}.svg"), metadata={"Date": None})
        plt.close(figure)


if __name__ == "__main__":
    main()
