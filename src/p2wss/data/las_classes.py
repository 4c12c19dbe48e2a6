"""Classes of LiDAR points (LAS 1.4 R15, table 17), and the classes of producers."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

UNCLASSIFIED_CLASS = 1
GROUND_CLASS = 2
VEGETATION_CLASS = 5
BUILDING_CLASS = 6
WATER_CLASS = 9
# where flights overlap, producers gave it to all points of one flight (LAS 1.1 to 1.3), whatever they hit
OVERLAP_CLASS = 12
# of our own, reserved in LAS: points of a sparse cloud without class building that are a roof if a footprint says so,
# and otherwise plants
PERHAPS_ROOF_CLASS = 63
PLANT_CLASSES = (3, 4, VEGETATION_CLASS, PERHAPS_ROOF_CLASS)  # low, medium and high vegetation, and perhaps
NOISE_CLASSES = (7, 18)  # low and high noise
# class of points on the roof of another building over the footprint: noise for this building. The producers' own points
# of noise are left out before
NEIGHBOUR_CLASS = NOISE_CLASSES[1]


def has_class(classification: np.ndarray, classes: Sequence[int]) -> np.ndarray:
    """bool (n,): which points have one of ``classes``. classification: uint8 (n,)."""
    # numpy's own function takes eight times as long for the points of a building
    return _is_one_of(tuple(classes)).take(classification)


@cache
def _is_one_of(classes: tuple[int, ...]) -> np.ndarray:
    """bool (256,): which class numbers are in ``classes``."""
    return np.bincount(classes, minlength=256) > 0


@dataclass(frozen=True)
class ClassSet:
    """The classes of a producer: buildings, ground, and classes to ignore. All other classes are "other": such points
    may be on a building that the classifier has missed."""

    building: tuple[int, ...] = (BUILDING_CLASS,)
    ground: tuple[int, ...] = (GROUND_CLASS,)
    ignored: tuple[int, ...] = NOISE_CLASSES

    def to_las(self, classification: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(classes of LAS, uint8 (n,), whether to keep each point, bool (n,)) for the classes of the producer.

        A class with a number that means building or ground in LAS, but not here, becomes "unclassified", and so does
        :data:`PERHAPS_ROOF_CLASS`.
        """
        table = np.arange(256, dtype=np.uint8)
        table[[BUILDING_CLASS, GROUND_CLASS, PERHAPS_ROOF_CLASS]] = UNCLASSIFIED_CLASS
        table[list(self.building)] = BUILDING_CLASS
        table[list(self.ground)] = GROUND_CLASS
        return table[classification], ~has_class(classification, [*self.ignored, *NOISE_CLASSES])


LAS = ClassSet()
PRESETS = {
    "las": LAS,
    # France: 65 artefacts and 66 virtual points, which no pulse hit, are left out; 17 bridges, 64 permanent objects
    # above ground and 67 various count as other
    "lidarhd": ClassSet(ignored=(*NOISE_CLASSES, 65, 66)),
    # Netherlands: 14 power lines (AHN4) are left out; 26 civil structures count as other
    "ahn": ClassSet(ignored=(*NOISE_CLASSES, 14)),
    # Switzerland, swissSURFACE3D: 17 bridges count as other
    "swisstopo": LAS,
    # England, Environment Agency: ground and vegetation only
    "ea": ClassSet(building=()),
}


def class_set(
    preset: str, building: Sequence[int] = (), ground: Sequence[int] = (), ignored: Sequence[int] = ()
) -> ClassSet:
    """The classes of a preset, or with "custom" the three lists: the settings of ``region.classes``."""
    if preset == "custom":
        return ClassSet(tuple(building), tuple(ground), tuple(ignored))
    return PRESETS[preset]
