"""What decides between roofs of planes, each threshold with its unit and its meaning."""

from __future__ import annotations

from typing import NamedTuple


class Detection(NamedTuple):
    """Which points make a plane."""

    # points nearest to each, which show the direction of the surface there
    num_neighbours: int = 12
    # metres: points of a plane lie this near to it
    distance_m: float = 0.15
    # degrees: the surface at a point of a plane differs from the plane by less, unless the surface there is rougher
    # than the next figure in metres
    angle_deg: float = 25.0
    rough_m: float = 0.1
    # a plane has this area of points, and this many
    min_area_m2: float = 1.0
    min_points: int = 8
    # metres: noise of a point; smaller residuals have full weight
    noise_m: float = 0.03
    # metres: a plane that is simpler than its points show (one for two, level, along a wall) may be this much further
    # from them on average
    simpler_m: float = 0.012


class Drawing(NamedTuple):
    """Where the lines of a roof are sought."""

    # metres: planes this near to each other in plan have a border
    near_m: float = 1.5
    # metres: lines extend beyond the border that they are found by
    reach_m: float = 2.0
    # metres: a step so near to an edge of the footprint, or to another step, is on it
    snap_m: float = 0.35
    # degrees: directions that differ less are the same
    same_deg: float = 4.0
    # a step leaves less than this share of the points of the border on the wrong side
    wrong_share: float = 0.35
    # directions of the footprint in which steps are sought, the longest first
    num_directions: int = 4


class Prices(NamedTuple):
    """What a roof pays, in cubic metres between the roof and its points."""

    # for each face
    face_m3: float = 0.3
    # for each metre of an edge: a step above the limit below
    edge_m2: float = 0.08
    # shares of it: where two planes meet, where they are nearly the same plane, and a small step
    meet_share: float = 0.5
    shallow_share: float = 1.0
    small_step_share: float = 1.6
    # metres: planes meet along an edge if no end of it has a larger step
    meet_m: float = 0.08
    small_step_m: float = 0.4
    # tangent of the angle below which two planes are nearly the same
    shallow: float = 0.09
    # metres: larger residuals count as this
    cap_m: float = 1.0
    # metres a roof is expected to be off per metre beyond its points, after the first metre, and at most
    beyond_share: float = 0.02
    max_beyond_m: float = 0.1


class Thresholds(NamedTuple):
    """All that decides between roofs of planes."""

    detection: Detection = Detection()
    drawing: Drawing = Drawing()
    prices: Prices = Prices()

    def times(self, factor: float) -> Thresholds:
        """The thresholds with all prices multiplied."""
        prices = self.prices
        dearer = prices._replace(face_m3=factor * prices.face_m3, edge_m2=factor * prices.edge_m2)
        return self._replace(prices=dearer)


THRESHOLDS = Thresholds()
