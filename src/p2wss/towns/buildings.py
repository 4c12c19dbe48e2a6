"""A drawn building: wings with simple roofs. It is independent of the kernel, so that it can test the kernel."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import cast

import numpy as np
import shapely

from p2wss.towns.site import BUILDING_CLASS, ground_z_m


@dataclass
class Wing:
    """A piece of roof: eaves along ``slopes`` (edges of ``outline``), gables or walls along the others."""

    outline: np.ndarray  # (n, 2) m, counter-clockwise and convex
    eave_m: float  # above the ground
    pitch_deg: float
    slopes: tuple[int, ...]  # edge i runs from vertex i to i + 1; none = a flat roof
    more: tuple[tuple[int, float, float], ...] = ()  # other planes: edge, metres above the eave there, pitch
    detail: str = (
        ""  # what a model of the building leaves out: a chimney, a parapet, ..; "shaft" is open above
    )
    seen_as: int = BUILDING_CLASS  # the class of its points
    seen_share: float = 1.0  # share of its points that the scanner records

    def planes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The planes that rise from edges: points (p, 2), unit vectors of the edges (p, 2), metres above the eave at
        the edges (p,), tangents of the pitch (p,)."""
        planes = [*((edge, 0.0, self.pitch_deg) for edge in self.slopes), *self.more] or [(0, 0.0, 0.0)]
        edge, above_m, pitch_deg = zip(*planes, strict=True)
        start = self.outline[list(edge)]
        end = np.roll(self.outline, -1, axis=0)[list(edge)]
        along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
        return start, along, np.array(above_m), np.tan(np.radians(pitch_deg))

    def rise_m(self, xy: np.ndarray) -> np.ndarray:
        """Roof above the eave at ``xy`` (n, 2): the lowest of the planes."""
        start, along, above_m, tangent = self.planes()
        offset = xy[:, None, :] - start
        inside = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
        return np.asarray((above_m + np.maximum(inside, 0) * tangent).min(axis=1))

    @property
    def ridge_m(self) -> float:
        """The highest roof point among the centre and the corners, metres above the ground."""
        return float((self.eave_m + self.rise_m(np.vstack([self.outline.mean(axis=0), self.outline]))).max())


@dataclass
class DrawnBuilding:
    """Wings that touch; their union is the footprint."""

    wings: list[Wing]
    kind: str  # house, row, block, hall, annex; of a town of wings, one of its shapes; of an old one, its trouble
    footprint: shapely.Polygon = field(default_factory=shapely.Polygon)
    ground: Callable[[np.ndarray, np.ndarray], np.ndarray] = ground_z_m
    crowns: Sequence[
        Sequence[float]
    ] = ()  # plants on it: x, y, z of the centre, radius, half height, density
    hidden_ground_m: float = 0.0  # so near to it, no point of the ground has its class

    def __post_init__(self) -> None:
        # 0.1 m is the resolution of BD TOPO; the tiny opening closes slits between wings
        union = shapely.union_all(
            [shapely.Polygon(wing.outline).buffer(0.01, join_style="mitre") for wing in self.wings]
        )
        union = union.buffer(-0.01, join_style="mitre").simplify(0.03)
        # wings that do not touch make a MultiPolygon, which draw_town throws away
        self.footprint = cast(shapely.Polygon, shapely.normalize(shapely.set_precision(union, 0.1)))

    @property
    def eave_m(self) -> float:
        """Eave height of the largest wing, above the ground."""
        return max(self.wings, key=lambda wing: shapely.Polygon(wing.outline).area).eave_m

    @property
    def floor_m(self) -> float:
        """Height of the ground, where the walls begin."""
        return float(np.median(self.ground(*shapely.get_coordinates(self.footprint).T)))
