"""Synthetic towns in IGN's own file formats, so that the whole pipeline runs, and trains, without internet access.

A town consists of footprints as BD TOPO delivers them, with its gaps and defects, and terrain as RGE ALTI delivers it.
All towns have the same terrain; the seed decides the rest.
The roofs come from the wings generated here and never from the package's geometry kernel: the ground truth has to be
independent, so nothing here imports ``p2wss.skeleton``.
"""

from pathlib import Path

import numpy as np

from p2wss.towns.buildings import DrawnBuilding
from p2wss.towns.ign import write_footprints, write_terrain
from p2wss.towns.plan import draw_town

FOOTPRINTS = "bdtopo/BDTOPO_mini.gpkg"
TERRAIN = "rgealti"


def write_town(folder: Path, seed: int) -> list[DrawnBuilding]:
    """Draw the town of ``seed``, write its files into ``folder`` and return its buildings."""
    rng = np.random.Generator(np.random.PCG64(seed))
    town = draw_town(rng)
    write_terrain(folder / TERRAIN)
    write_footprints(town, folder / FOOTPRINTS, rng)
    return town
