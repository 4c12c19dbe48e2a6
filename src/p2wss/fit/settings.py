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

    # points: the number of sampled points in the search and in the last rounds; swept
    num_search_points: int = 128
    num_points: int = 300
    # metres: larger residuals count as this
    cap_m: float = 1.0
    # metres: larger residuals are left out of the least squares
    reach_m: float = 1.0
    # metres: the least gain for which an edge changes its class, with at least ``full_num_points`` points;
    # proportionally more with fewer; swept
    class_gain_m: float = 0.002
    full_num_points: float = 150.0
    # metres: the least gain for which edges that face the same way get different slopes; swept
    separate_slope_gain_m: float = 0.006
    # metres that whole degrees, and gables in place of steep ends, may cost
    rounding_m: float = 0.01
    # degrees: the slope of the hip and gable roofs that a search starts from; the slopes that are tried for an edge;
    # two slopes that differ by less are the same
    start_deg: float = 42.0
    tried_deg: tuple[float, ...] = (0.0, 90.0, 18.0, USUAL_SLOPE_DEG, 57.0)
    same_slope_deg: float = 9.0
    # rounds of least squares: for each start, for each change that is tried, for the result
    num_start_rounds: int = 4
    num_trial_rounds: int = 3
    num_last_rounds: int = 8
    # edges: with more, edges of one direction are only tried together; with more than the second, only starts are tried
    many_edges: int = 40
    too_many_edges: int = 120
    # metres: smaller residuals have full weight. Larger than the mean residual of noise: its largest residuals are near
    # this
    noise_m: float = 0.05
    # degrees: slopes are between these; the kernel takes up to 85
    slopes_deg: tuple[float, float] = (5.0, 75.0)
    # weights of the present height and slope, in points: they keep a step small where the points do not determine it
    keep_eave: float = 1e-3
    keep_slope: float = 0.5
    # metres, in the sum over the points: what each degree of difference from the usual slope costs, up to
    # ``max_off_deg``, so that it decides where there are few points. Differences below ``least_deg`` are weighted as if
    # they were that, as reweighting would divide by zero
    degree_cost_m: float = 0.003
    max_off_deg: float = 20.0
    least_deg: float = 1.0
    # a step that gains nothing is shortened to these shares
    steps: tuple[float, ...] = (1.0, 0.4, 0.16)
    # metres: the least gain for which a step is accepted, and for which another round follows
    min_step_gain_m: float = 1e-5
    min_round_gain_m: float = 5e-4
    # degrees: a steeper end of a gable roof becomes a gable if that costs little
    nearly_gable_deg: float = 60.0
    # metres: a narrower slope is made of returns from the wall below; it becomes a gable if that costs at most the
    # second
    min_slope_width_m: float = 0.8
    wall_hits_m: float = 0.04


PARAMETRIC = Parametric()


class Detection(NamedTuple):
    """Which points make a plane (`planes/detection.py`)."""

    # points per square metre: of a denser cloud, an even sample of this density shows the same
    max_per_m2: float = 50.0
    # points nearest to each, which show the direction of the surface there
    num_neighbours: int = 12
    # twice as many neighbours are taken if, for more than this share of sampled points, they lie on a line of the
    # scanner: in a strip narrower than ``line_width`` of its length
    line_share: float = 0.12
    line_width: float = 0.15
    num_line_samples: int = 2_000
    # metres: points of a plane lie this near to it
    distance_m: float = 0.15
    # standard deviations of the points: ``distance_m`` is at least ``num_noises`` of these; swept on noisy copies of
    # true roofs. At least ``min_noise_points`` points show the noise. More than ``max_noise_m`` metres is no noise of a
    # survey, but of leaves
    num_noises: float = 2.0
    min_noise_points: int = 50
    max_noise_m: float = 0.25
    # degrees: the surface at a point of a plane differs from the plane by less, unless it is rougher than ``rough_m``
    # metres
    angle_deg: float = 25.0
    rough_m: float = 0.1
    # the points of a plane cover at least this area on its slope; a plane that grows has at least ``min_points`` points
    min_area_m2: float = 1.0
    min_points: int = 8
    # per square metre: fewer points are sparse, and the surface around one of them shows nothing
    sparse_per_m2: float = 3.0
    # the nearest points of each sparse point, and of each point over which no plane has grown
    num_sparse_neighbours: int = 8
    # sparse points that show a level roof, and that show a slope. A single point shows a level roof if there are at
    # most ``num_few_points`` in all and at least ``single_per_m2`` on a square metre; swept on thinned clouds
    min_sparse_points: int = 2
    min_slope_points: int = 3
    num_few_points: int = 300
    single_per_m2: float = 0.3
    # points from which planes through sparse points are sought; their number times the number of free points is at most
    # ``max_seed_points``
    num_seeds: int = 120
    max_seed_points: int = 40000
    # metres in plan: the least distance between two points that show a slope
    min_run_m: float = 0.5
    # tangent of the slope, 83 degrees, of steep spires. A steeper plane is a wall, or goes through points along a line
    steepest: float = 8.14
    # turns in which points go to the best plane near them; between two turns, planes are fitted to their points
    num_turns: int = 3
    # metres: noise of a point; smaller residuals have full weight
    noise_m: float = NOISE_M
    # metres: a simpler plane (one in place of two, level, along a wall) may be this much further from its points, on
    # average
    simpler_m: float = 0.008

    def for_noise(self, noise_m: float) -> Detection:
        """The settings for points with this standard deviation from the surface. ``simpler_m`` grows with the cube of
        the noise, as large noise looks like many small planes; swept."""
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
    # metres: lines extend this far where nothing is seen, that is, where no point is within ``reach_m``
    hidden_m: float = 0.0
    # metres: the line of an edge of the footprint goes on this far beyond a reflex corner
    beyond_m: float = 10.0
    # metres: a border further from the line on which two planes meet is not on it
    off_m: float = 0.6
    # metres: a step this near to an edge of the footprint, or to another step, is on it
    snap_m: float = 0.35
    # metres: a step that passes a corner of the footprint this near goes through it, as walls on the floor stay,
    # however narrow; swept: with more, blocks get more triangles
    corner_m: float = 0.15
    # multiples of the distance between points: the least values of ``near_m`` and ``reach_m``, of ``off_m``, and of
    # ``snap_m``, as points do not tell lines apart that are nearer; swept on thinned clouds
    num_gaps: float = 3.0
    off_gaps: float = 1.0
    snap_gaps: float = 0.5
    # degrees: directions that differ less are the same
    same_deg: float = 4.0
    # a step leaves less than this share of the points of the border on the wrong side
    wrong_share: float = 0.35
    # it turns from the directions of the footprint if this leaves fewer there, by this share
    turned_share: float = 0.3
    # the least number of links between points on both sides of a step that no other line divides, and the least length
    # in metres, of a part of the step that gets a line of its own
    part_links: int = 6
    part_m: float = 1.0
    # metres: lines of a map end up to this far from what they should meet; a line is used where an edge is this near
    mapped_gap_m: float = 1.0
    mapped_on_m: float = 0.2

    def for_density(self, per_m2: float) -> Drawing:
        """The settings for this density of points, which show the borders of planes less exactly if it is low."""
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
    # for each metre of an edge, in full for a step above ``small_step_m``; swept
    edge_m2: float = 0.17
    # for each metre of an edge and each metre by which the distance between points exceeds ``dense_gap_m``. Swept on
    # thinned clouds: it leaves out false edges, but the roof is millimetres further from the truth, and centimetres
    # with ten points
    sparse_edge_m: float = 0.2
    dense_gap_m: float = 0.6
    # for each line that has steps; a proportional share if its steps are shorter than ``whole_line_m`` metres, as else
    # a tiny face could save the price of a line. A line with steps shorter than ``short_line_m`` metres is dropped
    # where that pays, as a border along pieces of many lines would be jagged; swept
    line_m3: float = 0.15
    whole_line_m: float = 0.3
    short_line_m: float = 3.0
    # multiples of the price of an edge: where two planes meet, where two planes of a known roof meet (swept on thinned
    # clouds), and for a small step
    meet_share: float = 0.5
    known_share: float = 0.3
    small_step_share: float = 2.0
    # metres: planes meet along an edge if the step at both its ends is smaller; a small step is lower on average than
    # the second
    meet_m: float = 0.08
    small_step_m: float = 0.4
    # metres: larger residuals count as this
    cap_m: float = 1.0
    # a plane that brings its points nearer to the roof by less than this in all is no candidate: hardly any face is
    # cheaper; swept
    least_m3: float = 0.3
    # points per square metre: the roof that a network supposes counts like so many, but at most like the points; swept
    # on thinned clouds
    supposed_per_m2: float = 0.15
    # metres by which a roof may rise above its points, or fall below all of them
    support_m: float = 0.5
    # metres: when a line is dropped, cells may change up to this far from its steps
    around_line_m: float = 3.0

    def for_density(self, per_m2: float) -> PlanePrices:
        """The prices for this density of points."""
        gap_m = per_m2**-0.5
        return self._replace(edge_m2=self.edge_m2 + self.sparse_edge_m * max(gap_m - self.dense_gap_m, 0.0))


class Limits(NamedTuple):
    """The most that the search for planes of one building takes, so that its memory is bounded.

    Of more points, an even sample is taken; of more planes, the largest. If their lines are too many, or cross in too
    many places, half of the planes are taken, and so on. Of more lines of a map, the longest are taken, and half of
    these if they cross in too many places. The planes between lines of a map are fitted to an even sample of points in
    a limited number of rounds of weights.
    """

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
    # points on a roof and on the roofs around it: with fewer, the parametric model is better than planes
    min_plane_points: int = 5
    # per square metre of footprint: with fewer points, the search for planes begins with the roof that a network
    # supposes, or else with the parametric model
    known_per_m2: float = 2.0
    # metres: shorter edges of the mesh are removed, if no vertex moves further
    short_edge_m: float = 0.2
    # factors of the prices of planes for each value of `reconstruct.detail`
    detail: dict[str, float] = field(default_factory=lambda: {"low": 2.0, "normal": 1.0, "high": 0.5})


THRESHOLDS = Thresholds()
