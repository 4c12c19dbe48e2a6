"""The buildings of a scene as a picture of matplotlib: from above as a map, or obliquely."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from p2wss.formats.cityjson import SURFACE_TYPE
from p2wss.formats.viewer import FACE_COLORS
from p2wss.storage.messages import InputError

if TYPE_CHECKING:
    from p2wss.reconstruction.scene import SceneBuilding

_COLORS = {SURFACE_TYPE[kind]: FACE_COLORS[kind] for kind in reversed(SURFACE_TYPE)}


def plot(buildings: Iterable[SceneBuilding], view: str, axes: Any = None) -> Any:
    """See :meth:`p2wss.reconstruction.scene.Scene.plot`. Near buildings and faces are drawn over far ones."""
    if view not in ("plan", "oblique"):
        raise InputError(f"view: choose from plan, oblique, not {view!r}")
    from matplotlib import pyplot
    from matplotlib.collections import PathCollection
    from matplotlib.colors import to_rgb
    from matplotlib.path import Path

    # unit vectors to the right, upwards in the picture, and towards the eye, which is south-west in an oblique view
    aside, above = np.radians((0, 90) if view == "plan" else (35, 40))
    right = np.array([np.cos(aside), -np.sin(aside), 0])
    eye = np.array([-np.sin(aside) * np.cos(above), -np.cos(aside) * np.cos(above), np.sin(above)])
    turn, sun = np.array([right, np.cross(eye, right), eye]), np.array([-0.35, -0.6, 0.72])
    drawn: list[tuple[float, float, Any, Any]] = []
    for building in buildings:
        if building.solid is None and building.footprint is not None:
            shape = shapely.force_3d(building.footprint, 0.0)
            rings = [shapely.get_coordinates(each, include_z=True) for each in shapely.get_rings(shape)]
            drawn.append((-np.inf, 0.0, rings, (0, 0, 0, 0)))
        for surface in building.surfaces:
            if surface.normal @ turn[2] < 1e-6:
                continue
            assert building.solid is not None
            light = 0.6 + 0.4 * max(float(surface.normal @ sun), 0.0)
            color = (*(light * np.array(to_rgb(_COLORS[surface.kind]))), 1)
            depth, nearer = (
                turn[2] @ each.mean(axis=0) for each in (building.solid.vertex_m, surface.rings_m[0])
            )
            drawn.append((float(depth), float(nearer), surface.rings_m, color))
    drawn.sort(key=lambda each: each[:2])
    paths = [
        Path.make_compound_path(
            *(Path(np.vstack([ring, ring[:1]]) @ turn[:2].T, closed=True) for ring in rings)
        )
        for *_, rings, _ in drawn
    ]
    axes = pyplot.subplots(layout="constrained")[1] if axes is None else axes
    colors = [color for *_, color in drawn]
    axes.add_collection(PathCollection(paths, facecolors=colors, edgecolors="#222222", linewidths=0.4))
    axes.autoscale_view()
    axes.set_aspect("equal")
    if view == "plan":
        axes.ticklabel_format(useOffset=False, style="plain")
        axes.set(xlabel="x (m)", ylabel="y (m)")
    else:
        axes.set_axis_off()
    return axes
