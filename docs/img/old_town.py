"""What still fails in a drawn old town: plans of the error of heights, and sections (docs/img/old_town.png).

python benchmarks/towns.py --kind old --lidar --seed 8 --out TOWN
PYTHONPATH=benchmarks python docs/img/old_town.py TOWN docs/img/old_town.png     (needs matplotlib)
"""

from __future__ import annotations

import sys
from pathlib import Path

import geopandas as gpd
import matplotlib.pyplot as plt
import numpy as np
import shapely
from drawn_towns.files import ROOFS
from drawn_towns.lidar import LIDAR

import p2wss
from p2wss.clouds.reading import read_clouds
from p2wss.mesh import Mesh
from p2wss.mesh.surface import topmost
from p2wss.towns import FOOTPRINTS

# buildings and the directions of their sections, degrees
CASES = {
    "BATIMENT0000002000011152": ("pits that no pulse reached", 10),
    "BATIMENT0000002000002363": ("levels in the shadow of higher houses", 80),
    "BATIMENT0000002000005049": ("narrow ones among many levels", -10),
}
COLOURS = {2: "saddlebrown", 5: "green", 6: "crimson"}
CELL_M, HALF_M = 0.1, 0.6


def heights(solid: Mesh, xy_m: np.ndarray) -> np.ndarray:
    """The roof over places (m, 2), NaN outside."""
    place_m = np.column_stack([xy_m, np.zeros(len(xy_m))])
    roof_z = topmost(np.ascontiguousarray(solid.corner_m), place_m)[1]
    return np.where(np.isfinite(roof_z), roof_z, np.nan)


def main(town: Path, out: Path) -> None:
    """Draw each case above its section."""
    scene = p2wss.reconstruct(town / LIDAR, town / FOOTPRINTS, ids=list(CASES), model="none", progress=False)
    truth, shapes = p2wss.read(town / ROOFS), gpd.read_file(town / FOOTPRINTS).set_index("cleabs").geometry
    cloud = read_clouds([town / LIDAR])
    point_m = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])
    _, axes = plt.subplots(2, len(CASES), figsize=(11, 6.5), height_ratios=(3, 2))
    for (name, (title, turn_deg)), (plan, section) in zip(CASES.items(), axes.T, strict=True):
        shape = shapely.force_2d(shapes[name])
        found, true = scene[name].solid, truth[name].solid
        low, high = np.reshape(shape.bounds, (2, 2))
        x, y = np.meshgrid(*(np.arange(a, b, CELL_M) for a, b in zip(low, high, strict=True)))
        xy_m = np.column_stack([x.ravel(), y.ravel()])
        error_m = np.where(
            shapely.contains_xy(shape, *xy_m.T), heights(found, xy_m) - heights(true, xy_m), np.nan
        )
        extent = (0, high[0] - low[0], 0, high[1] - low[1])
        image = plan.imshow(
            error_m.reshape(x.shape), "RdBu_r", origin="lower", extent=extent, vmin=-4, vmax=4
        )
        near = shapely.contains_xy(shape.buffer(1.0), cloud.x_m, cloud.y_m)
        own_m, classes = point_m[near] - [*low, 0], cloud.classification[near]
        colours = [COLOURS.get(each, "grey") for each in classes.tolist()]
        plan.scatter(own_m[:, 0], own_m[:, 1], 0.5, colours)
        plan.plot(*(shapely.get_coordinates(shape) - low).T, "k", lw=1)
        plan.set_title(title, fontsize=9)
        plan.set(xticks=[], yticks=[])
        worst = np.nan_to_num(np.abs(error_m)) > 1
        centre_m = np.median(xy_m[worst] - low, axis=0)
        along = np.array([np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))])
        place = np.arange(-9, 9, 0.02)
        line_m = centre_m + place[:, None] * along
        plan.plot(*line_m[shapely.contains_xy(shape, *(line_m + low).T)].T, "k--", lw=1)
        for solid, style in ((true, {"c": "limegreen", "lw": 4}), (found, {"c": "black", "lw": 1.2})):
            section.plot(place, heights(solid, line_m + low), **style)
        aside, ahead = (own_m[:, :2] - centre_m) @ [-along[1], along[0]], (own_m[:, :2] - centre_m) @ along
        is_near = (np.abs(aside) < HALF_M) & (np.abs(ahead) < 9)
        section.scatter(ahead[is_near], own_m[is_near, 2], 4, np.array(colours)[is_near])
        section.set_xlabel("m (true roof green, ours black)")
    plt.colorbar(image, ax=axes[0].tolist(), label="height, ours less true (m)", shrink=0.8)
    plt.savefig(out, dpi=64, bbox_inches="tight", pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
