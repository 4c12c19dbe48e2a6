"""Draw roof angles: per footprint edge 0 (flat), 90 (vertical: a gable) or an integer from 20 to 45 degrees.

The paper (section 5.1) only states that each edge gets one of these values. The sampler ``uniform`` draws them
independently, as the paper describes, and ``uniform-kinds`` a third each flat, vertical and sloped. The sampler
``realistic`` draws a roof type first, and then the angles of such a roof.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2wss.config import Scenes
from p2wss.config.roof_angles import FLAT_DEG, MAX_SLOPE_DEG, MIN_SLOPE_DEG, VERTICAL_DEG
from p2wss.data.seeds import generator
from p2wss.skeleton.types import Polygons, cross

SLOPES_DEG = np.arange(MIN_SLOPE_DEG, MAX_SLOPE_DEG + 1)
ANGLES_DEG = np.array([FLAT_DEG, VERTICAL_DEG, *SLOPES_DEG])
# a third each
_KIND_SHARES = np.repeat([1, 1, 1 / len(SLOPES_DEG)], [1, 1, len(SLOPES_DEG)]) / 3
# edges whose directions differ by less belong to the same wing and share an angle
_PARALLEL_DEG = 12.0
# a gable stands on an edge between two corners of roughly a right angle
_CORNER_DEG = (45.0, 135.0)
# a gable is no wider than its wing, whose width is about twice the inradius of the footprint; without this
# limit, a U-shape would get a gable on the outer side of the wing that joins the other two
_GABLE_WIDTH_PER_RADIUS = 2.6
# a wing shorter than this share of its width is only a step in the wall
_SHORTEST_WING = 0.5
# the eave of a shed roof is at least as long as this share of the depth of the roof
_SHORTEST_SHED_EAVE = 0.5
# probabilities: a gable roof has two different sides; a further wing has the angle of the first; an edge of a mixed
# roof is flat; an edge of a mixed roof is vertical
_ASYMMETRIC, _SAME_ANGLE, _MIXED_FLAT, _MIXED_VERTICAL = 0.1, 0.6, 0.1, 0.25


@dataclass(frozen=True)
class FootprintEdges:
    """The edges of a footprint, as the samplers need them; arrays have one value per edge over all rings.

    xy_m: (n, 2), edge i starts at vertex i. next_edge: index of the next edge in the same ring. is_courtyard:
    the edge belongs to an interior ring. is_party: another building stands against the edge. radius_m: of the
    largest circle inside the footprint.
    """

    xy_m: np.ndarray
    next_edge: np.ndarray
    is_courtyard: np.ndarray
    is_party: np.ndarray
    radius_m: float

    @classmethod
    def from_rings(cls, rings: list[np.ndarray], is_party: np.ndarray, radius_m: float) -> FootprintEdges:
        """From rings (n, 2), exterior first, without a repeated first vertex."""
        sizes = [len(ring) for ring in rings]
        return cls(
            xy_m=np.concatenate(rings),
            next_edge=Polygons.from_rings([rings]).next_vertex,
            is_courtyard=np.repeat(np.arange(len(rings)) > 0, sizes),
            is_party=np.asarray(is_party, bool),
            radius_m=radius_m,
        )


def draw_angles(edges: FootprintEdges, building_id: str, config: Scenes) -> tuple[str, np.ndarray]:
    """Roof type and angle per edge (float64 (n,), degrees), with a seed from (seed, "scenes", building_id)."""
    rng = generator(config.seed, "scenes", building_id, "angles")
    if config.sampler != "realistic":
        share = None if config.sampler == "uniform" else _KIND_SHARES
        return "uniform", rng.choice(ANGLES_DEG, size=len(edges.xy_m), p=share).astype(float)
    return _draw_realistic(edges, config, rng)


def _draw_realistic(
    edges: FootprintEdges, config: Scenes, rng: np.random.Generator
) -> tuple[str, np.ndarray]:
    """Angles of a random roof type. A type that is impossible on the footprint is replaced by the nearest one.

    * An edge at a reflex corner never gets 90 degrees, which would raise a wall out of the roof.
    * Party walls are vertical, so that the ridges of row houses run along the street. A single other edge
      has the slope of a shed roof, and party walls all around leave a flat one.
    * Courtyards have eaves; a closed ring of wings has no gables.
    * Parallel edges share their angle (one gable roof in ten has two different sides).
    * Angles are drawn from those whose roof rises by at most ``max_rise_m`` over the largest circle in the footprint.
    """
    shares = config.roof_shares.model_dump()
    names = [name.replace("_", "-") for name in shares]
    weights = np.array(list(shares.values()))
    roof_type = str(rng.choice(names, p=weights / weights.sum()))

    vector_m = edges.xy_m[edges.next_edge] - edges.xy_m
    length_m = np.hypot(*vector_m.T)
    turn_deg = _turns(vector_m, edges.next_edge)  # at the start of each edge
    turn_after_deg = turn_deg[edges.next_edge]
    at_reflex = (turn_deg < 0) | (turn_after_deg < 0)
    party = edges.is_party & ~at_reflex
    pitches = SLOPES_DEG[edges.radius_m * np.tan(np.radians(SLOPES_DEG)) <= config.max_rise_m]

    if roof_type == "flat" or not len(pitches) or party.all():
        return "flat", np.zeros(len(length_m))
    if roof_type == "mixed":
        return "mixed", _draw_mixed(at_reflex, party, pitches, rng)
    is_lean_to = (~party).sum() == 1
    if roof_type == "shed" or is_lean_to:
        shed = _draw_shed(edges, vector_m, length_m, at_reflex, config.max_rise_m, rng)
        if shed is not None:
            return "shed", shed
        if is_lean_to:
            return "flat", np.zeros(len(length_m))
        roof_type = "gable"

    ends = _gable_ends(edges, length_m, turn_deg, turn_after_deg, party, vector_m)
    free_ends = np.flatnonzero(ends & ~party)
    if roof_type == "hip":
        ends[free_ends] = False
    elif roof_type == "half-hip" and len(free_ends):
        # one end is hipped; a party wall at the other end leaves only one that can be
        ends[rng.choice(free_ends)] = False
    is_asymmetric = roof_type == "gable" and rng.random() < _ASYMMETRIC
    angle_deg = _draw_slopes(vector_m, length_m, pitches, rng, is_asymmetric)
    angle_deg[ends] = 90
    if not np.any(ends):
        return "hip", angle_deg
    return ("gable" if np.array_equal(np.flatnonzero(ends & ~party), free_ends) else "half-hip"), angle_deg


def _turns(vector_m: np.ndarray, next_edge: np.ndarray) -> np.ndarray:
    """Turn to the left at the start of each edge, degrees, -180..180; negative at a reflex corner."""
    following = vector_m[next_edge]
    turn = np.empty(len(vector_m))
    turn[next_edge] = np.degrees(np.arctan2(cross(vector_m, following), (vector_m * following).sum(axis=1)))
    return turn


def _gable_ends(
    edges: FootprintEdges,
    length_m: np.ndarray,
    turn_deg: np.ndarray,
    turn_after_deg: np.ndarray,
    party: np.ndarray,
    vector_m: np.ndarray,
) -> np.ndarray:
    """Mask of the edges that carry a gable on a gable roof: party walls, and the ends of wings, shortest first.

    An edge beside a much shorter one is often a piece of a long side with a small step in it. It gets a gable
    only opposite another gable.
    """
    is_gable = party.copy()
    if edges.is_courtyard.any():
        return is_gable
    low, high = _CORNER_DEG
    is_square = (turn_deg >= low) & (turn_deg <= high) & (turn_after_deg >= low) & (turn_after_deg <= high)
    is_narrow = length_m <= _GABLE_WIDTH_PER_RADIUS * edges.radius_m
    next_edge = edges.next_edge
    previous_edge = np.empty_like(next_edge)
    previous_edge[next_edge] = np.arange(len(previous_edge))
    at_step = np.minimum(length_m[previous_edge], length_m[next_edge]) < _SHORTEST_WING * length_m
    for edge in np.lexsort([length_m, at_step]):
        if (
            not is_square[edge]
            or is_gable[edge]
            or is_gable[previous_edge[edge]]
            or is_gable[next_edge[edge]]
        ):
            continue
        # the free end of a row of houses is as wide as its party walls
        fits = is_narrow[edge] or np.any(_is_parallel(vector_m[party], vector_m[edge]))
        if fits and (not at_step[edge] or np.any(_is_parallel(vector_m[is_gable], vector_m[edge]))):
            is_gable[edge] = True
    return is_gable


def _is_parallel(vectors_m: np.ndarray, vector_m: np.ndarray) -> np.ndarray:
    """Which of ``vectors_m`` (n, 2) are parallel to ``vector_m`` (2,), within 12 degrees, bool (n,)."""
    lengths = np.hypot(*vectors_m.T) * np.hypot(*vector_m)
    return np.abs(cross(vectors_m, vector_m)) <= np.sin(np.radians(_PARALLEL_DEG)) * lengths


def _draw_slopes(
    vector_m: np.ndarray,
    length_m: np.ndarray,
    pitches: np.ndarray,
    rng: np.random.Generator,
    is_asymmetric: bool,
) -> np.ndarray:
    """An angle per edge, shared by parallel edges (is_asymmetric: only by those that face the same way)."""
    main_angle = float(rng.choice(pitches))
    angle = np.zeros(len(vector_m))
    for edge in np.argsort(-length_m, kind="stable"):
        if angle[edge]:
            continue
        group = (angle == 0) & _is_parallel(vector_m, vector_m[edge])
        if is_asymmetric:
            group &= vector_m @ vector_m[edge] > 0
        # the first group has the longest edge and the main angle; the ends of a hipped roof often share it
        is_first = not angle.any()
        angle[group] = main_angle if is_first or rng.random() < _SAME_ANGLE else float(rng.choice(pitches))
    return angle


def _draw_shed(
    edges: FootprintEdges,
    vector_m: np.ndarray,
    length_m: np.ndarray,
    at_reflex: np.ndarray,
    max_rise_m: float,
    rng: np.random.Generator,
) -> np.ndarray | None:
    """A slope on one edge that is not a party wall, 90 degrees on the others.

    None if no edge has a slope that rises by at most ``max_rise_m``, or if the footprint is not convex.
    """
    if at_reflex.any() or edges.is_courtyard.any():
        return None
    normal = np.column_stack([-vector_m[:, 1], vector_m[:, 0]]) / length_m[:, None]
    depth_m = ((edges.xy_m[None] - edges.xy_m[:, None]) * normal[:, None]).sum(axis=2).max(axis=1)
    candidates = np.flatnonzero(
        ~edges.is_party
        & (depth_m * np.tan(np.radians(SLOPES_DEG[0])) <= max_rise_m)
        & (length_m >= _SHORTEST_SHED_EAVE * depth_m)
    )
    if not len(candidates):
        return None
    eave = rng.choice(candidates)
    shed_pitches = SLOPES_DEG[depth_m[eave] * np.tan(np.radians(SLOPES_DEG)) <= max_rise_m]
    angle = np.full(len(length_m), 90.0)
    angle[eave] = rng.choice(shed_pitches)
    return angle


def _draw_mixed(
    at_reflex: np.ndarray, party: np.ndarray, pitches: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """An independent angle per edge: one in four vertical, one in ten flat, else a slope; at least one slope."""
    num_edges = len(at_reflex)
    chance = rng.random(num_edges)
    angle = rng.choice(pitches, size=num_edges).astype(float)
    slope_edge = rng.integers(num_edges)
    is_flat = chance < _MIXED_FLAT
    angle[is_flat] = 0
    angle[~is_flat & (chance < _MIXED_FLAT + _MIXED_VERTICAL) & ~at_reflex] = 90
    angle[party] = 90
    if not np.any((angle > 0) & (angle < 90)):
        free = np.flatnonzero(~party)
        angle[free[slope_edge % len(free)]] = float(rng.choice(pitches))
    return angle
