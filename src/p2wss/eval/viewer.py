"""The 3D view of ``report.html``: a selection of buildings with points and meshes (:mod:`p2wss.formats.viewer`)."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from p2wss.data.building import Reconstruction
from p2wss.data.points import stride
from p2wss.eval.cases import Case, Key
from p2wss.eval.figures import COLORS
from p2wss.formats.viewer import OTHER_COLORS, Layer, Shown
from p2wss.formats.viewer import viewer as view_of
from p2wss.mesh.surface import distance_to_mesh

# buildings per data set in addition to the worst ones
NUM_MEDIAN = NUM_BEST = 5
MAX_POINTS = 4000


class View(NamedTuple):
    """A building to show: title of its group, key, and mean distance of its points to our mesh, NaN if unknown."""

    group: str
    key: Key
    points_to_mesh_m: float


def choices(ranked: pd.DataFrame, titles: Mapping[str, str], num_worst: int) -> list[View]:
    """The worst, median and best buildings of each data set, each only once.

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
) -> dict[str, Any] | None:
    """The view of the chosen buildings; None if there are none. names: of the methods to show."""
    if not views:
        return None
    layers = [
        Layer(method, name, COLORS.get(method, OTHER_COLORS[1]), method == ours)
        for method, name in names.items()
    ]
    buildings = [
        _shown(view, cases[view.key], {name: reconstructions[name].get(view.key) for name in names}, ours)
        for view in views
    ]
    return view_of(buildings, layers, together=False)


def _shown(view: View, case: Case, reconstructions: Mapping[str, Reconstruction | None], ours: str) -> Shown:
    """One building for the page, relative to its origin and to its ground."""
    building = case.building
    point_m = building.point_m[:: stride(len(building.point_m), MAX_POINTS)]
    meshes = {
        method: row.mesh.translated(row.position_m - building.position_m)
        for method, row in reconstructions.items()
        if row is not None and row.mesh is not None
    }
    distance_m = np.zeros(len(point_m))
    score = "no mesh"
    if ours in meshes:
        distance_m = distance_to_mesh(point_m, meshes[ours].vertex_m, meshes[ours].triangle)
        score = f"points {view.points_to_mesh_m:.2f} m"
    about = [f"Tile {building.tile}", f"{len(building.point_m)} points"]
    about += [f"{sum(map(len, building.rings))} vertices", *filter(None, [case.roof_type])]
    return Shown(
        building.building_id,
        meshes,
        point_m,
        distance_m,
        group=view.group,
        title=f"{score}: {building.building_id}",
        about=", ".join(about),
    )
