"""The 3D view of ``report.html``: a selection of buildings with points and meshes, and the scripts that draw them.

All of it is embedded in the page. Points are whole centimetres in int16 and vertices whole millimetres in int32,
in base64: about 20 kB per building.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib import colormaps

from p2wss.data.building import Reconstruction
from p2wss.eval.cases import Case
from p2wss.eval.figures import COLORS, FACE_COLORS
from p2wss.eval.reconstructions import Key
from p2wss.mesh.surface import distance_to_mesh

# buildings per data set beside the worst
NUM_MEDIAN = NUM_BEST = 5
MAX_POINTS = 4000
_OTHER_COLOR = "#3f7d4e"


class Viewer(NamedTuple):
    """The pieces of the page: the data as JSON, three.js, and the script that draws the data with it."""

    data: str
    library: str
    script: str


class View(NamedTuple):
    """A building to show: title of its group, key, and how far its points are from our mesh, NaN if unknown."""

    group: str
    key: Key
    points_to_mesh_m: float


def choices(ranked: pd.DataFrame, titles: Mapping[str, str], num_worst: int) -> list[View]:
    """The worst, median and best buildings of each data set, none twice.

    ranked: the measures of our best variant, the worst first. titles: of the data sets to show.
    """
    chosen: dict[Key, View] = {}
    for dataset, title in titles.items():
        rows = ranked[ranked["dataset"] == dataset]
        middle = max((len(rows) - NUM_MEDIAN) // 2, 0)
        groups = {
            "worst": rows[:num_worst],
            "median": rows[middle : middle + NUM_MEDIAN],
            "best": rows[::-1][:NUM_BEST],
        }
        for group, members in groups.items():
            columns = members[["tile", "building_id", "points_to_mesh_m"]]
            for tile, building_id, distance_m in columns.itertuples(index=False, name=None):
                key = (dataset, tile, building_id)
                chosen.setdefault(key, View(f"{title}: {group}", key, distance_m))
    return list(chosen.values())


def viewer(
    views: Sequence[View],
    cases: Mapping[Key, Case],
    reconstructions: Mapping[str, Mapping[Key, Reconstruction]],
    names: Mapping[str, str],
    ours: str,
) -> Viewer | None:
    """The view of the chosen buildings; None if there are none. names: of the methods to show."""
    if not views:
        return None
    data = {
        "palette": _base64((colormaps["turbo"](np.arange(256))[:, :3] * 255).round().astype(np.uint8)),
        "kinds": [FACE_COLORS[kind] for kind in sorted(FACE_COLORS)],
        "methods": [
            {"key": method, "name": name, "color": COLORS.get(method, _OTHER_COLOR), "ours": method == ours}
            for method, name in names.items()
        ],
        "buildings": [
            _building(
                view,
                cases[view.key],
                {
                    method: by_key[view.key]
                    for method in names
                    if view.key in (by_key := reconstructions[method])
                },
                ours,
            )
            for view in views
        ],
    }
    assets = files("p2wss.eval") / "assets"
    # "</script>" in a building's id must not end the element
    text = json.dumps(data, separators=(",", ":"), sort_keys=True).replace("<", "\\u003c")
    return Viewer(
        text, (assets / "three.min.js").read_text("utf-8"), (assets / "viewer.js").read_text("utf-8")
    )


def _building(
    view: View, case: Case, reconstructions: Mapping[str, Reconstruction], ours: str
) -> dict[str, Any]:
    """One building for the page, relative to its origin and to its ground."""
    building = case.building
    point_m = building.point_m
    point_m = point_m[:: max(-(-len(point_m) // MAX_POINTS), 1)]
    point_m = point_m[(np.abs(point_m) <= np.iinfo(np.int16).max // 100).all(axis=1)]
    meshes, reach, distance = {}, [point_m], np.zeros(len(point_m))
    for method, reconstruction in reconstructions.items():
        mesh = reconstruction.mesh
        if mesh is None:
            continue
        vertex_m = mesh.vertex_m + reconstruction.position_m - building.position_m
        reach.append(vertex_m)
        meshes[method] = {
            "vertices": _base64(np.round(vertex_m * 1000).astype(np.int32)),
            "triangles": _base64(mesh.triangle.astype(np.uint32)),
            "kinds": _base64(mesh.kind.astype(np.uint8)),
            "facts": f"{len(mesh.triangle)} triangles",
        }
        if method == ours:
            distance = np.clip(distance_to_mesh(point_m, vertex_m, mesh.triangle), 0, 1)
    corners = np.concatenate(reach) if any(map(len, reach)) else np.zeros((1, 3))
    score = "no mesh" if ours not in meshes else f"points {view.points_to_mesh_m:.2f} m"
    about = [f"Tile {building.tile}", f"{len(building.point_m)} points"]
    about += [f"{sum(map(len, building.rings))} vertices", *filter(None, [case.roof_type])]
    return {
        "id": building.building_id,
        "group": view.group,
        "title": f"{score}: {building.building_id}",
        "about": ", ".join(about),
        "bounds": np.round([corners.min(axis=0), corners.max(axis=0)], 2).tolist(),
        "points": _base64(np.round(point_m * 100).astype(np.int16)),
        "distances": _base64(np.round(distance * 255).astype(np.uint8)),
        "meshes": meshes,
    }


def _base64(values: np.ndarray) -> str:
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode()
