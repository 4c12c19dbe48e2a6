"""A building before and after its reconstruction, as all stages represent it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import shapely

from p2wss.data.points import points_on_building
from p2wss.mesh import Mesh
from p2wss.mesh.faces import Surface


@dataclass(frozen=True)
class Building:
    """A footprint and its points: the input of a reconstruction.

    rings: footprint, each (n, 2), exterior first and counter-clockwise, courtyards clockwise, relative to
    ``origin_xy_m``. point_m: (m, 3), x and y relative to the origin, z above ``ground_z_m``. classification: uint8
    (m,), LAS classes. ground_z_m: z of the ground at the building in the height system of the cloud, as the cloud shows
    it (:func:`p2wss.clouds.crops.crop_cloud`); NaN only without points. All other heights are above it.
    stated_height_m: height above the ground that the footprint states; NaN if unknown. around_m: (k, 3), points on the
    roofs around the building, in the same frame; (0, 3) unless it has few points of its own. supposed_m: (s, 3), places
    all over the roof, at heights that a network predicts; (0, 3) unless the building has few points. line_m: (l, 2, 2),
    ends of the roof lines that a map knows, in the same frame; None in a run without such lines.
    """

    building_id: str
    tile: str
    origin_xy_m: tuple[float, float]
    rings: Sequence[np.ndarray]
    point_m: np.ndarray
    classification: np.ndarray
    ground_z_m: float
    stated_height_m: float = float("nan")
    around_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    supposed_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    line_m: np.ndarray | None = None

    @property
    def num_lines(self) -> int | None:
        """How many lines of its roof a map knows; None in a run without such lines."""
        return None if self.line_m is None else len(self.line_m)

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The footprint, relative to ``origin_xy_m``, metres."""
        return shapely.Polygon(self.rings[0], self.rings[1:])

    @property
    def position_m(self) -> np.ndarray:
        """(3,), the place of the origin, at the ground, in the CRS of the cloud."""
        return np.array([*self.origin_xy_m, self.ground_z_m])

    @cached_property
    def is_on_building(self) -> np.ndarray:
        """Mask of the points on the building, bool (m,): see :func:`p2wss.data.points.points_on_building`."""
        return points_on_building(self.polygon, self.point_m, self.classification)


@dataclass(frozen=True)
class Reconstruction:
    """The result of a method for a building: parameters and a mesh, or a status that gives the reason for none.

    rings: footprint of the mesh, relative to ``origin_xy_m`` like x and y of the mesh; z is above ``ground_z_m``.
    eave_height_m: above ``ground_z_m``. angle_deg: one per edge over all rings. num_parts: number of bodies between
    which there are steps, or of fitted parts; with several, ``eave_height_m`` is that of the largest one, and
    ``angle_deg`` are the angles along the footprint. status: a value of :mod:`p2wss.data.reasons`; a mesh with a status
    other than "ok" is a flat roof used as a fallback. surfaces: the planar polygons of the mesh, as files have them,
    once they were found to be a valid solid; empty before that. is_simplified: whether the points show more planes than
    the fit of a building takes. num_lines_used: how many lines of ``Building.line_m`` are edges of the roof.
    """

    building_id: str
    tile: str
    method: str
    status: str
    origin_xy_m: tuple[float, float]
    ground_z_m: float
    rings: Sequence[np.ndarray]
    eave_height_m: float | None
    angle_deg: np.ndarray | None
    mesh: Mesh | None
    num_parts: int = 1
    surfaces: Sequence[Surface] = ()
    is_simplified: bool = False
    num_lines_used: int = 0

    @property
    def has_mesh(self) -> bool:
        """Whether there is a mesh, that of a fallback included."""
        return self.mesh is not None

    @property
    def num_triangles(self) -> int:
        """Number of triangles of the mesh; 0 without one."""
        return 0 if self.mesh is None else len(self.mesh.triangle)

    @property
    def position_m(self) -> np.ndarray:
        """(3,), the place of the mesh's origin in the CRS of the cloud."""
        return np.array([*self.origin_xy_m, self.ground_z_m])

    @property
    def placed_mesh(self) -> Mesh:
        """The mesh, which must exist, in the CRS of the cloud."""
        assert self.mesh is not None
        return self.mesh.translated(self.position_m)


def no_mesh(building: Building, method: str, status: str) -> Reconstruction:
    """The reconstruction of a building for which a method has no mesh. status: the reason."""
    return Reconstruction(
        building.building_id,
        building.tile,
        method,
        status,
        building.origin_xy_m,
        building.ground_z_m,
        building.rings,
        None,
        None,
        None,
    )
