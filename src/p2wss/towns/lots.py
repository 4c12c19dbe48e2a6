"""Helpers of the generator: sides of a block, places along a street, lots, and random numbers for a roof."""

import numpy as np
import shapely


def block_side(block: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Start, direction, inward normal and length of a side of a counter-clockwise block."""
    start, end = block[side], block[(side + 1) % len(block)]
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    return start, along, np.array([-along[1], along[0]]), length


def to_world(
    origin: np.ndarray, along: np.ndarray, inward: np.ndarray, corners: list[tuple[float, float]]
) -> np.ndarray:
    """World coordinates of (distance along, distance inward) pairs."""
    return np.array([origin + a * along + b * inward for a, b in corners])


def rectangle(u0: float, v0: float, u1: float, v1: float) -> list[tuple[float, float]]:
    """The corners of a rectangle between two opposite ones, counter-clockwise."""
    return [(u0, v0), (u1, v0), (u1, v1), (u0, v1)]


def cut_into_lots(length: float, low: float, high: float, rng: np.random.Generator) -> np.ndarray:
    """Cuts 0 .. length into lots of ``low`` to ``high`` metres."""
    number = max(1, round(length / rng.uniform(low, high)))
    width = rng.uniform(low, high, number)
    return np.concatenate([[0], np.cumsum(width * length / width.sum())])


def draw_pitch_deg(rng: np.random.Generator) -> float:
    """A random roof angle in whole degrees."""
    return float(rng.integers(22, 46))


def draw_eave_m(storeys: int, rng: np.random.Generator) -> float:
    """A random eave height above the ground, to the decimetre."""
    return round(float(storeys * rng.uniform(2.8, 3.2) + rng.uniform(-0.4, 0.6)), 1)


def inset(block: np.ndarray, distance_m: float) -> np.ndarray | None:
    """The block moved inwards: vertex i belongs to vertex i of ``block``. None if too little is left."""
    inner = shapely.Polygon(block).buffer(-distance_m, join_style="mitre")
    if inner.geom_type != "Polygon" or inner.area < 250:
        return None
    ring = shapely.get_coordinates(shapely.orient_polygons(inner))[:-1]
    if len(ring) != len(block):
        return None
    nearest = np.argmin(((block[:, None] - ring) ** 2).sum(axis=2), axis=1)
    return ring[nearest] if len(set(nearest)) == len(block) else None
