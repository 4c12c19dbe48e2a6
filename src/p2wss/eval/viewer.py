"""The 3D view of ``report.html``: a selection of buildings with points and meshes, and the scripts that draw them.

All of it is embedded in the page. Points are whole centimetres in int16 and vertices whole millimetres in int32,
in base64: about 20 kB per building.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib import colormaps

from p2wss.data.building import Reconstruction
from p2wss.eval.cases import Case, Key
from p2wss.eval.figures import COLORS, FACE_COLORS
from p2wss.eval.samples import Samples
from p2wss.eval.tables import numbers, rows_of
from p2wss.mesh import Mesh
from p2wss.mesh.surface import distance_to_mesh

# per data set; a building with its points and three meshes takes 20 to 60 kB of the page
NUM_BUILDINGS = {"worst": 20, "median": 5, "best": 5}
MAX_POINTS = 4000
_OTHER_COLORS = ("#3f7d4e", "#7b5ea7", "#b8872b")


@dataclass(frozen=True)
class Viewer:
    """The pieces of the page: the data as JSON, three.js, and the script that draws the data with it."""

    data: str
    library: str
    script: str


def choices(measures: pa.Table, titles: Mapping[str, str], ours: str) -> list[tuple[str, Key]]:
    """The worst, median and best buildings of the method ``ours`` by Chamfer distance: title of the group, and key.

    measures: of the schema ``MEASURES``. titles: data sets to show, with their titles.
    """
    chosen: list[tuple[str, Key]] = []
    columns = measures.select(["dataset", "method", "tile", "building_id", "chamfer_m"])
    for dataset, title in titles.items():
        rows = rows_of(columns, dataset, ours)
        # a building without a mesh is worse than any other
        frame = rows.select(["tile", "building_id"]).to_pandas()
        frame["order"] = -np.nan_to_num(numbers(rows, "chamfer_m"), nan=np.inf)
        ranked = frame.sort_values(["order", "tile", "building_id"]).reset_index(drop=True)
        for group, ranks in choose(len(ranked)).items():
            for row in ranked.iloc[ranks].itertuples():
                chosen.append((f"{title}: {group}", (dataset, str(row.tile), str(row.building_id))))
    return chosen


def viewer(
    samples: Samples, chosen: Sequence[tuple[str, Key]], names: Mapping[str, str], ours: str
) -> Viewer | None:
    """The view of the chosen buildings (:func:`choices`); None if there are none. names: of the methods."""
    methods = [name for name in samples.reconstructions if name == ours or name != "constant"]
    buildings = []
    for group, key in chosen:
        by_method = {name: samples.reconstructions[name].get(key) for name in methods}
        rows = {name: samples.rows.get((key, name)) for name in methods}
        buildings.append({"group": group} | _building(samples.cases[key], by_method, rows, ours))
    if not buildings:
        return None
    spare = iter(_OTHER_COLORS * len(methods))
    data = {
        "palette": _base64((colormaps["turbo"](np.arange(256))[:, :3] * 255).round().astype(np.uint8)),
        "kinds": [FACE_COLORS[kind] for kind in sorted(FACE_COLORS)],
        "methods": [
            {
                "key": name,
                "name": names.get(name, name),
                "color": COLORS.get(name) or next(spare),
                "ours": name == ours,
            }
            for name in methods
        ],
        "buildings": buildings,
    }
    assets = files("p2wss.eval") / "assets"
    # "</script>" in a building's id must not end the element
    text = json.dumps(data, separators=(",", ":"), sort_keys=True).replace("<", "\\u003c")
    return Viewer(
        text, (assets / "three.min.js").read_text("utf-8"), (assets / "viewer.js").read_text("utf-8")
    )


def choose(count: int) -> dict[str, list[int]]:
    """The ranks to show out of ``count`` buildings, worst first, none twice.

    >>> {group: len(ranks) for group, ranks in choose(1000).items()}
    {'worst': 20, 'median': 5, 'best': 5}
    >>> choose(3)
    {'worst': [0, 1, 2], 'median': [], 'best': []}
    """
    worst = list(range(min(NUM_BUILDINGS["worst"], count)))
    best = list(range(max(len(worst), count - NUM_BUILDINGS["best"]), count))
    first = (count - NUM_BUILDINGS["median"]) // 2
    extremes = {*worst, *best}
    median = [rank for rank in range(first, first + NUM_BUILDINGS["median"]) if 0 <= rank < count]
    return {"worst": worst, "median": [rank for rank in median if rank not in extremes], "best": best[::-1]}


def _building(
    case: Case,
    reconstructions: Mapping[str, Reconstruction | None],
    rows: Mapping[str, Mapping[str, Any] | None],
    ours: str,
) -> dict[str, Any]:
    """One building for the page, relative to its origin and to its ground."""
    building = case.building
    ground = building.ground_z_m
    point_m = building.point_m - np.array([0.0, 0.0, ground])
    point_m = point_m[:: max(-(-len(point_m) // MAX_POINTS), 1)]
    point_cm = np.round(point_m * 100)
    storable = (np.abs(point_cm) <= np.iinfo(np.int16).max).all(axis=1)
    point_m, point_cm = point_m[storable], point_cm[storable]
    meshes, reach = {}, [point_m]
    for name, reconstruction in reconstructions.items():
        mesh = None if reconstruction is None else reconstruction.mesh
        if reconstruction is not None and mesh is not None:
            shift = [
                *np.subtract(reconstruction.origin_xy_m, building.origin_xy_m),
                reconstruction.ground_z_m - ground,
            ]
            vertex_m = mesh.vertex_m + np.array(shift)
            reach.append(vertex_m)
            meshes[name] = {
                "vertices": _base64(np.round(vertex_m * 1000).astype(np.int32)),
                "triangles": _base64(mesh.triangle.astype(np.uint32)),
                "kinds": _base64(mesh.kind.astype(np.uint8)),
                "facts": _facts(mesh, rows[name]),
            }
            if name == ours:
                distance = np.clip(distance_to_mesh(point_m, vertex_m, mesh.triangle), 0, 1)
    if ours not in meshes:
        distance = np.zeros(len(point_m))
    corners = np.concatenate(reach) if any(map(len, reach)) else np.zeros((1, 3))
    row = rows[ours] or {}
    score = "no mesh" if row.get("chamfer_m") is None else f"CD {row['chamfer_m']:.2f} m"
    about = f"{len(building.point_m)} points, {sum(map(len, building.rings))} vertices"
    if case.roof_type:
        about += f", {case.roof_type}"
    return {
        "id": building.building_id,
        "title": f"{score}: {building.building_id}",
        "about": f"Tile {building.tile}, {about}",
        "bounds": np.round([corners.min(axis=0), corners.max(axis=0)], 2).tolist(),
        "points": _base64(point_cm.astype(np.int16)),
        "distances": _base64(np.round(distance * 255).astype(np.uint8)),
        "meshes": meshes,
    }


def _facts(mesh: Mesh, row: Mapping[str, Any] | None) -> str:
    triangles = f"{len(mesh.triangle)} triangles"
    if row is None or row["chamfer_m"] is None:
        return triangles
    return f"CD {row['chamfer_m']:.2f} m, {triangles}"


def _base64(values: np.ndarray) -> str:
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode()
