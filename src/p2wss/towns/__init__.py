"""Synthetic towns in IGN's own file formats, so that the whole pipeline runs, and trains, without internet access.

A town consists of footprints as BD TOPO delivers them, with its gaps and defects, terrain as RGE ALTI delivers it, and
on request a *stand-in* for one LiDAR HD tile. All towns have the same terrain; the seed decides the rest.
The roofs come from the wings generated here and never from the package's geometry kernel: the ground truth has to be
independent, so nothing here imports ``p2wss.skeleton``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely

from p2wss.towns.buildings import DrawnBuilding
from p2wss.towns.ign import write_footprints, write_terrain
from p2wss.towns.lidar import write_lidar
from p2wss.towns.plan import draw_town

__all__ = ["MINIATURE_SEED", "draw_town", "write_footprints", "write_lidar", "write_terrain", "write_town"]

MINIATURE_SEED = 652  # the town under tests/mini
# of the demo: rows and detached houses between the centre and the edge of the town
_DEMO = shapely.box(653_150, 6_860_690, 653_270, 6_860_790)
FOOTPRINTS = "bdtopo/BDTOPO_mini.gpkg"
TERRAIN = "rgealti"
LIDAR = "lidar/LHD_FXX_0653_6861_PTS_LAMB93_IGN69.laz"


def write_town(folder: Path, seed: int, with_lidar: bool) -> list[DrawnBuilding]:
    """Draw the town of ``seed``, write its files into ``folder`` and return its buildings.

    Footprints and terrain are the same with and without the LiDAR.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    town = draw_town(rng)
    write_terrain(folder / TERRAIN)
    write_footprints(town, folder / FOOTPRINTS, rng)
    if with_lidar:
        write_lidar(town, folder / LIDAR, rng)
    return town


def write_demo(folder: Path) -> int:
    """Write ``footprints.gpkg`` and ``lidar.laz`` of a few streets of a town, and return the number of buildings."""
    rng = np.random.Generator(np.random.PCG64(MINIATURE_SEED))
    streets = [building for building in draw_town(rng) if _DEMO.contains(building.footprint)]
    write_footprints(streets, folder / "footprints.gpkg", rng)
    write_lidar(streets, folder / "lidar.laz", rng)
    return len(streets)
