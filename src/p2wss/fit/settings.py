"""What decides between roofs: efforts, limits and prices of the fit, each with its unit, its meaning, and its origin.

*Swept* in a comment: `benchmarks/thresholds.py` shows the effect of other values; the default is the one that is best
on simulated buildings and half A of Delft. All others were set by hand from what roofs and clouds look like, and
`benchmarks/fit_ablation.py` shows what each feature is worth. Settings that compiled code takes are named tuples; as
they are constants to it, a changed default compiles anew.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

# metres: the mean residual that noise of airborne LiDAR leaves, which no better roof lowers
NOISE_M = 0.03
# degrees: the slope of a roof of which nothing is known
USUAL_SLOPE_DEG = 38.0


@dataclass(frozen=True)
class Parametric:
    """How the paper's building is fitted (`roof/`)."""

    # points: the samples that the search and the last rounds take; swept
    num_search_points: int = 128
    num_points: int = 300
    # metres: larger residuals count as this
    cap_m: float = 1.0
    # metres: the least squares take no larger ones
    reach_m: float = 1.0
    # metres that another class of an edge gains, with so many points; proportionally more with fewer; swept
    class_gain_m: float = 0.002
    full_num_points: float = 150.0
    # metres that different slopes of edges that face the same way gain; swept
    separate_slope_gain_m: float = 0.006
    # metres that whole degrees, and gables in place of steep ends, may cost
    rounding_m: float = 0.01
    # degrees: of the hip and gable roofs that a search starts from, and all that are tried for an edge; a slope that
    # differs by less is the same
    start_deg: float = 42.0
    tried_deg: tuple[float, ...] = (0.0, 90.0, 18.0, USUAL_SLOPE_DEG, 57.0)
    same_slope_deg: float = 9.0
    # rounds of least squares: of each start, of each change that is tried, of what is kept
    num_start_rounds: int = 4
    num_trial_rounds: int = 3
    num_last_rounds: int = 8
    # edges: with more, only all of one direction are tried together; with more than the second, only starts
    many_edges: int = 40
    too_many_edges: int = 120
    # metres: smaller residuals have full weight; larger than the mean residual of noise, whose largest are near it
    noise_m: float = 0.05
    # degrees: slopes are between these; the kernel takes up to 85
    slopes_deg: tuple[float, float] = (5.0, 75.0)
    # weights of the present height and slope, in points: they keep a step small where the points do not determine it
    keep_eave: float = 1e-3
    keep_slope: float = 0.5
    # metres, in the sum over the points: what each degree of difference from the usual slope costs, up to so many, so
    # that it decides where there are few points; smaller differences are weighted as if they were the last figure, as
    # reweighting would divide by zero
    degree_cost_m: float = 0.003
    max_off_deg: float = 20.0
    least_deg: float = 1.0
    # a step that gains nothing is shortened to these shares
    steps: tuple[float, ...] = (1.0, 0.4, 0.16)
    # metres: a step is accepted that gains this much, and another round follows a gain of the second
    min_step_gain_m: float = 1e-5
    min_round_gain_m: float = 5e-4
    # degrees: a steeper end of a gable roof becomes a gable if that costs little
    nearly_gable_deg: float = 60.0
    # metres: one that is narrower is a return from the wall below, and becomes a gable for up to the second
    min_slope_width_m: float = 0.8
    wall_hits_m: float = 0.04


PARAMETRIC = Parametric()


class Detection(NamedTuple):
    """Which points make a plane (`planes/detection.py`)."""

    # per square metre: of more points, an even sample shows the same
    max_per_m2: float = 50.0
    # points nearest to each, which show the direction of the surface there
    num_neighbours: int = 12
    # where those of more than this share of (some) points lie on a line of the scanner, narrower than this share of its
    # length, twice as many are taken
    line_share: float = 0.12
    line_width: float = 0.15
    num_line_samples: int = 2_000
    # metres: points of a plane lie this near to it
    distance_m: float = 0.15
    # standard deviations of the points: the figure above is at least so many; swept on noisy copies of true roofs. So
    # many points show the noise, and more of it than the last figure, in metres, is none of a survey, but leaves
    num_noises: float = 2.0
    min_noise_points: int = 50
    max_noise_m: float = 0.25
    # degrees: the surface at a point of a plane differs from the plane by less, unless the surface there is rougher
    # than the next figure in metres
    angle_deg: float = 25.0
    rough_m: float = 0.1
    # a plane has this area of points, on its slope; one that grows along the surfaces around points has so many
    min_area_m2: float = 1.0
    min_points: int = 8
    # per square metre: fewer points are sparse, and the surface around one of them shows nothing
    sparse_per_m2: float = 3.0
    # of those, and of others that no plane has grown over: points nearest to each
    num_sparse_neighbours: int = 8
    # so few show a level roof, so many a slope; of at most so many points in all, of which so many are on a square
    # metre, each one shows a level roof; swept on thinned clouds
    min_sparse_points: int = 2
    min_slope_points: int = 3
    num_few_points: int = 300
    single_per_m2: float = 0.3
    # points from which planes through sparse points are sought, and at most so many times all points
    num_seeds: int = 120
    max_seed_points: int = 40000
    # metres in plan between two points that show a slope, and the tangent of the steepest
    min_run_m: float = 0.5
    max_slope: float = 2.2
    # tangent of the slope from which on a plane is no roof, but a wall, or through points along a line: that of 75
    # degrees, the steepest roof of the paper
    steepest: float = 3.73
    # turns in which points go to the best plane near them, and between which planes go to their points
    num_turns: int = 3
    # metres: noise of a point; smaller residuals have full weight
    noise_m: float = NOISE_M
    # metres: a plane that is simpler than its points show (one for two, level, along a wall) may be this much further
    # from them on average
    simpler_m: float = 0.008

    def for_noise(self, noise_m: float) -> Detection:
        """The settings for points that are off the surface by this standard deviation. By how much a simpler plane may
        be further from them grows with its cube, as large noise looks like many small planes; swept."""
        factor = max(self.num_noises * noise_m / self.distance_m, 1.0)
        return self._replace(
            distance_m=factor * self.distance_m,
            noise_m=factor * self.noise_m,
            simpler_m=factor**3 * self.simpler_m,
        )


class Drawing(NamedTuple):
    """Where the lines of a roof of planes are sought (`planes/lines.py`)."""

    # metres: planes this near to each other in plan have a border
    near_m: float = 1.5
    # metres: lines extend beyond the border that they are found by
    reach_m: float = 2.0
    # metres: so far where nothing is seen, from which points are further than the distance above
    hidden_m: float = 0.0
    # metres: an edge of the footprint goes on so far beyond a reflex corner
    beyond_m: float = 10.0
    # metres: a border further from the line on which two planes meet is not on it
    off_m: float = 0.6
    # metres: a step so near to an edge of the footprint, or to another step, is on it
    snap_m: float = 0.35
    # metres: a step that passes so near by a corner of the footprint goes through it, as walls on the floor stay,
    # however narrow; swept: with more, blocks get more triangles
    corner_m: float = 0.15
    # multiples of the distance between points: at least so long are the first two above, the third and the fourth, as
    # points tell no two lines apart that are nearer; swept on thinned clouds
    num_gaps: float = 3.0
    off_gaps: float = 1.0
    snap_gaps: float = 0.5
    # degrees: directions that differ less are the same
    same_deg: float = 4.0
    # a step leaves less than this share of the points of the border on the wrong side
    wrong_share: float = 0.35
    # links between points on both sides of a step that no other line divides, and metres along them: a part of the
    # step with so many of them has a line
    part_links: int = 8
    part_m: float = 1.0
    # metres: lines of a map end so far from what they should meet, and are used where an edge is so near
    mapped_gap_m: float = 1.0
    mapped_on_m: float = 0.2

    def for_density(self, per_m2: float) -> Drawing:
        """The settings where points show the borders of planes from further away."""
        gap_m = per_m2**-0.5
        return self._replace(
            near_m=max(self.near_m, self.num_gaps * gap_m),
            reach_m=max(self.reach_m, self.num_gaps * gap_m),
            off_m=max(self.off_m, self.off_gaps * gap_m),
            snap_m=max(self.snap_m, self.snap_gaps * gap_m),
        )


class PlanePrices(NamedTuple):
    """What a roof of planes pays (`planes/labelling.py`), in cubic metres between the roof and its points."""

    # for each face; swept
    face_m3: float = 0.08
    # for each metre of an edge: a step above the limit below; swept
    edge_m2: float = 0.17
    # for each metre of an edge and each metre by which the distance between points exceeds the second figure; swept on
    # thinned clouds, where it leaves out false edges and costs distance: millimetres, but centimetres with ten points
    sparse_edge_m: float = 0.2
    dense_gap_m: float = 0.6
    # for each line that has steps, a share of it if that is less of them than the next figure, in metres: else, a tiny
    # face would save the price of a line. Lines with less than the last figure of steps are dispensed with where that
    # pays: along pieces of many lines, a border would be jagged; swept
    line_m3: float = 0.15
    whole_line_m: float = 0.3
    short_line_m: float = 3.0
    # shares of the price of an edge: where two planes meet, where those of a known roof do (swept on thinned clouds), a
    # small step
    meet_share: float = 0.5
    known_share: float = 0.3
    small_step_share: float = 2.0
    # metres: planes meet along an edge if no end of it has a larger step
    meet_m: float = 0.08
    small_step_m: float = 0.4
    # metres: larger residuals count as this
    cap_m: float = 1.0
    # a plane that brings its points nearer to the roof by less than this in all is no candidate: hardly any face is
    # cheaper; swept
    least_m3: float = 0.3
    # points per square metre that the roof which a network supposes counts like, and at most like the points; swept on
    # thinned clouds
    supposed_per_m2: float = 0.15
    # metres by which a roof may rise above its points, or fall below all of them
    support_m: float = 0.5
    # metres: how far from its steps cells change where a line is dispensed with
    around_line_m: float = 3.0

    def for_density(self, per_m2: float) -> PlanePrices:
        """The prices where so many points are on a square metre."""
        gap_m = per_m2**-0.5
        return self._replace(edge_m2=self.edge_m2 + self.sparse_edge_m * max(gap_m - self.dense_gap_m, 0.0))


class Limits(NamedTuple):
    """The most that the search for planes of one building takes, so that its memory is bounded: of more points an even
    sample, of more planes the largest, half of them where their lines are more or cross in more places; of more lines
    of a map the longest, half of them where they cross in more places, and for the planes between these an even sample
    of points and so many rounds of weights."""

    num_points: int = 300_000
    num_planes: int = 2_000
    num_lines: int = 8_000
    num_places: int = 100_000
    num_mapped_lines: int = 200
    num_mapped_places: int = 300
    num_mapped_points: int = 4_000
    num_mapped_rounds: int = 12


class Planes(NamedTuple):
    """All that decides between roofs of planes (`planes/`)."""

    limits: Limits = Limits()
    detection: Detection = Detection()
    drawing: Drawing = Drawing()
    prices: PlanePrices = PlanePrices()

    def times(self, factor: float) -> Planes:
        """The thresholds with all prices multiplied."""
        prices = self.prices
        names = ("face_m3", "edge_m2", "sparse_edge_m", "line_m3", "least_m3")
        return self._replace(
            prices=prices._replace(**{name: factor * getattr(prices, name) for name in names})
        )


@dataclass(frozen=True)
class Thresholds:
    """All that decides between roofs."""

    parametric: Parametric = field(default_factory=Parametric)
    planes: Planes = field(default_factory=Planes)
    # points on a roof and on those around it: with fewer, the parametric model knows more than planes in them show
    min_plane_points: int = 5
    # per square metre of footprint: with fewer points, the search for planes begins with the roof that a network
    # supposes, or else with the parametric model
    known_per_m2: float = 2.0
    # metres: shorter edges of the mesh are removed, if no vertex moves further
    short_edge_m: float = 0.2
    # multiples of the prices of planes, by `reconstruct.detail`
    detail: dict[str, float] = field(default_factory=lambda: {"low": 2.0, "normal": 1.0, "high": 0.5})


THRESHOLDS = Thresholds()
