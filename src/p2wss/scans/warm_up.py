"""Compiles all that the simulated survey calls, by surveying one small box."""

import numpy as np
import trimesh

from p2wss.config import Scans
from p2wss.scans.randomness import uniforms
from p2wss.scans.scan import scan_meshes


def warm_survey() -> None:
    """A survey of each preset, and the draws of clutter."""
    for preset in ("none", "paper", "hd"):
        scan_meshes(trimesh.creation.box((10, 12, 6)), None, None, Scans(preset=preset, density_per_m2=5))
    uniforms(np.zeros(1, np.uint64), 0, 1)
