"""The geometry kernel: footprints, angles and heights to closed LoD2 meshes, by weighted straight skeletons.

What the angles mean (a picture of each rule: ``docs/methods/skeleton.md``, ``docs/img/skeleton_*.svg``):

* An edge of angle a moves inwards by cot(a) metres for every metre of height (``skeleton_speed``).
* 90 degrees stands still, exactly: a gable (``skeleton_gable``).
* 0 degrees is infinitely fast ("phase 0"): such edges sweep first, at the eave, all that they reach while the
  others stand still (``skeleton_flat``).
* Where only 90 degree edges are left, the roof is capped flat at the height where the last slope ended
  (``skeleton_cap``); a maximum height cuts it flat (``skeleton_max_height``).
* Two edges that become collinear neighbours at different speeds: the faster swallows the slower
  (``skeleton_parallel``). Edges that are parallel to within a millimetre only do not become collinear.
* A 90 degree edge beside a reflex corner carries on over the roof as a vertical wall (``skeleton_reflex``).
* Courtyards are further rings whose edges have angles too (``skeleton_courtyard``).
"""

from p2wss.skeleton.batch import build
from p2wss.skeleton.queries import RoofPoints, roof_points
from p2wss.skeleton.status import Status
from p2wss.skeleton.types import FaceKind, Meshes, Polygons

__all__ = [
    "FaceKind",
    "Meshes",
    "Polygons",
    "RoofPoints",
    "Status",
    "build",
    "roof_points",
]
