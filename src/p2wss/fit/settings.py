"""What decides between roofs: efforts, limits and prices of the fit, each with its unit, its meaning, and its origin.

*Swept* in a comment: `benchmarks/thresholds.py` shows the effect of other values; the default is the one that is best
on simulated buildings and half A of Delft. All others were set by hand from what roofs and clouds look like, and
`benchmarks/fit_ablation.py` shows what each feature is worth. Settings that compiled code takes are named tuples; as
they are constants to it, a changed default compiles anew.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

# metres: the mean residual that noise of airborne LiDAR leaves, which no better roof lowers
NOISE_M = 0.03
# degrees: the slope of a roof of which nothing is known
USUAL_SLOPE_DEG = 38.0


class Effort(NamedTuple):
    """How much the fit of one roof may cost."""

    # points: the sample that the search takes; swept
    num_search_points: int = 64
    # points: those that the last rounds take
    num_points: int = 300
    # starts that are improved after a first round; swept
    num_followed: int = 5
    # starts from which the classes are searched; 0: from none
    num_descents: int = 1
    # rounds of such a search over all edges
    max_rounds: int = 2


class Limits(NamedTuple):
    """What a roof may be, and what a change of it has to gain in the mean of the residuals."""

    # metres: larger residuals count as this
    cap_m: float = 1.0
    # metres above the eave; `reconstruct.max_roof_height_m`
    max_roof_height_m: float = 12.0
    # metres that another class of an edge gains, with 150 points; proportionally more with fewer; swept
    class_gain_m: float = 0.002
    # metres that different slopes of edges that face the same way gain; swept
    separate_slope_gain_m: float = 0.006
    # metres that whole degrees, and gables in place of steep ends, may cost
    rounding_m: float = 0.01
    # whether eaves at different heights are tried, where there may be several parts
    uneven_eaves: bool = True


class Settings(NamedTuple):
    """Effort and limits, as compiled code takes them."""

    effort: Effort
    limits: Limits


class Solving(NamedTuple):
    """The least squares of height and slopes (`roof/solve.py`, `roof/eaves.py`)."""

    # metres: smaller residuals have full weight; larger than the mean residual of noise, whose largest are near it
    noise_m: float = 0.05
    # degrees: slopes are between these; the kernel takes up to 85
    min_angle_deg: float = 5.0
    max_angle_deg: float = 75.0
    # weights of the present height and slope, in points: they keep a step small where the points do not determine it
    keep_eave: float = 1e-3
    keep_slope: float = 0.5
    # larger differences from the prior cost no more than these, which is where a different roof begins
    max_difference_deg: float = 20.0
    max_difference_m: float = 3.0
    # smaller ones are weighted as if they were these, as reweighting would divide by zero
    min_difference_deg: float = 1.0
    min_difference_m: float = 0.1
    # values: with more of them, selecting their median is faster than counting
    max_counted: int = 100
    # the first rounds from a median height take residuals of up to this multiple of the cap, as it may be far off
    first_reach: float = 3.0
    num_first_rounds: int = 2
    # a step that gains nothing is shortened to this share, so many times
    shorter_step: float = 0.4
    num_steps: int = 3
    # metres: a step is accepted that gains this much, and another round follows a gain of the second
    min_step_gain_m: float = 1e-5
    min_round_gain_m: float = 5e-4


class Searching(NamedTuple):
    """The search for the class of every edge (`roof/search.py`, `roof/rounds.py`)."""

    # metres: what a better roof leaves of the residual of one point, where the search decides whether to try it
    noise_m: float = 0.04
    # degrees of the hip and gable roofs that a search starts from, and of slopes in place of a guess's flat edges
    hip_deg: float = 42.0
    low_deg: float = 18.0
    # rounds of least squares: of each start, of those that are followed, of a candidate, of the best, with all points
    num_first: int = 1
    num_next: int = 3
    num_candidate: int = 3
    num_last: int = 8
    num_full: int = 5
    # metres: starts that are this much worse than the best after the first round are dropped
    follow_m: float = 0.2
    # metres: a candidate this much worse than the present loss is tried again, from the median height
    second_look_m: float = 0.05
    # metres: a candidate this much worse after a round is dropped, in the search and when all points are at hand
    give_up_m: float = 0.12
    give_up_last_m: float = 0.05
    # points: with these the gains of `Limits` hold as they are
    full_num_points: float = 150.0
    # edges: with more, fewer of them are tried by themselves, as the time grows with the cube of their number
    many_edges: int = 40
    # edges: with more, only the best start is followed
    too_many_edges: int = 120
    # degrees: a steeper end of a gable roof becomes a gable if that costs little
    nearly_gable_deg: float = 60.0
    # metres: one that is narrower is a return from the wall below, and becomes a gable for up to the second
    min_slope_width_m: float = 0.8
    wall_hits_m: float = 0.04


class Eaves(NamedTuple):
    """Eaves at different heights (`roof/eaves.py`)."""

    # rounds of planes, and of least squares of a start
    num_rounds: int = 4
    num_start_rounds: int = 3
    # metres: a round that gains less is the last one
    min_gain_m: float = 1e-4
    # slopes with fewer points, or with points over a narrower strip, keep their eave
    min_points: int = 8
    min_extent_m: float = 1.0
    # metres: no slope begins further outside its wall
    max_outward_m: float = 3.0


class Cuts(NamedTuple):
    """The choice of a cut through a part (`parts/best_cut.py`)."""

    # points of the part by which cuts are screened
    num_points: int = 160
    # cuts that are fitted in full, if the screening shows at most this multiple of the best one's cost
    num_fitted: int = 2
    finalist_ratio: float = 1.4
    # nor are cuts fitted that cost more than this multiple of what they may
    limit_ratio: float = 1.2
    # metres: positions so far beside a cut, and corners within this distance, are tried too
    shifts_m: tuple[float, ...] = (-0.25, -0.12, 0.12, 0.25)
    nearby_m: float = 0.35
    # rounds of least squares at such a position
    num_rounds: int = 2
    # a cut beside the corners of the footprint has to be better than one through a corner by this ratio
    off_corner_ratio: float = 1.02


EFFORT, SOLVING, SEARCHING, EAVES, CUTS = Effort(), Solving(), Searching(), Eaves(), Cuts()
# the effort of a quick fit, without a search of classes: of cuts and mergers that are screened
SCREENING = Effort(num_search_points=40, num_descents=0)


@dataclass(frozen=True)
class Price:
    """What one more part or box costs: how much it must lower the residuals."""

    # metres in the mean over all points of the building; swept
    mean_price_m: float
    # metres in the sum over the points, however few there are; swept
    min_price_m: float = 1.0

    def price_m(self, num_points: int) -> float:
        """The price in the sum over the points of a building that has ``num_points``."""
        return max(self.mean_price_m * num_points, self.min_price_m)


@dataclass(frozen=True)
class Cutting(Price):
    """Which parts a building may have."""

    mean_price_m: float = 0.014
    # `reconstruct.max_parts`
    max_parts: int = 32
    # each sloped face costs this share of the price of a part; swept
    slope_share: float = 0.3
    # cuts are made that gain this share of the price; those that do not pay are merged again; swept
    over_share: float = 0.7
    # a cut may lose this share, that of the slopes of a divided gable roof and a little more, if a second one through
    # one of its sides makes up for it; 0: never; swept
    loss_share: float = 0.7
    # a second cut is sought only where better roofs might gain this multiple of the price
    look_ahead_share: float = 4.0
    # a merger is fitted in full if a quick fit costs at most this multiple of what it may
    merger_slack: float = 1.4
    # points of a part
    min_points: int = 6


@dataclass(frozen=True)
class Boxes(Price):
    """Which boxes and recesses a building may have."""

    mean_price_m: float = 0.016
    max_boxes: int = 8
    # metres: so far above or below the roof a point has to lie for the search of a box to begin there
    above_m: float = 0.4
    # metres: larger residuals count as this
    cap_m: float = 1.0
    # points that far from the roof in a box
    min_points: int = 5
    min_width_m: float = 0.8
    min_area_m2: float = 1.0
    max_area_m2: float = 400.0
    # of the footprint's area
    max_share: float = 0.8
    recesses: bool = True
    # the roof is fitted once more without the points of boxes that gain at least this share of their price
    loose_share: float = 0.5


@dataclass(frozen=True)
class Chimneys:
    """What counts as a chimney. The price was chosen on simulated towns: `benchmarks/chimneys.py`."""

    # metres: of the returns from its top above the roof
    min_rise_m: float = 0.5
    max_rise_m: float = 2.5
    # returns from its top
    min_points: int = 3
    # metres: a narrower one is widened
    min_width_m: float = 0.4
    max_width_m: float = 1.6
    # of its sides
    max_ratio: float = 2.5
    max_area_m2: float = 1.5
    # of the footprint's area
    max_share: float = 0.04
    # metres: its price, in the sum of the residuals
    price_m: float = 1.5
    # of the returns over it that are from its top or its sides
    solid_share: float = 0.6
    # of the returns around it that are from the roof
    around_share: float = 0.75


class Detection(NamedTuple):
    """Which points make a plane (`planes/detection.py`)."""

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
    noise_m: float = NOISE_M
    # metres: a plane that is simpler than its points show (one for two, level, along a wall) may be this much further
    # from them on average
    simpler_m: float = 0.012


class Drawing(NamedTuple):
    """Where the lines of a roof of planes are sought (`planes/lines.py`)."""

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


class PlanePrices(NamedTuple):
    """What a roof of planes pays (`planes/labelling.py`), in cubic metres between the roof and its points."""

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


class Planes(NamedTuple):
    """All that decides between roofs of planes (`planes/`)."""

    detection: Detection = Detection()
    drawing: Drawing = Drawing()
    prices: PlanePrices = PlanePrices()

    def times(self, factor: float) -> Planes:
        """The thresholds with all prices multiplied."""
        prices = self.prices
        dearer = prices._replace(face_m3=factor * prices.face_m3, edge_m2=factor * prices.edge_m2)
        return self._replace(prices=dearer)


@dataclass(frozen=True)
class Thresholds:
    """All that decides between roofs."""

    effort: Effort = field(default_factory=Effort)
    limits: Limits = field(default_factory=Limits)
    cutting: Cutting = field(default_factory=Cutting)
    boxes: Boxes = field(default_factory=Boxes)
    chimneys: Chimneys = field(default_factory=Chimneys)
    # None: buildings are always parts and boxes
    planes: Planes | None = field(default_factory=Planes)
    # metres: the parametric roof is taken if the points are on average no further from it than from planes and this
    as_near_m: float = 0.005
    # metres: shorter edges of the mesh are removed if the points do not need them
    short_edge_m: float = 0.2
    # whether the planes of the mesh are adjusted to the points
    adjust: bool = True
    # multiples of the prices of parts and boxes, by `reconstruct.detail`
    detail: dict[str, float] = field(default_factory=lambda: {"low": 2.0, "normal": 1.0, "high": 0.5})
    # square metres: in a larger building a part has to explain no more volume between roof and points than in this
    full_price_m2: float = 60.0

    def of_building(self, area_m2: float, detail: str) -> Thresholds:
        """The thresholds of a building with its prices."""
        factor = self.detail[detail] / max(1.0, area_m2 / self.full_price_m2)
        cutting, boxes = self.cutting, self.boxes
        return replace(
            self,
            cutting=replace(cutting, mean_price_m=factor * cutting.mean_price_m),
            boxes=replace(boxes, mean_price_m=factor * boxes.mean_price_m),
            planes=self.planes and self.planes.times(self.detail[detail]),
        )


THRESHOLDS = Thresholds()
