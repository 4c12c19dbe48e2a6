"""Planes of a drawn house of several bodies: its points by height, by plane, and the roof (docs/img/planes.png).

python benchmarks/towns.py --kind wings --lidar --seed 8 --out TOWN
PYTHONPATH=benchmarks python docs/img/planes.py TOWN docs/img/planes.png     (needs matplotlib)
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from drawn_towns.lidar import LIDAR
from matplotlib.collections import PolyCollection

import p2wss
from p2wss.mesh.surface import topmost
from p2wss.mesh.topology import NEXT
from p2wss.towns import FOOTPRINTS

HOUSE = "BATIMENT0000002000000102"


def main(town: Path, out: Path) -> None:
    """Draw the three plans."""
    scene = p2wss.reconstruct(town / LIDAR, town / FOOTPRINTS, ids=[HOUSE], model="none", progress=False)
    mesh, point_m = scene[HOUSE].solid, scene.points(HOUSE)
    below, roof_z = topmost(np.ascontiguousarray(mesh.corner_m), np.ascontiguousarray(point_m))
    is_near = (below >= 0) & (np.abs(point_m[:, 2] - roof_z) < 0.5)
    point_m, plane = point_m[is_near], mesh.face[below[is_near]]
    is_up = mesh.doubled_m2[:, 2] > 1e-6
    colours = plt.get_cmap("tab20")(np.searchsorted(np.unique(mesh.face[is_up]), mesh.face) * 7 % 20)
    _, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout="constrained")
    axes[0].scatter(*point_m[:, :2].T, s=3, c=point_m[:, 2], cmap="viridis")
    of_face = dict(zip(mesh.face[is_up].tolist(), colours[is_up], strict=True))
    axes[1].scatter(*point_m[:, :2].T, s=3, c=[of_face[each] for each in plane.tolist()])
    axes[2].add_collection(
        PolyCollection(mesh.corner_m[is_up][..., :2], facecolors=colours[is_up], edgecolors="face")
    )
    is_edge = is_up[:, None] & (mesh.face[:, None] != mesh.face[mesh.twin // 3])
    ends = np.stack([mesh.triangle[is_edge], mesh.triangle[:, NEXT][is_edge]], axis=1)
    for each, title in zip(axes, ("points by height", "points by plane", "roof"), strict=True):
        for end_m in mesh.vertex_m[ends, :2] if title == "roof" else ():
            each.plot(*end_m.T, color="black", linewidth=0.8)
        each.autoscale()
        each.set_aspect("equal")
        each.set_title(title, fontsize=9)
        each.axis("off")
    plt.savefig(out, dpi=72, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
