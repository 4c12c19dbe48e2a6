"""Drawn houses with 20 points each, without and with the network that supposes the rest (docs/img/sparse.png).

python benchmarks/towns.py --kind wings --lidar --seed 101 --out TOWN
PYTHONPATH=benchmarks python docs/img/sparse.py TOWN docs/img/sparse.png     (needs matplotlib)
"""

from __future__ import annotations

import sys
from pathlib import Path

import few_points
import matplotlib.pyplot as plt
import numpy as np
import real
from drawn_towns.files import ROOFS
from drawn_towns.lidar import LIDAR
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

import p2wss
from p2wss.config import Config
from p2wss.mesh import Mesh
from p2wss.mesh.topology import NEXT
from p2wss.reconstruction.product import reconstruct_buildings
from p2wss.towns import FOOTPRINTS

NUM_POINTS, NUM_HOUSES = 20, 8
# of the town, houses at even intervals
FIRST = 3


def draw(axes: Axes, mesh: Mesh, limits_m: tuple[float, float]) -> None:
    """The plan of a roof, coloured by height, and the edges between its faces."""
    is_up = mesh.doubled_m2[:, 2] > 1e-6
    corner_m = mesh.vertex_m[mesh.triangle]
    order = np.argsort(corner_m[..., 2].mean(axis=1))
    order = order[is_up[order]]
    xy_m, z_m = corner_m[order, :, :2], corner_m[order, :, 2].mean(axis=1)
    axes.add_collection(PolyCollection(xy_m, array=z_m, cmap="viridis", clim=limits_m))
    is_edge = is_up[:, None] & (mesh.number[:, None] != mesh.number[mesh.twin // 3])
    ends = np.stack([mesh.triangle[is_edge], mesh.triangle[:, NEXT][is_edge]], axis=1)
    for end_m in mesh.vertex_m[ends, :2]:
        axes.plot(*end_m.T, color="black", linewidth=0.8)
    axes.autoscale()
    axes.set_aspect("equal")
    axes.axis("off")


def main(town: Path, out: Path) -> None:
    """Draw the true roofs above those without and with the network."""
    config, truth = Config(), p2wss.read(town / ROOFS)
    buildings = real.read_files(town / FOOTPRINTS, [town / LIDAR], "town", config)
    few = few_points.with_roofs_around([few_points.thinned(each, NUM_POINTS, 0) for each in buildings])
    few = few[FIRST :: len(few) // NUM_HOUSES][:NUM_HOUSES]
    _, axes = plt.subplots(3, NUM_HOUSES, figsize=(13, 6))
    for row, completion in enumerate((None, False, True)):
        found = [truth[each.building_id].solid.translated(-each.position_m) for each in few]
        if completion is not None:
            settings = config.reconstruct.model_copy(update={"completion": completion})
            found = [each.mesh for each in reconstruct_buildings(few, None, settings)]
        for place, building, mesh in zip(axes[row], few, found, strict=True):
            point_m = building.point_m[building.is_on_building]
            draw(place, mesh, (point_m[:, 2].min() - 1, point_m[:, 2].max() + 1))
            if completion is not None:
                place.plot(*point_m[:, :2].T, ".", color="white", markersize=5, markeredgecolor="black")
        title = {None: "true", False: "without the network", True: "default"}[completion]
        axes[row, 0].set_title(title, loc="left", fontsize=10)
    plt.tight_layout()
    plt.savefig(out, dpi=80)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
