"""Roof angles: per footprint edge 0 (flat), 90 (vertical: a gable or a wall) or an integer 20..45 degrees.

The paper (section 5.1) only says that each edge gets one of these. ``uniform`` is that, word for word.
``realistic`` draws a roof type first and then angles that make such a roof.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2wss.config import Scenes
from p2wss.data.seeds import generator

SLOPES_DEG = np.arange(20, 46)
ANGLES_DEG = np.array([0, 90, *SLOPES_DEG])
# edges whose directions differ by less belong to one wing and share an angle
_PARALLEL_DEG = 12.0
# a gable stands on an edge between two corners of about a right angle
_CORNER_DEG = (45.0, 135.0)
# a gable is no wider than its wing, which is about twice the radius of the largest circle inside; U-shapes
# would otherwise get a gable on the outside of the wing that joins the other two
_GABLE_WIDTH_PER_RADIUS = 2.6
# a wing shorter than this share of its width is a step in the wall
_SHORTEST_WING = 0.5


@dataclass(frozen=True)
class Outline:
    """What the sampler needs to know of a footprint; arrays have one value per edge over all rings.

    xy_m: (n, 2), edge i starts at vertex i. following: index of the next edge in its ring. is_courtyard: the
    edge is not of the exterior. is_party: another building stands against it. radius_m: of the largest circle
    inside.
    """

    xy_m: np.ndarray
    following: np.ndarray
    is_courtyard: np.ndarray
    is_party: np.ndarray
    radius_m: float

    @classmethod
    def from_rings(cls, rings: list[np.ndarray], is_party: np.ndarray, radius_m: float) -> Outline:
        """From rings (n, 2), exterior first, none repeating its first vertex."""
        sizes = [len(ring) for ring in rings]
        first = np.cumsum([0, *sizes[:-1]])
        return cls(
            xy_m=np.concatenate(rings),
            following=np.concatenate(
                [start + np.roll(np.arange(n), -1) for start, n in zip(first, sizes, strict=True)]
            ),
            is_courtyard=np.repeat(np.arange(len(rings)) > 0, sizes),
            is_party=np.asarray(is_party, bool),
            radius_m=radius_m,
        )


def draw_angles(outline: Outline, building_id: str, config: Scenes) -> tuple[str, np.ndarray]:
    """(roof type, angle per edge: float array (n,)) from (seed, "scenes", building_id)."""
    rng = generator(config.seed, "scenes", building_id, "angles")
    if config.sampler == "uniform":
        return "uniform", rng.choice(ANGLES_DEG, size=len(outline.xy_m)).astype(float)
    return _realistic(outline, config, rng)


def _realistic(outline: Outline, config: Scenes, rng: np.random.Generator) -> tuple[str, np.ndarray]:
    """A roof of a drawn type. What is asked for and impossible becomes the nearest type that is possible.

    * 90 degrees is never next to a reflex corner, where it would raise a wall out of the roof.
    * Party walls are vertical, so that rows of houses have their ridges along the street.
    * Courtyards have eaves; a ring of wings has no gables.
    * Edges of one direction share their angle (a gable roof in ten has two different sides).
    * The angle is drawn among those whose roof rises by at most ``max_rise_m``.
    """
    shares = config.roof_shares.model_dump()
    names = [name.replace("_", "-") for name in shares]
    weights = np.array(list(shares.values()))
    roof_type = str(rng.choice(names, p=weights / weights.sum()))

    edge_m = outline.xy_m[outline.following] - outline.xy_m
    length_m = np.hypot(*edge_m.T)
    turn_deg = _turns(edge_m, outline.following)  # at the start of each edge
    turn_after_deg = turn_deg[outline.following]
    at_reflex = (turn_deg < 0) | (turn_after_deg < 0)
    party = outline.is_party & ~at_reflex
    pitches = SLOPES_DEG[outline.radius_m * np.tan(np.radians(SLOPES_DEG)) <= config.max_rise_m]

    if roof_type == "flat" or not len(pitches):
        return "flat", np.zeros(len(length_m))
    if roof_type == "mixed":
        return "mixed", _mixed(at_reflex, party, pitches, rng)
    if roof_type == "shed":
        shed = _shed(outline, edge_m, length_m, at_reflex, config.max_rise_m, rng)
        if shed is not None:
            return "shed", shed
        roof_type = "gable"

    ends = _gable_ends(outline, length_m, turn_deg, turn_after_deg, party, edge_m)
    free = np.flatnonzero(ends & ~party)
    if roof_type == "hip":
        ends[free] = False
    elif roof_type == "half-hip" and len(free):
        # one end hipped; with a party wall at the other end that is all that is free
        ends[rng.choice(free)] = False
    angle_deg = _slopes(edge_m, length_m, pitches, rng, two_sided=roof_type == "gable" and rng.random() < 0.1)
    angle_deg[ends] = 90
    if not np.any(ends):
        return "hip", angle_deg
    return ("gable" if np.array_equal(np.flatnonzero(ends & ~party), free) else "half-hip"), angle_deg


def _turns(edge_m: np.ndarray, following: np.ndarray) -> np.ndarray:
    """Turn to the left at the start of each edge, degrees, -180..180; negative at a reflex corner."""
    after = edge_m[following]
    cross = edge_m[:, 0] * after[:, 1] - edge_m[:, 1] * after[:, 0]
    turn = np.empty(len(edge_m))
    turn[following] = np.degrees(np.arctan2(cross, (edge_m * after).sum(axis=1)))
    return turn


def _gable_ends(
    outline: Outline,
    length_m: np.ndarray,
    turn_deg: np.ndarray,
    turn_after_deg: np.ndarray,
    party: np.ndarray,
    edge_m: np.ndarray,
) -> np.ndarray:
    """Edges that become gables if the type wants gables: party walls, and ends of wings, shortest first.

    An end with a neighbour much shorter than itself is often a piece of a side with a small step in it; it
    becomes a gable only opposite to another one.
    """
    chosen = party.copy()
    if outline.is_courtyard.any():
        return chosen
    low, high = _CORNER_DEG
    square = (turn_deg >= low) & (turn_deg <= high) & (turn_after_deg >= low) & (turn_after_deg <= high)
    narrow = length_m <= _GABLE_WIDTH_PER_RADIUS * outline.radius_m
    following = outline.following
    before = np.empty_like(following)
    before[following] = np.arange(len(before))
    stepped = np.minimum(length_m[before], length_m[following]) < _SHORTEST_WING * length_m
    for edge in np.lexsort([length_m, stepped]):
        if not square[edge] or chosen[edge] or chosen[before[edge]] or chosen[following[edge]]:
            continue
        # the free end of a row is as wide as its party walls
        fits = narrow[edge] or np.any(_parallel(edge_m[party], edge_m[edge]))
        if fits and (not stepped[edge] or np.any(_parallel(edge_m[chosen], edge_m[edge]))):
            chosen[edge] = True
    return chosen


def _parallel(edges_m: np.ndarray, edge_m: np.ndarray) -> np.ndarray:
    cross = np.abs(edges_m[:, 0] * edge_m[1] - edges_m[:, 1] * edge_m[0])
    lengths = np.hypot(*edges_m.T) * np.hypot(*edge_m)
    return cross <= np.sin(np.radians(_PARALLEL_DEG)) * lengths


def _slopes(
    edge_m: np.ndarray, length_m: np.ndarray, pitches: np.ndarray, rng: np.random.Generator, two_sided: bool
) -> np.ndarray:
    """An angle per edge, shared by edges of one direction (two_sided: that also face the same way)."""
    main = float(rng.choice(pitches))
    angle = np.zeros(len(edge_m))
    for edge in np.argsort(-length_m, kind="stable"):
        if angle[edge]:
            continue
        group = (angle == 0) & _parallel(edge_m, edge_m[edge])
        if two_sided:
            group &= edge_m @ edge_m[edge] > 0
        # the first group holds the longest edges; ends of a hipped roof are as steep, or not
        is_first = not angle.any()
        angle[group] = main if is_first or rng.random() < 0.6 else float(rng.choice(pitches))
    return angle


def _shed(
    outline: Outline,
    edge_m: np.ndarray,
    length_m: np.ndarray,
    at_reflex: np.ndarray,
    max_rise_m: float,
    rng: np.random.Generator,
) -> np.ndarray | None:
    """One slope from an edge that is no party wall, vertical elsewhere; None if none is low enough."""
    if at_reflex.any() or outline.is_courtyard.any():
        return None
    normal = np.column_stack([-edge_m[:, 1], edge_m[:, 0]]) / length_m[:, None]
    depth_m = ((outline.xy_m[None] - outline.xy_m[:, None]) * normal[:, None]).sum(axis=2).max(axis=1)
    candidates = np.flatnonzero(
        ~outline.is_party
        & (depth_m * np.tan(np.radians(SLOPES_DEG[0])) <= max_rise_m)
        & (length_m >= 0.5 * depth_m)
    )
    if not len(candidates):
        return None
    eave = rng.choice(candidates)
    low_enough = SLOPES_DEG[depth_m[eave] * np.tan(np.radians(SLOPES_DEG)) <= max_rise_m]
    angle = np.full(len(length_m), 90.0)
    angle[eave] = rng.choice(low_enough)
    return angle


def _mixed(
    at_reflex: np.ndarray, party: np.ndarray, pitches: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Each edge on its own: one in four vertical, one in ten flat, else a slope; at least one slope."""
    num = len(at_reflex)
    chance = rng.random(num)
    angle = rng.choice(pitches, size=num).astype(float)
    one = rng.integers(num)
    angle[chance < 0.1] = 0
    angle[(chance >= 0.1) & (chance < 0.35) & ~at_reflex] = 90
    angle[party] = 90
    if not np.any((angle > 0) & (angle < 90)):
        angle[one] = float(rng.choice(pitches))
    return angle
